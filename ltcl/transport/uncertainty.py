# SPDX-License-Identifier: BSD-3-Clause
"""Standard deviations of patterns and bounces that the noise of T causes, pixel by pixel.

A measured T is the true one and an error E, whose entries have the variances v_ij of `T.noise`.
Errors E a and E b of pixel i have the covariance

    q_ab = sum_j v_ij a_j b_j = rows_i (photons T (columns a b) + floor^2 columns . (a b))_i

of a and b as `Noise.filtered` has them, or q_ab + (u / V - 1) q_a1 q_b1 / V, V = q_11, where the
row adds up to a measured white of variance u. To first order, with F = diag(T), D = diag(E), X =
S^-1 = F T^-1, p_k = F^-1 b_k and the bounces of eq. 27:

    T p:    E p
    p:      -F^-1 X E p
    b_k:    db_k = X (dl^(k) - E p_k) + D p_k,    dl^(k+1) = dl^(k) - db_k,    dl^(0) = 0

X = I - R X. What I makes of it is noise of the pixel's own row of T, -F^-1 E p, of bounces
(D - E) (p_k - p_(k-1)): in closed form, by products. What R X makes of it is noise of other rows:
the mean of many, and small, except where gloss lights a pixel by few others. Its mean square over
some random errors, drawn row by row with the covariances above and solved together, is enough; less
what the noise of R itself adds, which the first order counts twice. Light that returns to its pixel
correlates both, and is left out.

Where a pattern is clipped, errors are those of the least squares problem of its free pixels; E^T
times the residual is left out. Known limits: F is taken to have the errors of diag(T). What is no
noise is not contained: compression, a tolerance, response, blur, and changes of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltcl.operators import Operator
from ltcl.solvers import Inverse, solve
from ltcl.solvers.bounded import least_squares
from ltcl.transport import frames as layout
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport

_DRAWS, _FRAME_DRAWS, _WHOLE_DRAWS = (
    8,
    4,
    16,
)  # of one picture, of each of several, without a closed form
_TOGETHER = 8  # pictures whose draws are solved at once
_ROUNDING = 1e-12  # relative, of a variance
_RTOL = 0.05  # of solves, whose solutions are the smaller part


class _Deviations:
    def __repr__(self) -> str:
        rms = (
            f"{k} {np.sqrt(np.mean(np.square(x, dtype=np.float64))):.2g}"
            for k, x in vars(self).items()
        )
        return f"<ltcl standard deviations, rms of {', '.join(rms)}>"


@dataclass(frozen=True, repr=False, eq=False)
class SeparationStd(_Deviations):
    """Standard deviations of the result of `ltcl.separate`, in the units of the image, float32.

    `direct` is like the image, `bounces` (bounces, ...): of errors against what the true T makes of
    the same image. Noise of the image itself is not contained: s a pixel adds about s to the direct
    part. At masked pixels they are those of the light that T leaves unexplained.
    """

    direct: np.ndarray
    bounces: np.ndarray


@dataclass(frozen=True, repr=False, eq=False)
class CompensationStd(_Deviations):
    """Standard deviations of the result of `ltcl.compensate`, float32.

    `pattern` at this gain, in light of the projector: 0 where it is masked, or at a bound and
    clipped. `appearance`: of what the camera will see under this pattern, against what T says.
    """

    pattern: np.ndarray
    appearance: np.ndarray


def separation_std(
    T: Transport, noise: Noise, pictures: Sequence[np.ndarray], inverse: Inverse | None = None
) -> SeparationStd:
    """Of `pictures`: the direct part and the bounces."""
    columns = [layout.unpack("bounces", picture, T.grid, T.channels) for picture in pictures]
    shape, n = columns[0][1], len(pictures)
    random, deviations = np.random.default_rng(0), []
    for c, f in enumerate(np.atleast_2d(T.first_bounce)):
        b = np.stack([each[c] for each, _ in columns], axis=-1).astype(
            np.float64
        )  # (N, k, bounces)
        whole = _ratio(b, f[:, None, None])
        variances = np.empty(b.shape)
        for start in range(0, b.shape[1], _TOGETHER):
            p = whole[:, start : start + _TOGETHER]
            q = covariance(T, noise, c, p, diagonal=True)
            # (D - E) (p_k - p_(k-1)) as weights of E p_0, E p_1, ... and D: (N, k, bounces, bounces
            # + 1)
            difference = np.broadcast_to(np.eye(n, k=-1) - np.eye(n), (*p.shape, n))
            weights = np.concatenate([difference, np.diff(p, prepend=0.0)[..., None]], axis=-1)
            variance = np.einsum("xkna,xkab,xknb->xkn", weights, q, weights)
            E = _draws(q, random, b.shape[1])  # (N, k, draws, bounces + 1)
            own = np.einsum("xkna,xkda->xkdn", weights, E)
            dl, before = np.zeros(E.shape[:3]), np.zeros(E.shape[:3])
            for k in range(n):
                x = _solve(T, c, dl - E[..., k], inverse)
                db = x + E[..., -1] * p[:, :, None, k]
                variance[..., k] += _square(T, noise, c, before - x, db - own[..., k])
                dl, before = dl - db, x
            variances[:, start : start + _TOGETHER] = variance
        deviations.append(np.sqrt(np.maximum(variances, 0.0)))
    packed = [
        shape.pack([d[..., k] for d in deviations], T.grid).astype(np.float32) for k in range(n)
    ]
    return SeparationStd(packed[0], np.stack(packed)[1:])


def compensation_std(
    T: Transport,
    noise: Noise,
    pattern: np.ndarray,
    bounds: tuple[float, float] = (-np.inf, np.inf),
    inverse: Inverse | None = None,
    systems: Sequence[tuple[Operator, np.ndarray]] = (),
    weights: Sequence[np.ndarray] | None = None,
) -> CompensationStd:
    """Of a pattern that was clipped to `bounds`.

    `systems` and `weights`, as `ltcl.compensation` has them, where it is the best within bounds.
    """
    p, shape = layout.unpack("pattern", pattern, T.grid, T.channels)
    free = [(bounds[0] < light) & (light < bounds[1]) & ~T.masked[:, None] for light in p]
    mixed = p if T.mixing is None else list(np.einsum("cd,dnk->cnk", T.mixing, np.stack(p)))
    mixed = mixed if T.blocks is None else [np.concatenate(p)] * 3
    q = [
        covariance(T, noise, c, a[..., None].astype(np.float64))[..., 0, 0]
        for c, a in enumerate(mixed)
    ]
    q = [np.maximum(variance, 0.0) for variance in q]
    appearance = shape.pack([np.sqrt(variance) for variance in q], T.camera_grid)
    scales = [scale for _, scale in systems] or list(np.atleast_2d(T.first_bounce))
    own, random, variances = (
        not (systems and T.couples) and T.is_square,
        np.random.default_rng(0),
        [],
    )
    errors, lit = (x if len(scales) == len(q) else [np.concatenate(x)] for x in (q, free))
    for c, (variance, f, scale) in enumerate(zip(errors, lit, scales, strict=True)):
        k, w = variance.shape[1], np.broadcast_to(weights[c] if weights else 1.0, variance.shape)
        light, f = np.empty(f.shape), f & (scale > 0)[:, None]
        for some in (slice(start, start + _TOGETHER) for start in range(0, k, _TOGETHER)):
            e = _draws(variance[:, some, None, None], random, k if own else 0)[..., 0]
            if systems:
                x = least_squares(systems[c][0], e, f[:, some, None], w[:, some, None], rtol=_RTOL)
            else:
                x = _solve(T, c, e, inverse)
            light[:, some] = np.mean(x**2, axis=-1)
            if own:  # of S: e of the pixel itself, and a rest as above
                light[:, some] = variance[:, some] + _square(T, noise, c, x, x - e)
        variances.append(_ratio(light, scale[:, None] ** 2))
    if T.mixing is not None and not systems:
        variances = list(
            np.einsum("cd,dnk->cnk", np.linalg.inv(T.mixing) ** 2, np.stack(variances))
        )
    variances = variances if len(scales) == len(q) else np.split(variances[0], 3)
    deviations = [np.sqrt(variance * f) for variance, f in zip(variances, free, strict=True)]
    pictures = shape.pack(deviations, T.grid), appearance
    return CompensationStd(*(picture.astype(np.float32) for picture in pictures))


def covariance(
    T: Transport, noise: Noise, c: int, a: np.ndarray, diagonal: bool = False
) -> np.ndarray:
    """Covariances (M, k, n, n) of E a, for a (N, k, n) and channel c; and of diag(E) as one more."""
    n, known = a.shape[-1], np.isfinite(noise.white[c])
    own = (
        noise.diagonal(T.first_bounce)[c, :, None, None] ** 2
        if T.is_square
        else np.zeros((1, 1, 1))
    )
    w = np.concatenate([a, np.ones((*a.shape[:2], 1))], axis=-1)[..., : n + known.any()]
    i, j = np.triu_indices(w.shape[-1])
    seen = noise.filtered(w, T.grid, c)
    pairs = seen[..., i] * seen[..., j]
    sums = variance(T, noise, c, pairs.reshape(len(pairs), -1)).reshape(-1, *pairs.shape[1:])
    if noise.neighbours[c]:
        sums += own * (
            w[..., i] * w[..., j] - pairs
        )  # the first bounce has no part in its neighbours
    q = np.zeros((*sums.shape[:2], *2 * (w.shape[-1] + diagonal,)))
    q[..., i, j] = q[..., j, i] = sums
    if diagonal:
        q[..., -1, :-1] = q[..., :-1, -1] = own * w
        q[..., -1, -1] = own[..., 0]
    if not known.any():
        return q
    V = np.where(known[:, None], np.maximum(q[..., n, n], 1e-300), 1.0)
    factor = np.where(
        known[:, None], (np.where(known, noise.white[c], 0.0)[:, None] / V - 1.0) / V, 0.0
    )
    q += factor[..., None, None] * q[..., n, :, None] * q[..., n, None, :]
    return np.delete(np.delete(q, n, axis=-1), n, axis=-2)


def variance(T: Transport, noise: Noise, c: int, squares: np.ndarray) -> np.ndarray:
    """sum_j v_ij squares_j, (M, k), of (N, k) and channel c; of blocks (3 N, k), channel below channel."""
    matrices = [T.matrices[c]] if T.blocks is None else T.blocks[c]
    columns = np.tile(noise.columns[c], len(matrices))[:, None]
    light = np.zeros((T.shape[0], squares.shape[1])) + noise.floor[c] ** 2 * (columns.T @ squares)
    if noise.photons[c] > 0.0:
        weighted = (columns * squares).astype(np.float32)
        if T.is_square:
            seen = T.systems[c].matmat(np.atleast_2d(T.first_bounce)[c][:, None] * weighted)
        else:
            seen = sum(
                A @ s for A, s in zip(matrices, np.split(weighted, len(matrices)), strict=True)
            )
        light += noise.photons[c] * seen
    light *= noise.rows[c][:, None]
    if T.is_square:
        light -= noise.less_direct(T.first_bounce)[c][:, None] * squares
    return light


def _square(T: Transport, noise: Noise, c: int, z: np.ndarray, Rz: np.ndarray) -> np.ndarray:
    """Mean square over draws of R z, (N, k, draws), where it stands out of what the noise of R makes of z."""
    f = np.atleast_2d(T.first_bounce)[c][:, None]
    of_noise = variance(T, noise, c, _ratio(np.mean(z**2, axis=-1), f**2))
    return np.maximum(np.mean(Rz**2, axis=-1) - (1.0 + (2.0 / z.shape[-1]) ** 0.5) * of_noise, 0.0)


def _draws(q: np.ndarray, random: np.random.Generator, pictures: int) -> np.ndarray:
    """Random errors (M, k, draws, n) of the covariances q (M, k, n, n), for a task of so many pictures."""
    draws = {0: _WHOLE_DRAWS, 1: _DRAWS}.get(pictures, _FRAME_DRAWS)
    roots, rest = np.zeros(q.shape), q.copy()
    for n in range(
        q.shape[-1]
    ):  # Cholesky's, of all pixels at once; what rounding leaves is no direction
        pivot = np.where(rest[..., n, n] > _ROUNDING * q[..., n, n], rest[..., n, n], 0.0)
        roots[..., n] = column = _ratio(rest[..., n], np.sqrt(pivot)[..., None])
        rest -= column[..., None] * column[..., None, :]
    return random.standard_normal((*q.shape[:2], draws, q.shape[-1])) @ np.swapaxes(roots, -1, -2)


def _solve(T: Transport, c: int, light: np.ndarray, inverse: Inverse | None) -> np.ndarray:
    """X of light (N, k, draws)."""
    b = light.reshape(len(light), -1)
    x = (
        inverse.solve(b, c)
        if inverse is not None
        else solve(T.systems[c], b, rtol=_RTOL if T.error >= 1.0 else max(_RTOL, T.error))
    )
    return x.x.astype(np.float64).reshape(light.shape)


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a / b; 0 where b is."""
    return np.divide(a, b, out=np.zeros(np.broadcast_shapes(a.shape, b.shape)), where=b > 0)
