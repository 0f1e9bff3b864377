# SPDX-License-Identifier: BSD-3-Clause
"""What a measured T is good for, why not for more, and what to do: two sentences that follow from numbers.

Errors by noise are those of `ltcl.transport.uncertainty`; S^-1 acts in block Krylov spaces on the
host, without device. Damages are numbers with limits. T alone cannot tell, since another scene has
the same T: a gain of entries, camera pixels or colours; light that changes slowly during a scan
(`sum_deviation` does); saturation without noise; three channels exchanged as a whole; light of one
colour in another without `mixing` or blocks; little ambient light, or any where gloss has bounces
below 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from ltcl.errors import InputError
from ltcl.transport import diagnostics, uncertainty
from ltcl.transport import frames as layout
from ltcl.transport.first_bounce import ENTRIES
from ltcl.transport.transport import Transport, check_transport

_STEPS, _AT_ONCE = 8, 8  # of a solve; right-hand sides
_ENTRIES, _LEAST = 1 << 24, 64  # to read of a channel; pixels: fewer tell neither parts nor noise
_PARTS = 6  # of a row of the grid, over which noise averages out
_NORMAL, _MARGIN = (
    0.6745,
    1.5,
)  # median of |normal values| in standard deviations; of an estimated noise

Number = tuple[str, float, str]  # its name, its value, and where in the picture

# By importance: a number, beyond what it is named, spoils compensation, spoils bounces; cause, what
# to do.
_DAMAGES: dict[str, tuple[float, float, float, str, str]] = {
    "other_grid": (0, 0, 0, "T fits a grid of {where} pixels better", "give --grid {where}"),
    "exchanged": (0, 0, 0, "colour channels look exchanged, {where}", "put them in one order"),
    "shifted": (
        0.2,
        0.2,
        0.2,
        "{p} of pixels are brightest {where} away",
        "align camera and projector",
    ),
    "hot_rows": (
        0,
        0,
        0,
        "{n} hot camera pixel(s){where} see all patterns alike",
        "mask or replace them",
    ),
    "saturated": (
        2,
        2,
        2,
        "{n} entries of T{where} saturate at one value",
        "take shorter exposures, too",
    ),
    "saturation": (0.01, 0.01, 0.01, "{p} of the camera saturates", "take shorter exposures, too"),
    "sum_deviation": (
        0.03,
        0.03,
        0.03,
        "row sums deviate by {p} from white",
        "warm up, and scan again",
    ),
    "ambient": (0.05, 0.05, 0.05, "{p} of a bounce is ambient light left in T", "subtract black"),
    "offset": (
        0.02,
        0.02,
        0.02,
        "T has a negative offset, {p} of its mean light",
        "subtract less black",
    ),
    "flicker": (0.02, 0.02, 0.02, "the light drifted by {p} from column to column", "scan again"),
    "outliers": (
        0,
        0.02,
        0,
        "outliers{where} change pictures by {p}",
        "measure these pixels again",
    ),
    "bounce_highest": (
        1,
        1,
        1,
        "pixels return {p} of their light",
        "check black level and exposures",
    ),
    "irreciprocal": (
        0.1,
        9,
        0.1,
        "T is not reciprocal to {p}, as of gloss",
        "bounces are approximate",
    ),
    "pictures": (0.02, 0.02, 9, "pictures are uncertain to {p} because of noise{where}", "{more}"),
    "bounces": (0.05, 9, 0.05, "{which} uncertain to {p} because of noise{where}", "{more}"),
    "negative_bounce": (
        0.005,
        9,
        0.005,
        "{p} of a bounce is negative, as of gloss",
        "bounces are rough",
    ),
    "no_bounces": (0, 9, 0, "bounces need one grid for camera and projector", "acquire T so"),
    "dark": (
        0,
        0.05,
        0.05,
        "{p} of projector pixels{where} stay unlit, too dark",
        "expose them longer",
    ),
}
_GEOMETRY = {"other_grid", "exchanged", "shifted"}  # bring about most others
_SURFACES = {
    "bounce_highest",
    "irreciprocal",
    "negative_bounce",
}  # of a scene where nothing else is wrong


@dataclass(frozen=True)
class Verdict:
    """Result of `verdict`.

    `text` has at most two sentences. T is good for `compensation` and `bounces` where errors by
    noise are at most 2 % in pictures, 5 % in bounces 1 to 3, and no damage spoils them; None where
    that is unknown. `causes` are those of `numbers` that deviate, most important first;
    docs/reference/json.md lists them.
    """

    text: str
    compensation: bool | None = None
    bounces: bool | None = None
    causes: tuple[str, ...] = ()
    numbers: dict[str, float] = field(default_factory=dict)


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is refused
def verdict(T: Transport, **known: float) -> Verdict:
    """What T is good for; opens no device where T is an array or sparse.

    `known` are further numbers: `negative_bounce` and `bounce_highest` of `ltcl.analyze`;
    `sum_deviation` and `saturation`, a share of the camera's pixels, of a scan; NaN does not count.

    Examples
    --------
    >>> import ltcl
    >>> verdict(ltcl.scenes.dihedral(8, albedo=0.6).transport()).text.split(".")[0]
    'Good for compensation and for bounces'
    """
    numbers, places = {name: x for name, x in known.items() if not math.isnan(x)}, dict[str, str]()
    try:
        if check_transport(T, square=False).noise.source == "estimated" and min(T.shape) < _LEAST:
            raise InputError(
                f"fewer than {_LEAST} pixels do not tell their noise: use ltcl analyze --noise"
            )
        for name, value, where in _numbers(_on_host(T)):
            if not math.isfinite(value):
                raise InputError(
                    f"{name} is {value:g}: check T and its noise for numbers that are too large"
                )
            if name not in numbers or (value < numbers[name]) == (name == "gain"):
                numbers[name], places[name] = float(value), where
    except (InputError, np.linalg.LinAlgError) as error:  # as of compressed entries, without noise
        return Verdict(f"Unknown: {error}.", numbers=numbers)
    bad = [k for k in (1, 2, 3) if numbers.get(f"bounce_{k}", 0.0) > _DAMAGES["bounces"][0]]
    which = f"bounce{'s' * (len(bad) > 1)} {' and '.join(map(str, bad)).replace('1 and 2 and 3', '1 to 3')}"
    causes, spoilt = dict[str, tuple[bool, bool, str]](), set[str]()
    for name, (most, *limits, text, advice) in _DAMAGES.items():
        hidden = spoilt if name in _SURFACES else spoilt & _GEOMETRY
        if (value := numbers.get(name, 0.0)) > most and not hidden:
            spoilt |= {name} if value > limits[1] else set()
            exposures = (value / max(most, 1e-9)) ** 2  # noise averages out
            more = f"{_round(exposures)} times as many exposures would bring that to {_round(100 * most)} %"
            facts = {
                "p": f"{_round(100 * value)} %",
                "n": _round(value),
                "where": places.get(name, ""),
            }
            facts["more"] = (
                more if exposures > 4.0 else "4 times as many exposures would halve that"
            )
            facts["which"] = f"{which} {'are' if bad[1:] else 'is'}"
            causes[name] = value > limits[0], value > limits[1], f"{text}: {advice}".format(**facts)
    names = sorted(causes, key=lambda name: not any(causes[name][:2]))
    good = [not any(cause[k] for cause in causes.values()) for k in (0, 1)]
    no = which if [name for name in causes if causes[name][1]] == ["bounces"] else "bounces"
    text = "Good for compensation" + (" and for bounces" if good[1] else f", not for {no}")
    if not good[0]:
        text = (
            "Good for bounces, not for compensation"
            if good[1]
            else f"Not good for compensation or {no}"
        )
    errors = [
        f"{_round(100 * numbers.get(name, 0.0))} % in {name}" for name in ("pictures", "bounces")
    ]
    why = causes[names[0]][2] if names else f"errors by noise are {' and '.join(errors)} at most"
    also = f"; also, {causes[names[1]][2].split(': ')[0]}" if names[1:] else ""
    return Verdict(
        f"{text}. {why[0].upper()}{why[1:]}{also}.", good[0], good[1], tuple(names), numbers
    )


def _round(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def _numbers(T: Any) -> Iterator[Number]:
    """Of the whole T, and of each channel."""
    yield "no_bounces", not T.is_square, ""
    if T.is_square and (other := diagnostics.other_grid(T.matrices[0], T.grid)):
        yield "other_grid", 1.0, "{}x{}".format(*other)
    exchanged = diagnostics.exchanged_colours(T)
    yield "exchanged", len(exchanged), ", ".join(exchanged)
    for c, matrix in enumerate(T.matrices):
        yield from _pictures(T, c)
        if T.is_square and len(T.masked) >= _LEAST and isinstance(matrix, ENTRIES):
            yield "ambient", diagnostics.ambient(T.systems[c].solve, T.grid), ""
            yield _flicker(T, c)
            yield from _entries(T, c)
    if T.is_square:
        yield from _bounces(T)
        yield "dark", T.masked.mean(), _place(T.grid, np.flatnonzero(T.masked))


class _System(NamedTuple):
    """S = T F^-1 of a channel, (N, N), on the host."""

    T: Any
    F: np.ndarray
    inverse: np.ndarray  # F^-1, 0 where F is

    def matmat(self, x: np.ndarray) -> np.ndarray:
        light = np.asarray(self.T @ (self.inverse[:, None] * x).astype(np.float32), np.float64)
        return light + (self.F == 0)[:, None] * x

    def solve(self, b: np.ndarray) -> np.ndarray:
        """S^-1 b, (N, k), of least residual in block Krylov spaces."""
        if b.shape[1] > _AT_ONCE:
            return np.hstack([self.solve(b[:, :_AT_ONCE]), self.solve(b[:, _AT_ONCE:])])
        basis, first = np.linalg.qr(b)
        H = np.zeros((k := len(first), 0))
        for _ in range(_STEPS):
            x = self.matmat(basis[:, -k:])
            h = basis.T @ x
            q, r = np.linalg.qr(x - basis @ h)
            basis, H = np.hstack([basis, q]), np.block([[H, h], [np.zeros((k, H.shape[1])), r]])
        e = np.pad(first, ((0, len(H) - k), (0, 0)))
        return basis[:, :-k] @ np.linalg.lstsq(H, e, rcond=1e-6)[0]


def _on_host(T: Transport) -> Any:
    """T with matrices and S on the host, as far as `ltcl.transport.uncertainty` and this module need it."""
    host = Transport.__new__(Transport)
    matrices = tuple(
        matrix.tocsr() if hasattr(matrix, "row_blocks") else matrix for matrix in T.matrices
    )
    pairs = zip(matrices, np.atleast_2d(T.first_bounce) if T.is_square else (), strict=False)
    systems = [_System(matrix, f, 1.0 / np.where(f > 0, f, np.inf)) for matrix, f in pairs]
    vars(host).update(vars(T), matrices=matrices, systems=systems)
    return host


def _error(T: Any, c: int, name: str, light: np.ndarray, deviation: np.ndarray) -> Number:
    """The relative one of a picture (M,), and where it is largest."""
    F = T.systems[c].F if T.is_square else np.ones(len(light))
    light, deviation = np.where(F > 0, [light, deviation], 0.0)
    doubt = deviation / np.maximum(np.abs(light), 1e-300)
    place = _place(T.camera_grid, np.flatnonzero(doubt > 2.0 * np.median(doubt)), F)
    relative = float(np.linalg.norm(deviation) / (np.linalg.norm(light) or 1.0))
    return name, relative if np.isfinite(light).all() else math.nan, place


def _deviation(T: Any, c: int, pattern: np.ndarray) -> np.ndarray:
    """Of the picture (M,) under a pattern."""
    return np.sqrt(np.maximum(uncertainty.covariance(T, T.noise, c, pattern[:, None, None]), 0.0))[
        :, 0, 0, 0
    ]


def _pictures(T: Any, c: int) -> Iterator[Number]:
    """Of white, and of a plain picture, as bright as nine tenths of the pixels can be."""
    matrices = [T.matrices[c]] if T.blocks is None else T.blocks[c]
    white = np.sum([matrix @ np.ones(T.shape[1], np.float32) for matrix in matrices], axis=0)
    yield _error(T, c, "pictures", white, _deviation(T, c, np.ones(T.shape[1] * len(matrices))))
    if T.is_square:
        S = T.systems[c]
        light = S.inverse * S.solve(lit := np.sign(S.F)[:, None])[:, 0]
        gain = 1.0 / max(
            float(np.quantile(light[S.F > 0], 0.9)), 1e-6 * float(np.abs(light).max()), 1e-30
        )
        yield "gain", gain / max(float(np.median(white[S.F > 0])), 1e-300), ""
        yield _error(
            T, c, "pictures", gain * lit[:, 0], _deviation(T, c, np.clip(gain * light, 0.0, 1.0))
        )


def _bounces(T: Any) -> Iterator[Number]:
    """Of bounces 1 to 3 under white: b_k = A b_(k-1), b_0 = F."""
    b = [np.atleast_2d(T.first_bounce)]  # (channels, N)
    for _ in range(3):
        b.append(b[-1] - [S.solve(f[:, None])[:, 0] for S, f in zip(T.systems, b[-1], strict=True)])
    shape = layout.PictureLayout(False, None, T.channels == 3)
    pictures = [shape.pack([f[:, None] for f in each], T.grid) for each in b]
    inverse: Any = SimpleNamespace(solve=lambda b, c: SimpleNamespace(x=T.systems[c].solve(b)))
    std = uncertainty.separation_std(T, T.noise, pictures, inverse)
    for k, picture in enumerate(std.bounces, 1):
        for c, deviation in enumerate(layout.unpack("bounces", picture, T.grid, T.channels)[0]):
            yield from (
                _error(T, c, name, b[k][c], deviation[:, 0]) for name in (f"bounce_{k}", "bounces")
            )


def _flicker(T: Any, c: int) -> Number:
    """What differs from column to column in light that is smooth on surfaces, beyond noise."""
    S, ones = T.systems[c], np.ones(T.shape[1])
    deviation, own = _deviation(T, c, ones), T.noise.diagonal(T.first_bounce)[c]
    indirect = np.maximum((S.T @ ones - S.T.diagonal()) * S.inverse, 1e-30)  # in units of F
    logs = np.log(np.where(lit := S.F > 0, indirect, np.nan)).reshape(T.grid)
    detail = np.diff(np.diff(logs, axis=0), axis=1) / 2.0
    doubt = _MARGIN * np.median(
        np.hypot(deviation / indirect, own + own / indirect)[lit] * S.inverse[lit]
    )
    change = float(np.median(np.abs(np.append(detail[np.isfinite(detail)], 0.0)))) / _NORMAL
    return "flicker", math.sqrt(max(change**2 - doubt**2, 0.0)) if doubt < 0.3 else 0.0, ""


def _entries(T: Any, c: int) -> Iterator[Number]:
    """What rows of T show: where they are brightest, at most, all over, and at least."""
    matrix, noise, (N, w) = T.matrices[c], T.noise, (T.shape[1], T.grid[1])
    pick = np.unique(np.linspace(0, N - 1, max(min(N, _ENTRIES // N), 1)).astype(int))
    rows, k = (
        matrix[pick] if isinstance(matrix, np.ndarray) else matrix[pick].toarray(),
        np.arange(len(pick)),
    )
    rows = rows.astype(np.result_type(rows, np.float32), copy=False)
    direct, brightest = rows[k, pick].copy(), rows.argmax(axis=1)
    away = np.where(rows[k, brightest] > np.maximum(direct, 0.0), brightest - pick, 0)
    moves, counts = np.unique(np.append(away[away != 0], N), return_counts=True)
    y = round((step := int(moves[counts.argmax()])) / w)
    yield "shifted", np.mean(away == step), f"{y} rows and {step - y * w} columns"
    lower, top = direct[direct < direct.max()], (rows == direct.max()).sum(axis=1)
    rows[k, pick] = (rows.sum(axis=1) - direct) / max(N - 1, 1)
    columns = np.add.outer(np.arange(0, N, w), np.unique(np.arange(_PARTS) * w // _PARTS)).ravel()
    groups = np.unique(np.searchsorted(pick, columns).clip(max=len(pick) - 1))
    wide, high = (
        np.diff(np.append(starts, m)) for starts, m in ((columns, N), (groups, len(pick)))
    )
    level = np.add.reduceat(rows, columns, axis=1).astype(np.float64) / wide
    mean = level.mean(axis=1)
    hot = (mean > 5.0 * np.median(np.abs(mean))) & (level.min(axis=1) > 0.5 * mean)
    yield "hot_rows", hot.sum(), _place(T.grid, pick[hot])
    top[hot] = level[hot] = 0
    measured = len(np.unique(lower)) > 0.9 * len(lower)  # without noise values repeat everywhere
    yield "saturated", top.sum() * measured, _place(T.grid, pick[top > 0])
    floor = noise.floor[c] * np.sqrt(noise.rows[c] * noise.columns[c].mean())[pick]
    blocks = np.add.reduceat(level, groups) / high[:, None]
    spread = np.sqrt(np.add.reduceat(floor**2, groups) * len(wide) / N) / high
    below = -float(np.quantile(blocks + 5.0 * spread[:, None], 0.02))
    yield "offset", max(below, 0.0) / max(float(np.abs(blocks).mean()), 1e-300), ""
    least = np.maximum(np.where((F := T.systems[c].F) > 0, 0.1 * F, np.inf), 10.0 * floor[:, None])
    least[hot | T.masked[pick]] = np.inf
    lone, light = diagnostics.outliers(rows, pick, least.astype(rows.dtype), w)
    yield "outliers", light / max(float(np.linalg.norm(F[pick])), 1e-300), _place(T.grid, lone)
    yield _irreciprocal(T, c, pick, rows)


def _irreciprocal(T: Any, c: int, pick: np.ndarray, rows: np.ndarray) -> Number:
    """The defect of reciprocity beyond that of noise, both of F^-1/2 R F^1/2."""
    (matrix, F, inverse), own = T.systems[c], T.noise.diagonal(T.first_bounce)[c]
    variances = uncertainty.variance(T, T.noise, c, inverse[:, None])[:, 0]
    power = float(inverse @ variances - np.sum((own * inverse) ** 2)) * len(pick) / len(F)
    light = np.square(rows * np.sqrt(inverse).astype(rows.dtype)).sum(axis=1, dtype=np.float64)
    expected = min(_MARGIN**2 * power / max(float(light @ inverse[pick]), 1e-300), 1.0)
    defect = diagnostics.reciprocity_defect(matrix, F, entries=diagnostics.QUICK)
    return "irreciprocal", math.sqrt(max(defect**2 - expected, 0.0)), ""


def _place(grid: tuple[int, int], pixels: np.ndarray, F: np.ndarray | None = None) -> str:
    """The middle of some pixels, in words; dark if F (N,) is less there."""
    if not 0 < len(pixels) < 0.6 * grid[0] * grid[1]:
        return ""
    y, x = np.mean(pixels // grid[1] + 0.5) / grid[0], np.mean(pixels % grid[1] + 0.5) / grid[1]
    words = ["dark"] if F is not None and np.median(F[pixels]) < 0.7 * np.median(F[F > 0]) else []
    words += ["upper"] * bool(y < 0.4) + ["lower"] * bool(y > 0.6)
    words += ["left"] * bool(x < 0.4) + ["right"] * bool(x > 0.6)
    return f" in the {' '.join(words)} part" if words else ""
