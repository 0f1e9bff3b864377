# SPDX-License-Identifier: BSD-3-Clause
"""What a measured T = S F tells of its scene and its measurement: reciprocity, one bounce, energy.

**Reciprocity**, without knowing areas, albedos or gains. Of a Lambertian scene A = W G with G = G^T
by reciprocity of the form factors and W = diag(albedo / area), so that S W = W + W G W + ... is
symmetric, and so is T D with D = F^-1 W: T_ij d_j = T_ji d_i (eq. 4 and 5; only there is the theory
exact for one projector and one camera, section 8.4). Gains of camera or projector pixels join D. As
d is unknown it is fitted; then R = T F^-1 - I is compared with its transpose

    N = D^-1/2 R D^1/2,    defect = ||N - N^T||_F / (sqrt(2) ||N||_F), diagonals left out

which is 0 of a reciprocal T, about e where every entry has independent relative noise e, and 1
where light goes one way only. A view-dependent (glossy) surface breaks it, as does a camera off the
projector's pixels. The fit minimises the same norm to first order: sum N_ij^2 (log d_i - log d_j -
log R_ij / R_ji)^2 with N_ij^2 = R_ij R_ji, a graph Laplacian solved by conjugate gradients.

**One bounce**: of a Lambertian scene I - S^-1 = A (eq. 4), and A takes no light away from anywhere.
One view of glossy surfaces is T = P S F Q (eq. 28, section 8.4); what stands in the place of A then
has negative entries. They are summed between parts of the picture, 4 x 4 rectangles, over whose
pixels the noise of a measurement averages out; within a part, a biased first bounce makes negative
entries, too. Measured: 0 of diffuse boxes, 0.0004 of a path-traced diffuse corner; of a glossy
corner 0.005, 0.013, 0.034 and 0.13 with shares of 0.05, 0.1, 0.2 and 0.4 of glossy reflection.

**Energy**: A 1 = 1 - S^-1 1 costs one solve. Row i of one bounce sums to the albedo of pixel i
times the share of its view that the projector lights, in [0, 1) whatever the areas. Columns of R
sum to what comes back of light from one pixel, at most m / (1 - m) between pixels of equal area
(eq. 14).

**Grid**: rows of T are alike for neighbouring pixels, and jump where a row of pixels ends. On the
right grid, of width w, rows i and i + w are more alike than under any other width at whose ends
they jump. 1 - cosine of the best other width is 0.05 to 0.6 times that of a wrong grid, and at
least 0.96 times that of a right one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import IdentityPlus, Operator
from ltcl.solvers import solve

ALL, QUICK = 1 << 22, 1 << 18  # entries to compare at most, in `analyze` and in passing
_PRODUCT_COST = 16  # of an entry that is found by products, in entries that are read
_STEPS, _RTOL = 200, 1e-10  # of conjugate gradients
_LARGEST = 60.0  # of |log d|: beyond, there is nothing but noise to fit
_PARTS = 4  # along each side of the picture
_PAIRS, _BINS = 32, 64  # rows to compare, columns of these added up: noise averages out
_JUMP, _ALIKE = 2.0, 0.7  # at the ends of rows at least; of another grid at most


# Pixels of a picture whose parts tell ambient light from a bounce, at least.
MIN_AMBIENT_PIXELS = 64


def reciprocity_defect(T: Any, F: np.ndarray, *, entries: int = ALL, seed: int = 0) -> float:
    """The defect of T, (N, N), in the module's first lines; NaN where T does not show its entries.

    Operators of `ltcl.operators` show theirs, at a product for each pixel of the sample.

    Parameters
    ----------
    T : array, csr_array, Operator, or LinearOperator
    F : (N,)
        First bounce; pixels where it is 0 are left out.
    entries, seed : int
        Of a T with more `entries`, the pixels of a random sample that has about so many, from this
        `seed`: any part of a reciprocal T is reciprocal.

    Examples
    --------
    >>> S = np.array([[1.0, 0.2, 0.1], [0.2, 1.0, 0.3], [0.1, 0.3, 1.0]])
    >>> reciprocity_defect(
    ...     np.diag([1.0, 2.0, 3.0]) @ S @ np.diag([0.5, 0.4, 0.3]), np.ones(3)
    ... ) < 1e-6
    True
    >>> round(reciprocity_defect(np.array([[1.0, 0.2], [0.0, 1.0]]), np.ones(2)), 3)
    1.0
    """
    lit, n = np.flatnonzero(F > 0), len(F)
    if hasattr(T, "between"):  # an Operator, or the rows of a store
        pixels = _sample(lit, n**2, n, entries // _PRODUCT_COST, seed)
        R = _indirect(T.between(pixels, pixels), F[pixels])
    elif isinstance(T, (np.ndarray, scipy.sparse.csr_array)):
        count = T.size if isinstance(T, np.ndarray) else T.nnz
        pixels = _sample(lit, count, n, entries, seed)
        dense = isinstance(T, np.ndarray)
        R = _indirect(T[np.ix_(pixels, pixels)] if dense else T[pixels][:, pixels], F[pixels])
    else:
        return float("nan")
    root = np.exp(log_scale(R) / 2)
    N = scipy.sparse.diags_array(1 / root) @ R @ scipy.sparse.diags_array(root)
    whole = scipy.sparse.linalg.norm(N)
    return float(scipy.sparse.linalg.norm(N - N.T) / (np.sqrt(2) * whole)) if whole > 0 else 0.0


def _sample(pixels: np.ndarray, count: int, n: int, entries: int, seed: int) -> np.ndarray:
    """All pixels, or so many at random that about `entries` of the entries lie between them."""
    if count <= entries:
        return pixels
    some = min(len(pixels), int(n * (entries / count) ** 0.5))
    random = np.random.default_rng(checks.count("seed", seed, least=0))
    return np.sort(random.choice(pixels, some, replace=False))


def _indirect(T: Any, F: np.ndarray) -> Any:
    """R without its diagonal, csr_array float64, largest entry 1."""
    R = scipy.sparse.csr_array(T) @ scipy.sparse.diags_array(1.0 / F)
    R = scipy.sparse.csr_array(R - scipy.sparse.diags_array(R.diagonal()))
    return R / (np.abs(R.data).max(initial=0.0) or 1.0)


def log_scale(R: Any) -> np.ndarray:
    """log d of the fit; 0 where a pixel shares no light with others in both directions."""
    light = R.maximum(0.0).tocsr()
    light.eliminate_zeros()
    weight, logs = light.multiply(light.T).tocsr(), light.copy()
    logs.data = np.log(logs.data)
    pull = (weight.multiply(logs) - weight.multiply(logs.T)).sum(axis=1)
    degree = weight.sum(axis=1)
    diagonal = np.where(degree > 0, degree, 1.0)
    laplacian, jacobi = (scipy.sparse.diags_array(d) for d in (diagonal, 1.0 / diagonal))
    x, _ = scipy.sparse.linalg.cg(
        laplacian - weight, np.asarray(pull), rtol=_RTOL, maxiter=_STEPS, M=jacobi
    )
    return np.clip(x, -_LARGEST, _LARGEST)


def negative_bounce(S: IdentityPlus, grid: tuple[int, int]) -> float:
    """Share of light that one bounce between parts of the picture would take away: 0 of a Lambertian scene.

    In [0, 1]; NaN where no method solves with S. A few products with 16 right-hand sides.

    Examples
    --------
    >>> from ltcl.scenes import dihedral
    >>> negative_bounce(dihedral(4).transport().interreflection, (4, 8)) < 1e-3
    True
    """
    try:
        between = between_parts(
            lambda parts: solve(S.as_it_stands(), parts, rtol=1e-3).x, grid, _PARTS
        )
    except ConvergenceError:
        return float("nan")
    light = np.nansum(np.abs(between))
    return float(np.nansum(np.maximum(-between, 0.0)) / light) if light > 0.0 else 0.0


def between_parts(
    inverse: Callable[..., Any], grid: tuple[int, int], side: int, step: int = 1
) -> np.ndarray:
    """Mean light that parts of a picture, `side` squared, get from each `step`-th in a bounce, NaN within."""
    rows, columns = (np.arange(size) * min(side, size) // size for size in grid)
    number = (rows[:, None] * (columns[-1] + 1) + columns).ravel()
    parts = (number[:, None] == np.arange(number[-1] + 1)).astype(
        np.float64
    )  # (N, parts), indicators e
    count, some = parts.sum(axis=0), parts[:, ::step]
    between = parts.T @ (some - inverse(some)) / (count[:, None] * count[::step])  # e A e
    np.fill_diagonal(between[::step], np.nan)
    return between


def ambient(inverse: Callable[..., Any], grid: tuple[int, int], step: int = 1) -> float:
    """Least light of `between_parts` over its mean: no flat wall lights itself, but ambient light does."""
    between = between_parts(inverse, grid, 2 * _PARTS, step)
    least = max(float(np.median(np.nanmin(between, axis=int(step == 1)))), 0.0)
    return least / max(float(np.nanmean(np.abs(between))), 1e-300)


def ambient_share(systems: Sequence[IdentityPlus], grid: tuple[int, int]) -> float:
    """`ambient` of the worst channel, from every 7th part alone; 0 if it is not known.

    Pictures of fewer than 64 pixels have too few parts, and a solve may not converge.
    """
    if grid[0] * grid[1] < MIN_AMBIENT_PIXELS:
        return 0.0
    shares = []
    try:
        for S in systems:
            undo = partial(_undo_coarsely, S.as_it_stands())
            shares.append(ambient(undo, grid, step=7))
    except ConvergenceError:
        return 0.0
    return max(shares)


def _undo_coarsely(S: Operator, light: np.ndarray) -> np.ndarray:
    return solve(S, light, rtol=1e-2).x


def other_grid(T: Any, grid: tuple[int, int]) -> tuple[int, int] | None:
    """A grid of as many pixels that fits T (array or csr_array) clearly better; None where none is known.

    Examples
    --------
    >>> from ltcl.scenes import dihedral
    >>> T = dihedral(8).transport().matrices[0]
    >>> other_grid(T, (8, 16)), other_grid(T, (16, 8))
    (None, (8, 16))
    """
    if not isinstance(T, (np.ndarray, scipy.sparse.csr_array)):
        return None
    n, rng = grid[0] * grid[1], np.random.default_rng(0)
    first = np.arange(0, n, -(-n // _BINS))

    def difference(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """1 - cosine of rows, without the direct light of either pixel."""
        pair = []
        for index in (i, j):
            rows = T[index] if isinstance(T, np.ndarray) else T[index].toarray()
            rows[np.arange(len(i)), i] = rows[np.arange(len(i)), j] = 0.0
            sums = np.add.reduceat(rows, first, axis=1, dtype=np.float64)
            pair.append(sums / (np.linalg.norm(sums, axis=1, keepdims=True) + 1e-300))
        return 1.0 - np.sum(pair[0] * pair[1], axis=1)

    def below(w: int) -> float:
        j = np.where(i + w < n, i + w, i - w) if 2 * w <= n else rng.permutation(n)[: len(i)]
        return float(difference(i, j).mean())

    def jumps(w: int) -> bool:
        pixels = rng.permutation(n - 1)
        last, inner = (pixels[at][:_PAIRS] for at in (pixels % w == w - 1, pixels % w != w - 1))
        usual = np.median(difference(inner, inner + 1))
        return bool(np.quantile(difference(last, last + 1), 0.25) > _JUMP * usual)

    i = rng.permutation(n)[:_PAIRS]
    own = below(grid[1]) - 1e-6  # rounding of float32
    widths = {below(w): w for w in range(2, n) if n % w == 0 and w != grid[1]}
    likely = (w for d, w in sorted(widths.items()) if d < _ALIKE * own and jumps(w))
    return next(((n // w, w) for w in likely), None)


def exchanged_colours(T: Any) -> list[str]:
    """Colours of a Transport that look exchanged, by mixing, blocks between them, or by the first bounce."""
    order = np.arange(3)
    if T.mixing is not None:
        order = np.argmax(np.abs(T.mixing), axis=1)
    elif T.blocks is not None:
        order = np.argmax(
            [[(b @ np.ones(T.shape[1])).sum() for b in row] for row in T.blocks], axis=1
        )
    elif T.is_square and T.channels == 3 and hasattr(T.matrices[0], "diagonal"):
        diagonal = np.array([matrix.diagonal() for matrix in T.matrices], np.float64)
        lit = ~T.masked & (diagonal > 0).all(axis=0)
        away = np.median(np.abs(np.log(T.first_bounce[:, None, lit] / diagonal[:, lit])), axis=2)
        order = np.where(away.min(axis=1) < 0.5 * away.diagonal(), away.argmin(axis=1), order)
    names = ("red", "green", "blue")
    return [f"{names[d]} for {names[c]}" for c, d in enumerate(order) if c != d]


def outliers(
    rows: np.ndarray, pixels: np.ndarray, least: np.ndarray, width: int
) -> tuple[np.ndarray, float]:
    """Pixels and light (2-norm) of entries above `least` that are 5 times as bright as all neighbours.

    `rows` (n, N) of T are of the camera's `pixels`, ascending, on a grid of this width. Neighbours
    are those of the projector's pixel, those of the camera's, and the light the other way.
    """
    (n, N), (i, j) = rows.shape, np.nonzero(rows > least)
    near = [rows[i, np.clip(j + x, 0, N - 1)] for x in (1, -1, width, -width)]
    others = (i - 1, j), (i + 1, j), (np.searchsorted(pixels, j), pixels[i])
    near += [rows[np.clip(y, 0, n - 1), x] for y, x in others]
    lone = rows[i, j] > 5.0 * np.max(near, axis=0)
    return pixels[i[lone]], float(np.linalg.norm(rows[i, j][lone]))


@dataclass(frozen=True)
class Energy:
    """Checks of one channel; NaN where the operator cannot tell, or the solve did not converge.

    Attributes
    ----------
    bounce_lowest, bounce_highest : float
        Smallest and largest row sum of A. No albedo is below the largest; 1 or more, or clearly
        less than 0, is against physics: a wrong first bounce, ambient light left in T, or
        saturation.
    albedo_from_columns : float
        c / (1 + c), c the largest column sum of R: below 1 by form, and the albedo of a closed room
        of equal pixels that returns so much.
    negative_entries : float
        Share of the entries of T below zero.
    negative_light : float
        Their share of the sum of all absolute values.
    """

    bounce_lowest: float
    bounce_highest: float
    albedo_from_columns: float
    negative_entries: float
    negative_light: float

    @property
    def conserved(self) -> bool:
        """Whether every pixel gives back less light than it gets; False where unknown."""
        return self.bounce_highest < 1.0


def check_energy(T: Any, F: np.ndarray, S: IdentityPlus) -> Energy:
    """The energy of T (N, N) with first bounce F (N,), 0 at masked pixels, and its S on the device.

    Examples
    --------
    >>> import ltcl
    >>> scene = ltcl.scenes.box(3, albedo=0.4)  # closed: every row of A sums to 0.4
    >>> T = scene.transport(first_bounce=scene.first_bounce)
    >>> round(check_energy(T.matrices[0], T.first_bounce, T.interreflection).bounce_highest, 2)
    0.4
    """
    lit, ones = F > 0, np.ones(S.shape[0])
    solution = solve(S.as_it_stands(), ones, "chebyshev", rtol=1e-4, maxiter=200, throw=False)
    once = (ones - solution.x)[lit] if solution.converged else np.array([np.nan])  # A 1
    return Energy(float(once.min()), float(once.max()), _from_columns(T, F, lit), *_negative(T, F))


def _from_columns(T: Any, F: np.ndarray, lit: np.ndarray) -> float:
    if not (arrays := isinstance(T, (np.ndarray, scipy.sparse.csr_array))) and not hasattr(
        T, "between"
    ):
        return float("nan")
    try:
        sums = T.sum(axis=0, dtype=np.float64) if arrays else T.rmatvec(np.ones(len(F)))
    except InputError:  # of those that have no transpose
        return float("nan")
    largest = max(float(np.max(sums[lit] / F[lit])) - 1.0, 0.0)
    return largest / (1.0 + largest)


def _negative(T: Any, F: np.ndarray) -> tuple[float, float]:
    if not isinstance(T, (np.ndarray, scipy.sparse.csr_array)):
        return float("nan"), float("nan")
    entries = T if isinstance(T, np.ndarray) else T.data
    below = entries[entries < 0.0]
    lost, total = float(np.abs(below).sum(dtype=np.float64)), float(entries.sum(dtype=np.float64))
    return below.size / F.size**2, lost / (total + 2.0 * lost) if lost else 0.0
