# SPDX-License-Identifier: BSD-3-Clause
"""Standard deviations of patterns and bounces that the noise of T causes, pixel by pixel.

To first order in the error E of T, with F = diag(T), D = diag(E), X = S^-1 = F T^-1, the bounces
b_k of eq. 27 and p_k = F^-1 b_k:

    picture T p     E p
    pattern p       -F^-1 X E p
    bounce b_k      db_k = X (dl^(k) - E p_k) + D p_k,    dl^(k+1) = dl^(k) - db_k,    dl^(0) = 0

Two parts of X = I - R X give the variance:

1. I: noise of the pixel's own row of T, -F^-1 E p, for bounces (D - E) (p_k - p_(k-1)). It has a
   closed form, by products (`ltcl.transport.covariance`).
2. R X: noise of other rows. It is the mean of many, and small, except where gloss lights a pixel by
   few others. Its mean square over some random errors, drawn row by row with the covariances of
   `EntryErrors` and solved together, is enough, less the share that the noise of R itself adds,
   which the first order counts twice.

Light that returns to its pixel correlates both parts, and is left out. For a clipped pattern the
errors are those of the least squares problem of its free pixels; E^T times the residual is left
out.

Known limits: F is taken to have the errors of diag(T). Errors other than noise are not contained:
compression, a tolerance, response, blur, and changes of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ltcl.operators import Operator
from ltcl.solvers import Inverse
from ltcl.solvers.host_krylov import least_squares
from ltcl.transport import frames as layout
from ltcl.transport.covariance import SOLVE_RTOL, EntryErrors, entry_errors, ratio
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport

# Random errors of one picture, and of each of several pictures.
DRAWS = 8
FRAME_DRAWS = 4
# Random errors without a closed form beside them.
DRAWS_WITHOUT_CLOSED_FORM = 16
# Pictures whose draws are solved at once.
PICTURES_PER_SOLVE = 8
# Relative to a variance: a smaller pivot of Cholesky's method is rounding.
VARIANCE_ROUNDING = 1e-12


@dataclass(frozen=True, repr=False, eq=False)
class _Deviations:
    """Text of a result: the root mean square of each of its fields."""

    def __repr__(self) -> str:
        texts = []
        for field in fields(self):
            values = getattr(self, field.name)
            rms = np.sqrt(np.mean(np.square(values, dtype=np.float64)))
            texts.append(f"{field.name} {rms:.2g}")
        return f"<ltcl standard deviations, rms of {', '.join(texts)}>"


@dataclass(frozen=True, repr=False, eq=False)
class SeparationStd(_Deviations):
    """Standard deviations of the result of `ltcl.separate`, in the units of the image, float32.

    Attributes
    ----------
    direct : array like the image
    bounces : (bounces, ...) array of these
        Errors against the bounces that the true T makes of the same image. Noise of the image
        itself is not contained: s a pixel adds about s to the direct part. At masked pixels they
        are those of the light that T leaves unexplained.
    """

    direct: np.ndarray
    bounces: np.ndarray


@dataclass(frozen=True, repr=False, eq=False)
class CompensationStd(_Deviations):
    """Standard deviations of the result of `ltcl.compensate`, float32.

    Attributes
    ----------
    pattern : array like the pattern
        At this gain, in light of the projector; 0 where a pixel is masked, or at a bound and
        clipped.
    appearance : array like the picture
        Deviation of the picture that the camera will see under this pattern from the one that T
        predicts.
    """

    pattern: np.ndarray
    appearance: np.ndarray


def separation_std(
    T: Transport, noise: Noise, pictures: Sequence[np.ndarray], inverse: Inverse | None = None
) -> SeparationStd:
    """Standard deviations of `pictures`: the direct part and the bounces."""
    errors = EntryErrors(T, noise, inverse)
    unpacked = [layout.unpack("bounces", picture, T.grid, T.channels) for picture in pictures]
    shape = unpacked[0][1]
    random = np.random.default_rng(0)
    deviations = []
    for channel in range(T.channels):
        columns = [picture_columns[channel] for picture_columns, _ in unpacked]
        b = np.stack(columns, axis=-1).astype(np.float64)
        variances = bounce_variances(errors, channel, b, random)
        deviations.append(np.sqrt(np.maximum(variances, 0.0)))
    packed = []
    for columns in np.moveaxis(np.stack(deviations), -1, 0):
        packed.append(shape.pack(columns, T.grid).astype(np.float32))
    return SeparationStd(packed[0], np.stack(packed)[1:])


def bounce_variances(
    errors: EntryErrors, channel: int, b: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """Variances (N, k, n) of bounces b (N, k, n) of k pictures, b[..., 0] the direct part."""
    F = np.atleast_2d(errors.T.first_bounce)[channel]
    p = ratio(b, F[:, None, None])
    pictures = b.shape[1]
    draws = _draw_count(pictures)
    variances = np.empty(b.shape)
    for group in _groups(pictures):
        patterns = p[:, group]
        variances[:, group] = _group_variances(errors, channel, patterns, draws, random)
    return variances


def _group_variances(
    errors: EntryErrors, channel: int, p: np.ndarray, draws: int, random: np.random.Generator
) -> np.ndarray:
    """Variances (N, k, n) of the bounces of patterns p (N, k, n)."""
    n = p.shape[-1]
    q = errors.covariance(channel, p, with_diagonal=True)
    # 1. (D - E) (p_k - p_(k-1)) as weights of E p_0, E p_1, ... and D, (N, k, n, n + 1), in closed
    # form.
    difference = np.broadcast_to(np.eye(n, k=-1) - np.eye(n), (*p.shape, n))
    steps = np.diff(p, prepend=0.0)[..., None]
    weights = np.concatenate([difference, steps], axis=-1)
    variance = np.einsum("xkna,xkab,xknb->xkn", weights, q, weights)
    # 2. Errors of other rows, by draws (N, k, draws, n + 1) and one solve for each bounce.
    E = draw_errors(q, draws, random)
    own_row = np.einsum("xkna,xkda->xkdn", weights, E)
    D = E[..., -1]
    dl = np.zeros(E.shape[:3])
    previous = np.zeros(E.shape[:3])
    for k in range(n):
        x = errors.solve(channel, dl - E[..., k])
        db = x + D * p[:, :, None, k]
        other_light = db - own_row[..., k]
        variance[..., k] += _other_rows(errors, channel, previous - x, other_light)
        dl = dl - db
        previous = x
    return variance


def compensation_std(
    T: Transport,
    noise: Noise,
    pattern: np.ndarray,
    bounds: tuple[float, float] = (-np.inf, np.inf),
    inverse: Inverse | None = None,
    systems: Sequence[tuple[Operator, np.ndarray]] = (),
    weights: Sequence[np.ndarray] | None = None,
) -> CompensationStd:
    """Standard deviations of a pattern that was clipped to `bounds`, and of the picture under it.

    If the pattern is the best one within bounds, `systems` and `weights` are the operators with
    their scales and the weights of its least squares problem, as `ltcl.compensate` has them.
    """
    errors = entry_errors(T, noise, inverse)
    columns, shape = layout.unpack("pattern", pattern, T.grid, T.channels)
    is_free = []
    for light in columns:
        is_inside = (bounds[0] < light) & (light < bounds[1])
        is_free.append(is_inside & ~T.masked[:, None])
    picture_variances = _picture_variances(errors, columns)
    appearance = shape.pack(list(np.sqrt(picture_variances)), T.camera_grid)
    if systems:
        free = is_free
        if len(systems) < T.channels:
            # One coupled system of all channels, channel below channel.
            free = [np.concatenate(is_free)]
            picture_variances = [np.concatenate(picture_variances)]
        variances = _bounded_variances(errors, picture_variances, free, systems, weights)
        if len(systems) < T.channels:
            variances = np.split(variances[0], 3)
    else:
        variances = _unbounded_variances(errors, picture_variances, is_free)
    deviations = []
    for variance, free_pixels in zip(variances, is_free, strict=True):
        deviations.append(np.sqrt(variance * free_pixels))
    return CompensationStd(
        shape.pack(deviations, T.grid).astype(np.float32), appearance.astype(np.float32)
    )


def _picture_variances(errors: EntryErrors, columns: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Variances (M, k) of the picture of each channel under a pattern."""
    T = errors.T
    if T.blocks is not None:
        patterns = [np.concatenate(columns)] * 3
    elif T.mixing is not None:
        patterns = np.einsum("cd,dnk->cnk", T.mixing, np.stack(columns))
    else:
        patterns = list(columns)
    variances = []
    for channel, light in enumerate(patterns):
        q = errors.covariance(channel, light[..., None].astype(np.float64))
        variances.append(np.maximum(q[..., 0, 0], 0.0))
    return variances


