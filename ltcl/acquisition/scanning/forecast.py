# SPDX-License-Identifier: BSD-3-Clause
"""Errors of pictures and bounces caused by the noise of a scan, by parametric bootstrap: without a truth.

The scan is repeated in numbers. Under its patterns p the camera would see T p, with the noise measured by the
calibration; decoded as the scan was, this gives T' = T + E. Only products with E and its diagonal are kept.
Errors shared by many entries (of the ambient light, of row sums) are drawn as such. The light that cells of
an adaptive scan leave smooth is estimated by what a scan with twice the threshold would lose more.

To first order a picture T p has the error E p, also one compensated by p if nothing is clipped. For bounces
(eq. 27), with F = diag(T), D = diag(E) F^-1 and X = S^-1 = F T^-1, the unit of light cancels:

    b_k = X l^(k),                            l^(k+1) = l^(k) - b_k
    db_k = X (dl^(k) - E F^-1 b_k) + D b_k,    dl^(k+1) = dl^(k) - db_k,    dl^(0) = 0

A camera that shows the parts q_y and q_x of a pixel's light at its neighbours (`Sharpness.errors`) adds to a
picture c about q_y (c - mean of c above and below) + q_x (c - mean of c left and right).

Known limits: thresholds, response, black offset and projector curve are taken as exact (`Report.beside_white`
shows errors of the response); blur is underestimated where the picture is blurred already.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage
import scipy.sparse

from ltcl import checks, layout
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.radiometry import Radiance, Response
from ltcl.acquisition.scanning import adaptive, codes, core
from ltcl.acquisition.scanning.pictures import UNKNOWN, Picture, Seen
from ltcl.errors import FileError
from ltcl.solvers import solve_each
from ltcl.store import BlockStore, StoredRows, load
from ltcl.transport import Transport

DRAWS = 16
_RTOL = 1e-3  # of solves: errors of T are larger
_TABLE = 4096  # radiances at which variances are tabulated
_COARSER = 2.0  # times the threshold: loses as much again as the threshold has, in proportion to it


@dataclass(frozen=True, repr=False, eq=False)
class Forecast:
    """Result of `forecast_bounces`: standard deviations, in the unit of the image.

    Attributes
    ----------
    direct, bounces : array
        Of the direct part, as the image, and of each indirect bounce, (bounces, ...); float32.
    rms : array, (1 + bounces,)
        Root mean square over all pixels, the direct part first.
    draws : int
        Simulated scans: each deviation has a relative error of about 1 / sqrt(2 draws).
    """

    direct: np.ndarray
    bounces: np.ndarray
    rms: np.ndarray
    draws: int

    def __repr__(self) -> str:
        errors = ", ".join(f"{value:.2g}" for value in self.rms)
        line = f"<ltcl Forecast of {self.draws} draws: rms error of direct part and bounces {errors}"
        return textwrap.shorten(line, 108, placeholder=" ...") + ">"


class Errors(NamedTuple):
    """Draws of E of one channel: E W (draws, N, k) and diag(E) (draws, N)."""

    product: np.ndarray
    diagonal: np.ndarray


def forecast_bounces(
    store: str | os.PathLike[str] | BlockStore,
    image: Any,
    bounces: int = 3,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    device: Any = None,
) -> Forecast:
    """Errors of `ltcl.separate` with the transport of a store, caused by the noise of its scan.

    Parameters
    ----------
    store : BlockStore or path
        Of a finished scan by `ltcl.acquire`, else FileError.
    image : (h, w), (h, w, 3), or frames of these
        The picture to be separated, taken without noise; its first bounce is the diagonal of T.
    bounces, device
        As in `ltcl.separate` and `ltcl.load`.
    draws, seed : int
        Simulated scans; each takes about the time of decoding.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> truth = ltcl.scenes.dihedral(4, albedo=0.6).transport()
    >>> rig, path = VirtualRig(truth, truth.grid, bits=12), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=path)
    >>> forecast = forecast_bounces(path, truth @ np.ones(truth.grid), bounces=1)
    >>> forecast.bounces.shape, bool(0 < forecast.rms[0] < 0.02)
    ((1, 4, 8), True)
    """
    scan, T = _open(store, device)
    checks.count("bounces", bounces, least=0)
    checks.count("draws", draws)
    light, shape = layout.unpack("image", image, T.grid, T.channels)
    N, k = light[0].shape
    F = np.atleast_2d(T.first_bounce)
    inverse = np.divide(1.0, F, out=np.zeros(F.shape), where=F > 0)[..., None]

    b, left = [], [part.astype(np.float64) for part in light]
    for _ in range(bounces + 1):
        b.append([solution.x.astype(np.float64) for solution in solve_each(T.systems, left, rtol=_RTOL)])
        left = [l - b_k for l, b_k in zip(left, b[-1], strict=True)]
    W = [np.concatenate([inverse[c] * b_k[c] for b_k in b], axis=1) for c in range(T.channels)]
    E = draw_errors(scan, W, draws, seed)

    deviations, dl = [], [np.zeros((draws, N, k)) for _ in E]
    for n, b_n in enumerate(b):
        sides = [l - e.product[..., n * k : (n + 1) * k] for l, e in zip(dl, E, strict=True)]
        flat = [side.swapaxes(0, 1).reshape(N, draws * k) for side in sides]
        db = [part.x.reshape(N, draws, k).swapaxes(0, 1) for part in solve_each(T.systems, flat, rtol=_RTOL)]
        db = [db[c] + E[c].diagonal[..., None] * inverse[c] * b_n[c] for c in range(T.channels)]
        dl = [l - d for l, d in zip(dl, db, strict=True)]
        deviations.append(shape.pack([_rms(d) for d in db], T.grid).astype(np.float32))
    rms = np.array([_rms(part.ravel()) for part in deviations])
    direct, *others = deviations
    return Forecast(direct, np.reshape(others, (bounces, *direct.shape)).astype(np.float32), rms, draws)


def forecast_picture(
    store: str | os.PathLike[str] | BlockStore,
    pattern: Any,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    device: Any = None,
) -> np.ndarray:
    """Errors of T p caused by the noise of the scan and the blur of its camera; float32, as the pattern.

    `pattern` is (h, w), (h, w, 3), or frames of these; with one found by `ltcl.compensate` it is the error of
    the picture on the wall. The rest is as in `forecast_bounces`.
    """
    scan, T = _open(store, device)
    checks.count("draws", draws)
    light, shape = layout.unpack("pattern", pattern, T.grid, T.channels)
    if T.mixing is not None:
        light = list(np.einsum("cd,dnk->cnk", T.mixing, np.stack(light)))
    noise = [_rms(errors.product) for errors in draw_errors(scan, light, draws, seed)]
    sharpness = Seen.of(scan).sharpness
    if sharpness is not None:
        known = ~T.masked.reshape(*T.grid, 1)
        shown = [(A @ p).reshape(*T.grid, -1) for A, p in zip(T.matrices, light, strict=True)]
        y, x = sharpness.errors
        blur = [y * _detail(c, known, 0) + x * _detail(c, known, 1) for c in shown]
        noise = [np.hypot(part, c.reshape(part.shape)) for part, c in zip(noise, blur, strict=True)]
    return shape.pack(noise, T.grid).astype(np.float32)


def _open(store: str | os.PathLike[str] | BlockStore, device: Any) -> tuple[BlockStore, Transport]:
    scan = store if isinstance(store, BlockStore) else BlockStore.open(store)
    if not scan.final or "strategy" not in scan.attributes:
        raise FileError(f"{scan.path}: is not a finished scan by ltcl.acquire; a forecast needs one")
    return scan, load(scan.path, on_dark="mask", device=device)


def _rms(draws: np.ndarray) -> Any:
    return np.sqrt(np.mean(np.square(draws, dtype=np.float64), axis=0))


def _detail(c: np.ndarray, known: np.ndarray, axis: int) -> Any:
    """Pictures (h, w, k) less the mean of the two neighbours along an axis, of those that are known."""
    total, count = (
        scipy.ndimage.correlate1d(part, [1.0, 0.0, 1.0], axis, mode="constant")
        for part in (np.where(known, c, 0.0), known.astype(float))
    )
    return np.where(known & (count > 0), c - total / np.maximum(count, 1.0), 0.0)


def draw_errors(store: BlockStore, W: list[np.ndarray], draws: int, seed: int = 0) -> list[Errors]:
    """Draws of E for the transport of a finished scan; W (N, k) and a result for each channel."""
    rng = np.random.default_rng(seed)
    if store.attributes["strategy"] == "adaptive":
        return _draw_cells(store, W, draws, rng)
    camera = SimulatedCamera.of(store)
    return [_draw_columns(store, camera, c, W[c], draws, rng) for c in range(camera.channels)]


class SimulatedCamera(Seen):
    """The camera of a scan with the noise that its calibration measured."""

    def __init__(self, calibration: Calibration, side: int = 1) -> None:
        super().__init__(calibration, side)
        ones = np.ones(calibration.white.value.shape, np.float32)
        average = self._on_grid(Radiance(ones, ones, ones > 0)).variance
        self._share = np.where(average < UNKNOWN, average, 0.0)  # of a pixel's variance, left by averaging
        top = max(2.0 * float(np.max(self.white.value * self._scale + self._dark.value)), 1e-6)
        self._radiance = top * np.linspace(0.0, 1.0, _TABLE) ** 2
        self._table = [_merged_variance(calibration, self._radiance, c) for c in range(self.channels)]

    def variance(self, light: np.ndarray, c: int) -> np.ndarray:
        """Of pictures of channel c, for (..., M) light relative to white; 0 where nothing is seen."""
        L = light * self._scale[c] + self._dark.value[c]
        merged = np.interp(L, self._radiance, self._table[c]) * self._share[c] / self._scale[c] ** 2
        return np.where(self.seen, merged, 0.0)

    def draw_dark(self, rng: np.random.Generator) -> np.ndarray:
        """Error of the ambient light (channels, M), which is subtracted from every picture."""
        return rng.standard_normal(self.ambient.shape) * np.sqrt(self.ambient)

    def draw_white(self, rng: np.random.Generator) -> np.ndarray:
        """Error of white (channels, M), without that of the ambient light."""
        known = np.where(self.white.variance < 1e-3 * UNKNOWN, self.white.variance, 0.0)
        own = np.maximum(known - self.ambient, 0.0)
        return rng.standard_normal(own.shape) * np.sqrt(own)


def _merged_variance(calibration: Calibration, radiance: np.ndarray, c: int) -> np.ndarray:
    """1 / sum_k t_k^2 / V(L t_k) over the exposures that do not saturate; of the shortest if all do."""
    response = Response(calibration.response.values[c % calibration.response.channels])
    offset, noise, shortest = calibration.offset[c], calibration.noise, min(calibration.exposures)
    precision = np.zeros(radiance.shape)
    for t in calibration.exposures:
        x = radiance * t
        usable = (x + offset < noise.saturation) | (t == shortest)
        precision += usable * t**2 / noise.variance(x, response.derivative(response.codes(x + offset)))
    return 1.0 / precision


def _draw_columns(
    store: BlockStore, camera: SimulatedCamera, c: int, W: np.ndarray, draws: int, rng: np.random.Generator
) -> Errors:
    """Batch by batch, then the correction of row sums by white, for which W has a column of ones more."""
    code = codes.code_of(store.attributes["strategy"], camera.grid, store.attributes["settings"]["order"])
    T, N = scipy.sparse.csc_array(StoredRows(store, c).tocsr()), len(W)
    W = np.concatenate([W, np.ones((N, 1))], axis=1)
    dark = [camera.draw_dark(rng)[c] for _ in range(draws)]
    product, diagonal = np.zeros((draws, *W.shape)), np.zeros((draws, N))
    weight, weight_diagonal = np.zeros(W.shape), np.zeros(N)
    for start in range(0, N, code.size):
        here = slice(start, min(start + code.size, N))
        count = here.stop - start
        v = camera.variance(code.patterns(count).astype(np.float32) @ T[:, here].toarray().T, c)
        root = np.sqrt(v).astype(np.float32)
        for d in range(draws):
            noise = root * rng.standard_normal(v.shape, np.float32) - dark[d]
            E = code.decode(noise, v, camera.ambient[c])[0][:count]
            product[d] += E.T @ W[here]
            diagonal[d, here] = E[:, here].diagonal()
        entry_variance = code.decode(v, v, camera.ambient[c])[1][:count]
        weight += entry_variance.T @ W[here]
        weight_diagonal[here] = entry_variance[:, here].diagonal()
    share = 1.0 / np.maximum(weight[:, -1] + camera.white.variance[c], 1e-300)
    for d in range(draws):
        excess = share * (camera.draw_white(rng)[c] - dark[d] - product[d, :, -1])
        product[d] += excess[:, None] * weight
        diagonal[d] += excess * weight_diagonal
    return Errors(product[..., :-1], diagonal)


class _CoreCamera(SimulatedCamera):
    """Pictures of the transport of an adaptive scan (`adaptive.Source`); without noise if `rng` is None."""

    def __init__(self, calibration: Calibration, T: core.Stored, rng: np.random.Generator | None) -> None:
        super().__init__(calibration)
        self._core, self._rng = T, rng
        self._dark_error = np.zeros(self.ambient.shape) if rng is None else self.draw_dark(rng)
        error = (0.0 if rng is None else self.draw_white(rng)) - self._dark_error
        white = T.product(np.ones(self.grid)) + error
        self.white = Picture(np.where(self.seen, white, 0.0), self.white.variance)

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        """Nothing to prepare."""

    def take(self, patterns: list[np.ndarray]) -> list[Picture]:
        """Pictures of the next patterns."""
        pictures = []
        for pattern in patterns:
            light = self._core.product(pattern)
            v = np.stack([self.variance(part, c) for c, part in enumerate(light)])
            noise = 0.0 if self._rng is None else np.sqrt(v) * self._rng.standard_normal(v.shape)
            value = np.where(self.seen, light + noise - self._dark_error, 0.0)
            pictures.append(Picture(value, np.where(self.seen, v, UNKNOWN)))
        return pictures


def _draw_cells(store: BlockStore, W: list[np.ndarray], draws: int, rng: np.random.Generator) -> list[Errors]:
    """Each draw divides its cells anew; the light that cells leave smooth is added with either sign."""
    calibration, T, settings = Calibration.of(store), core.Stored.of(store), store.attributes["settings"]
    sums = [np.stack([T.cells.sums(w) for w in part.T], axis=1) for part in W]

    def scan(rng: np.random.Generator | None, coarser: float = 1.0) -> list[Errors]:
        camera = _CoreCamera(calibration, T, rng)
        C = adaptive.scan(camera, camera, coarser * settings["threshold"], settings["sigmas"]).core.matrices()
        E = [new - old for new, old in zip(C, T.matrices, strict=True)]
        return [Errors(e @ w, core.diagonal(T.cells, e)) for e, w in zip(E, sums, strict=True)]

    smooth, drawn = scan(None, _COARSER), [scan(rng) for _ in range(draws)]
    sign = rng.choice([-1.0, 1.0], (draws, 1))
    return [
        Errors(
            np.stack([d[c].product for d in drawn]) + sign[..., None] * s.product,
            np.stack([d[c].diagonal for d in drawn]) + sign * s.diagonal,
        )
        for c, s in enumerate(smooth)
    ]
