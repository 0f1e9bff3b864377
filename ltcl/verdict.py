# SPDX-License-Identifier: BSD-3-Clause
"""What a measured T is good for, why not for more, and what to do: two sentences that follow from numbers.

A picture T p has errors E p, of variance sum_j v_ij p_j^2 by `T.noise`. Of bounces under white, b_0 = F 1 and
b_k = A^k b_0, errors are E F^-1 (b_(k-1) - b_k) to first order, without the diagonal of E, as S^-1 hardly
changes noise; A = I - S^-1 acts in a Krylov space. Within a factor of 2, of diffuse scenes, below 50 %.

Damages are numbers with limits. Of flat walls the smallest indirect light between parts of the picture
bounced twice or more, a share rho / (1 + rho) of it at most; what is more is ambient light. T alone cannot
tell, since another scene has the same T: a gain of entries, camera pixels or colours; light that changes
slowly during a scan (`sum_deviation` does); saturation without noise; three channels exchanged as a whole;
light of one colour in another without `mixing` or blocks; little ambient light, or in a closed bright room.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import diagnostics
from ltcl.errors import InputError
from ltcl.transport import Transport, require

_STEPS, _ENTRIES = 7, 1 << 24  # of the Krylov space; to read of a channel
_LEAST = 64  # pixels: fewer have no parts
_PARTS = 6  # of a row of the grid, over which noise averages out
_CLOSED = 0.75  # albedo of closed rooms at most
_NORMAL, _MARGIN = 0.6745, 1.5  # median of |normal values| in standard deviations; of an estimated noise

# By importance: a number, beyond what it is named, spoils compensation, spoils bounces; cause, what to do.
_DAMAGES: dict[str, tuple[float, float, float, str, str]] = {
    "other_grid": (0, 0, 0, "T fits a grid of {where} pixels better", "give --grid {where}"),
    "exchanged": (0, 0, 0, "colour channels look exchanged, {where}", "put them in one order"),
    "shifted": (0.2, 0.2, 0.2, "{p} of pixels are brightest {where} away", "align camera and projector"),
    "hot_rows": (
        0,
        0,
        0,
        "{n} hot camera pixel(s){where} see the same in all patterns",
        "mask or replace them",
    ),
    "saturated": (2, 2, 2, "{n} entries of T{where} saturate at one value", "take shorter exposures, too"),
    "saturation": (0.01, 0.01, 0.01, "{p} of the camera saturates", "take shorter exposures, too"),
    "sum_deviation": (
        0.03,
        0.03,
        0.03,
        "row sums deviate by {p} from white: drift",
        "warm up, and scan again",
    ),
    "ambient": (0.05, 0.05, 0.05, "{p} of the indirect light is ambient light left in T", "subtract black"),
    "offset": (0.02, 0.02, 0.02, "T has a negative offset, {p} of its mean light", "subtract less black"),
    "flicker": (0.02, 0.02, 0.02, "the light drifted by {p} from column to column", "scan again"),
    "outliers": (0, 0.02, 0, "outliers{where} change pictures by {p}", "measure these pixels again"),
    "bounce_highest": (1, 1, 1, "pixels return {p} of their light", "check black level and exposures"),
    "irreciprocal": (0.1, 9, 0.1, "T is not reciprocal to {p}, as of gloss", "bounces are approximate"),
    "negative_bounce": (
        0.005,
        9,
        0.005,
        "{p} of a bounce is negative, as of gloss",
        "bounces are approximate",
    ),
    "pictures": (0.02, 0.02, 9, "pictures are uncertain to {p} because of noise{where}", "{more}"),
    "bounces": (0.05, 9, 0.05, "{which} uncertain to {p} because of noise{where}", "{more}"),
    "no_bounces": (0, 9, 0, "bounces need one grid for camera and projector", "acquire T so"),
    "dark": (0, 0.05, 0.05, "{p} of projector pixels{where} stay unlit, too dark", "expose them longer"),
}
_GEOMETRY = {"other_grid", "exchanged", "shifted"}  # bring about most others
_SURFACES = {"bounce_highest", "irreciprocal", "negative_bounce"}  # of a scene where nothing else is wrong


@dataclass(frozen=True)
class Verdict:
    """Result of `verdict`.

    `text` has at most two sentences. T is good for `compensation` and `bounces` where errors by noise are at
    most 2 % in pictures, 5 % in bounces 1 to 3, and no damage spoils them; None where that is unknown.
    `causes` are those of `numbers` that deviate, most important first; docs/cli.md says what each is.
    """

    text: str
    compensation: bool | None = None
    bounces: bool | None = None
    causes: tuple[str, ...] = ()
    numbers: dict[str, float] = field(default_factory=dict)


def verdict(T: Transport, **known: float) -> Verdict:
    """What T is good for; opens no device where T is an array or sparse.

    `known` are further numbers: `negative_bounce` and `bounce_highest` of `ltcl.analyze`; `sum_deviation` and
    `saturation`, a share of the camera's pixels, of a scan.

    Examples
    --------
    >>> import ltcl
    >>> verdict(ltcl.scenes.dihedral(8, albedo=0.6).transport()).text.split(".")[0]
    'Good for compensation and for bounces'
    """
    numbers, places = dict(known), dict[str, str]()
    try:
        require(T, square=False).noise  # noqa: B018 - which is not known where entries are not
    except InputError as error:
        return Verdict(f"Unknown: {error}.", numbers=numbers)
    for name, value, where in [*_structure(T), *(n for c in range(T.channels) for n in _noise(T, c))]:
        if name not in numbers or (value < numbers[name]) == (name == "gain"):
            numbers[name], places[name] = float(value), where
    bad = [k for k in (1, 2, 3) if numbers.get(f"bounce_{k}", 0.0) > _DAMAGES["bounces"][0]]
    which = " and ".join(map(str, bad)).replace("1 and 2 and 3", "1 to 3")
    which = f"bounces {which}" if bad[1:] else f"bounce {which}"
    causes, spoilt = dict[str, tuple[bool, bool, str]](), set[str]()
    for name, (most, *limits, text, advice) in _DAMAGES.items():
        hidden = spoilt if name in _SURFACES else spoilt & _GEOMETRY
        if (value := numbers.get(name, 0.0)) > most and not hidden:
            spoilt |= {name} if value > limits[1] else set()
            exposures = (value / max(most, 1e-9)) ** 2  # noise averages out
            more = f"{_round(exposures)} times as many exposures would bring that to {_round(100 * most)} %"
            facts = {"p": f"{_round(100 * value)} %", "n": _round(value), "where": places.get(name, "")}
            facts["more"] = more if exposures > 4.0 else "4 times as many exposures would halve that"
            facts["which"] = f"{which} {'are' if bad[1:] else 'is'}"
            causes[name] = value > limits[0], value > limits[1], f"{text}: {advice}".format(**facts)
    names = sorted(causes, key=lambda name: not any(causes[name][:2]))
    good = [not any(cause[k] for cause in causes.values()) for k in (0, 1)]
    no = which if [name for name in causes if causes[name][1]] == ["bounces"] else "bounces"
    text = "Good for compensation" + (" and for bounces" if good[1] else f", not for {no}")
    if not good[0]:
        text = "Good for bounces, not for compensation" if good[1] else f"Not good for compensation or {no}"
    errors = [f"{_round(100 * numbers.get(name, 0.0))} % in {name}" for name in ("pictures", "bounces")]
    why = causes[names[0]][2] if names else f"errors by noise are {' and '.join(errors)} at most"
    also = f"; also, {causes[names[1]][2].split(': ')[0]}" if names[1:] else ""
    return Verdict(f"{text}. {why[0].upper()}{why[1:]}{also}.", good[0], good[1], tuple(names), numbers)


def _round(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def _structure(T: Transport) -> Iterator[tuple[str, float, str]]:
    """Grids; and colours by mixing, by blocks between them, or by the first bounce."""
    yield "no_bounces", not T.is_square, ""
    order = np.arange(3)
    if T.is_square and (other := diagnostics.other_grid(T.matrices[0], T.grid)):
        yield "other_grid", 1.0, "{}x{}".format(*other)
    if T.mixing is not None:
        order = np.argmax(np.abs(T.mixing), axis=1)
    elif T.blocks is not None:
        order = np.argmax([[(b @ np.ones(T.shape[1])).sum() for b in row] for row in T.blocks], axis=1)
    elif T.is_square and T.channels == 3 and hasattr(T.matrices[0], "diagonal"):
        diagonal = np.array([matrix.diagonal() for matrix in T.matrices], np.float64)
        lit = ~T.masked & (diagonal > 0).all(axis=0)
        away = np.median(np.abs(np.log(T.first_bounce[:, None, lit] / diagonal[:, lit])), axis=2)
        order = np.where(away.min(axis=1) < 0.5 * away.diagonal(), away.argmin(axis=1), order)
    names = ("red", "green", "blue")
    exchanged = [f"{names[d]} for {names[c]}" for c, d in enumerate(order) if c != d]
    yield "exchanged", len(exchanged), ", ".join(exchanged)


def _noise(T: Transport, c: int) -> Iterator[tuple[str, float, str]]:
    """Errors by noise of a channel, and where they are largest; then what its entries show."""
    noise, matrix = T.noise, T.matrices[c]
    matrix = matrix.tocsr() if hasattr(matrix, "row_blocks") else matrix  # of a store

    def product(x: np.ndarray) -> np.ndarray:  # T x, (M, k)
        return np.asarray(matrix @ x.astype(np.float32), np.float64)

    def variances(squares: np.ndarray) -> np.ndarray:  # v_ij times squares (N, k)
        weights = noise.columns[c][:, None] * squares
        light = noise.photons[c] * product(weights) if noise.photons[c] else 0.0
        variance = noise.rows[c][:, None] * (light + noise.floor[c] ** 2 * weights.sum(axis=0))
        return variance - noise.less_direct(T.first_bounce)[c][:, None] * squares if T.is_square else variance

    def deviation(a: np.ndarray, own: Any = 0.0) -> np.ndarray:
        """Of E a, (M,), less its diagonal, of covariances `own` * a; row sums of E may be those of white."""
        q, q_1, V = variances(np.stack([a * a, a, np.ones(len(a))], axis=1)).T
        u = noise.white[c]
        fixed = np.divide(u - V, V**2, out=np.zeros(len(V)), where=np.isfinite(u) & (V > 0))
        return np.sqrt(np.maximum(q - own * a[: len(q)] + fixed * (q_1 - own) ** 2, 0.0))

    def judged(name: str, error: np.ndarray, light: np.ndarray) -> tuple[str, float, str]:
        doubt = error / np.maximum(np.abs(light), 1e-300)
        worst = np.flatnonzero(doubt > 2.0 * np.median(doubt)) if T.is_square else np.zeros(0)
        size = float(np.linalg.norm(light)) or 1.0
        return name, float(np.linalg.norm(error)) / size, _place(T.grid, worst, F)

    F = np.atleast_2d(T.first_bounce)[c] if T.is_square else np.zeros(0)
    white, of_white = product(np.ones((T.shape[1], 1)))[:, 0], deviation(np.ones(T.shape[1]))
    yield judged("pictures", of_white, white)
    if not T.is_square:
        return
    lit, own, radius = F > 0, noise.diagonal(T.first_bounce)[c], 0.0
    inverse = np.divide(1.0, F, out=np.zeros(len(F)), where=lit)
    space, seen = [np.stack([lit / math.sqrt(lit.sum()), F / np.linalg.norm(F)], axis=1)], []
    for _ in range(_STEPS):  # R^k x and S R^k x, (N, 2) each
        seen.append(product(inverse[:, None] * space[-1]) * lit[:, None])
        radius = float(np.linalg.norm((step := seen[-1] - space[-1])[:, 1]))
        space.append(step / max(radius, 1e-300))
    Q, triangle = np.linalg.qr(np.hstack(seen))

    def undo(b: np.ndarray) -> np.ndarray:  # S^-1 b
        return np.hstack(space[:-1]) @ np.linalg.lstsq(triangle, Q.T @ b, rcond=1e-6)[0]

    light = inverse * undo(lit.astype(np.float64))
    gain = 1.0 / max(float(np.quantile(light[lit], 0.9)), 1e-6 * float(np.abs(light).max()), 1e-30)
    yield "spectral_radius", radius, ""
    yield "gain", gain / max(float(np.median(white[lit])), 1e-300), ""
    yield judged("pictures", deviation(np.clip(gain * light, 0.0, 1.0)) * lit, gain * lit)
    b = F
    for k in (1, 2, 3):
        a, b = inverse * (x := undo(b)), b - x
        yield from (judged(n, deviation(a, own**2 * a) * lit, b) for n in (f"bounce_{k}", "bounces"))
    yield "dark", T.masked.mean(), _place(T.grid, np.flatnonzero(T.masked))
    if isinstance(matrix, (np.ndarray, scipy.sparse.csr_array)) and len(F) >= _LEAST:
        indirect = np.maximum(white - matrix.diagonal(), 1e-300)
        logs = np.log(np.where(lit, indirect * inverse, 1.0)).reshape(T.grid)  # smooth on surfaces
        detail = np.diff(np.diff(logs, axis=0), axis=1) / 2.0 if min(T.grid) > 1 else np.zeros(1)
        doubt = _MARGIN * float(np.median(np.hypot(of_white / indirect, own * (inverse + 1.0 / indirect))))
        change = float(np.median(np.abs(detail))) / _NORMAL
        yield "flicker", math.sqrt(max(change**2 - doubt**2, 0.0)) if doubt < 0.3 else 0.0, ""
        floor = noise.floor[c] * np.sqrt(noise.rows[c] * noise.columns[c].mean())
        power = inverse @ variances(inverse[:, None])[:, 0] - np.sum((own * inverse) ** 2)
        yield from _entries(matrix, F, T.grid, floor, float(power), radius)


def _entries(
    T: Any, F: np.ndarray, grid: tuple[int, int], floor: np.ndarray, power: float, radius: float
) -> Iterator[tuple[str, float, str]]:
    """What rows of T show; noise is `floor` of their dark entries (N,), `power` of F^-1/2 R F^1/2."""
    N, w = len(F), grid[1]
    pick = np.unique(np.linspace(0, N - 1, max(min(N, _ENTRIES // N), 1)).astype(int))
    rows, k = T[pick] if isinstance(T, np.ndarray) else T[pick].toarray(), np.arange(len(pick))
    rows = rows.astype(np.result_type(rows, np.float32), copy=False)
    direct, brightest = rows[k, pick].copy(), rows.argmax(axis=1)
    away = np.where(rows[k, brightest] > np.maximum(direct, 0.0), brightest - pick, 0)
    moves, counts = np.unique(np.append(away[away != 0], N), return_counts=True)
    y = round((step := int(moves[counts.argmax()])) / w)
    yield "shifted", np.mean(away == step), f"{y} rows and {step - y * w} columns"
    lower, top = direct[direct < direct.max()], (rows >= direct.max()).sum(axis=1)
    rows[k, pick] = (rows.sum(axis=1) - direct) / max(N - 1, 1)
    columns = np.add.outer(np.arange(0, N, w), np.unique(np.arange(_PARTS) * w // _PARTS)).ravel()
    groups = np.unique(np.searchsorted(pick, columns).clip(max=len(pick) - 1))
    wide, high = (np.diff(np.append(starts, m)) for starts, m in ((columns, N), (groups, len(pick))))
    level = np.add.reduceat(rows, columns, axis=1).astype(np.float64) / wide
    mean = level.mean(axis=1)
    hot = (mean > 5.0 * np.median(np.abs(mean))) & (level.min(axis=1) > 0.5 * mean)
    yield "hot_rows", hot.sum(), _place(grid, pick[hot])
    top[hot] = level[hot] = 0
    measured = len(np.unique(lower)) > 0.9 * len(lower)  # without noise values repeat everywhere
    yield "saturated", top.sum() * measured, _place(grid, pick[top > 0])
    blocks = np.add.reduceat(level, groups) / high[:, None]
    constant = float(blocks.min(axis=1).mean()) / max(float(blocks.mean()), 1e-300)
    yield "ambient", max(constant - min(radius / (1.0 + radius), _CLOSED), 0.0), ""
    spread = np.sqrt(np.add.reduceat(floor[pick] ** 2, groups) * len(wide) / N) / high
    below = -float(np.quantile(blocks + 5.0 * spread[:, None], 0.02))
    yield "offset", max(below, 0.0) / max(float(np.abs(blocks).mean()), 1e-300), ""
    least = np.where(F > 0, 0.1 * F, np.inf).astype(rows.dtype)
    i, j = np.nonzero((rows > least) & (rows > np.where(hot, np.inf, 10.0 * floor[pick])[:, None]))
    near = [rows[i, np.clip(j + x, 0, N - 1)] for x in (1, -1, w, -w)]
    back = np.searchsorted(pick, j)  # light the other way
    near += [rows[np.clip(y, 0, k[-1]), x] for y, x in ((i - 1, j), (i + 1, j), (back, pick[i]))]
    lone = rows[i, j] > 5.0 * np.max(near, axis=0)
    share = np.linalg.norm(rows[i, j][lone]) / max(float(np.linalg.norm(direct)), 1e-300)
    yield "outliers", float(share), _place(grid, pick[i[lone]])
    rows *= (root := np.divide(1.0, np.sqrt(F), out=np.zeros(N), where=F > 0)).astype(rows.dtype)
    signal = float(np.einsum("ij,ij->i", rows, rows) @ root[pick] ** 2)
    expected = _MARGIN**2 * power * len(pick) / N / max(signal, 1e-300)
    defect = diagnostics.reciprocity_defect(T, F, entries=diagnostics.QUICK)
    yield "irreciprocal", math.sqrt(max(defect**2 - min(expected, 1.0), 0.0)), ""


def _place(grid: tuple[int, int], pixels: np.ndarray, F: np.ndarray | None = None) -> str:
    """The middle of some pixels, in words; dark if F (N,) is less there."""
    if not 0 < len(pixels) < 0.6 * grid[0] * grid[1]:
        return ""
    y, x = np.mean(pixels // grid[1] + 0.5) / grid[0], np.mean(pixels % grid[1] + 0.5) / grid[1]
    words = ["dark"] if F is not None and np.median(F[pixels]) < 0.7 * np.median(F[F > 0]) else []
    words += ["upper"] * bool(y < 0.4) + ["lower"] * bool(y > 0.6)
    words += ["left"] * bool(x < 0.4) + ["right"] * bool(x > 0.6)
    return f" in the {' '.join(words)} part" if words else ""