def _unbounded_variances(
    errors: EntryErrors, picture_variances: Sequence[np.ndarray], is_free: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Variances (N, k) of the pattern F^-1 S^-1 d of each channel."""
    T = errors.T
    random = np.random.default_rng(0)
    variances = []
    for channel, variance in enumerate(picture_variances):
        scale = np.atleast_2d(T.first_bounce)[channel]
        pictures = variance.shape[1]
        light = np.empty(is_free[channel].shape)
        for group in _groups(pictures):
            e = _draw_light(variance[:, group], _draw_count(pictures), random)
            x = errors.solve(channel, e)
            other_rows = _other_rows(errors, channel, x, x - e)
            light[:, group] = variance[:, group] + other_rows
        variances.append(ratio(light, scale[:, None] ** 2))
    if T.mixing is None:
        return variances
    unmixing = np.linalg.inv(T.mixing)
    return list(np.einsum("cd,dnk->cnk", unmixing**2, np.stack(variances)))


def _bounded_variances(
    errors: EntryErrors,
    picture_variances: Sequence[np.ndarray],
    is_free: Sequence[np.ndarray],
    systems: Sequence[tuple[Operator, np.ndarray]],
    weights: Sequence[np.ndarray] | None,
) -> list[np.ndarray]:
    """Variances (N, k) of the pattern that is the best within bounds, for each system."""
    T = errors.T
    # Only S of one channel has a closed form.
    has_closed_form = T.is_square and not T.couples
    random = np.random.default_rng(0)
    variances = []
    for number, (A, scale) in enumerate(systems):
        variance = picture_variances[number]
        pictures = variance.shape[1]
        free = is_free[number] & (scale > 0)[:, None]
        w = np.ones(variance.shape)
        if weights:
            w = np.broadcast_to(weights[number], variance.shape)
        draws = DRAWS_WITHOUT_CLOSED_FORM
        if has_closed_form:
            draws = _draw_count(pictures)
        light = np.empty(free.shape)
        for group in _groups(pictures):
            e = _draw_light(variance[:, group], draws, random)
            is_free_now = free[:, group, None]
            x = least_squares(A, e, is_free_now, w[:, group, None], rtol=SOLVE_RTOL)
            if has_closed_form:
                other_rows = _other_rows(errors, number, x, x - e)
                light[:, group] = variance[:, group] + other_rows
            else:
                light[:, group] = np.mean(x**2, axis=-1)
        variances.append(ratio(light, scale[:, None] ** 2))
    return variances


def _other_rows(errors: EntryErrors, channel: int, z: np.ndarray, Rz: np.ndarray) -> np.ndarray:
    """Mean square (N, k) over draws of R z (N, k, draws), beyond the share of the noise of R."""
    F = np.atleast_2d(errors.T.first_bounce)[channel][:, None]
    mean_square = ratio(np.mean(z**2, axis=-1), F**2)
    noise_of_R = errors.variance(channel, mean_square)
    # Plus one standard deviation of a mean square of so many draws.
    scatter = (2.0 / z.shape[-1]) ** 0.5
    return np.maximum(np.mean(Rz**2, axis=-1) - (1.0 + scatter) * noise_of_R, 0.0)


def _draw_count(pictures: int) -> int:
    return DRAWS if pictures == 1 else FRAME_DRAWS


def _groups(pictures: int) -> Iterator[slice]:
    for start in range(0, pictures, PICTURES_PER_SOLVE):
        yield slice(start, start + PICTURES_PER_SOLVE)


def _draw_light(variance: np.ndarray, draws: int, random: np.random.Generator) -> Any:
    """Independent random errors (M, k, draws) of variances (M, k)."""
    return draw_errors(variance[..., None, None], draws, random)[..., 0]


def draw_errors(q: np.ndarray, draws: int, random: np.random.Generator) -> np.ndarray:
    """Random errors (M, k, draws, n) of the covariances q (M, k, n, n)."""
    # Cholesky's method for all pixels at once; a pivot that is rounding is no direction.
    n = q.shape[-1]
    roots = np.zeros(q.shape)
    rest = q.copy()
    for column in range(n):
        pivot = rest[..., column, column]
        pivot = np.where(pivot > VARIANCE_ROUNDING * q[..., column, column], pivot, 0.0)
        root = ratio(rest[..., column], np.sqrt(pivot)[..., None])
        roots[..., column] = root
        rest -= root[..., None] * root[..., None, :]
    normal = random.standard_normal((*q.shape[:2], draws, n))
    return normal @ np.swapaxes(roots, -1, -2)
