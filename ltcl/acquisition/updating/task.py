# SPDX-License-Identifier: BSD-3-Clause
"""`update`: a finished scan carried over to where projector and lamp stand now, by 12 photographs.

1. the photographs, with the camera as the scan has measured it
2. where the light falls now, and the gain of the lamp, by the old transport (`movement`)
3. the old transport at the new places (`warp`), with the focus there (`focus`), and what it leaves
   of the pictures (`change`)
4. pictures that were not fitted judge it, beside what they said of the scan
5. where they fail, rounds of more photographs, from which these rows are measured again (`match`)

Known limit: the camera and the scene must be where they were.
"""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.acquisition.calibration import Calibration, StoredMap, is_calibrated, stored_map
from ltcl.acquisition.estimation.estimator import BASIS, FIRST_BOUNCE_SIGMAS
from ltcl.acquisition.estimation.windows import ROW_BYTES, functions_of_row
from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.acquisition.radiance import (
    RadiancePicture,
    StoredRadiance,
    completed,
    difference,
    planes,
)
from ltcl.acquisition.rig import Rig, RigError, Shots
from ltcl.acquisition.scanning import sketch
from ltcl.acquisition.scanning.picture_log import BATCH_SIZE
from ltcl.acquisition.scanning.pictures import KNOWN_VARIANCE, UNKNOWN, Picture, ScanGrid
from ltcl.acquisition.scratch import ImageFile
from ltcl.acquisition.session import ProgressFunction, check_same, ignore_progress
from ltcl.acquisition.updating.change import ChangedTransport, with_change
from ltcl.acquisition.updating.focus import Focus, find_focus
from ltcl.acquisition.updating.match import Matches, match_rows
from ltcl.acquisition.updating.movement import (
    Movement,
    MovementFit,
    Views,
    fit_movement,
    no_movement,
    search_shift,
)
from ltcl.acquisition.updating.order import check_order
from ltcl.acquisition.updating.photographs import (
    JUDGES,
    PHOTOGRAPHS,
    UpdateLight,
    all_patterns,
    fitted_patterns,
    judge_places,
    judging_patterns,
    photograph,
    photograph_round,
)
from ltcl.acquisition.updating.warp import HostTransport, known_pixels, row_interpolation
from ltcl.device import open_device
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError
from ltcl.files import as_path
from ltcl.store import BlockStore, CompressedRecord, load
from ltcl.transport import stored
from ltcl.transport.first_bounce import drop_uncertain
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport

logger = logging.getLogger(__name__)

# Strategies of scans that can be carried over: blocks are no pixels of the projector, and direct
# light alone does not explain pictures.
STRATEGIES = ("sketch", "adaptive", "pixel", "hadamard")
# Pixels up to which an adaptive scan can be: its cells do not move by parts of a pixel, so that all
# entries of T are made of them.
MAX_ADAPTIVE_PIXELS = 1 << 12
# Photographs at most: the first ones, and three rounds in which what fails is measured again.
MAX_PHOTOGRAPHS = PHOTOGRAPHS + 3 * BATCH_SIZE
# Largest movement of any pixel, relative to the shorter side of the picture, and how much further a
# shift is searched for, so that one that is too large is found.
MAX_MOVEMENT_SHARE = 1 / 8
SEARCH_RATIO = 1.5
# What the moved transport may leave of pictures at the median pixel; more is another scene, or
# another kind of change.
MAX_MISFIT = 0.1
# Share of the pixels that may be saturated under white, and least light there, relative to that in
# the scan: a lamp does not age by as much.
MAX_SATURATED_SHARE = 0.25
MIN_WHITE_LIGHT = 0.02
# What is left without a movement, relative to that with it, and of the light, up to which there is
# none: one by a hundredth of a pixel leaves about half a percent of the light.
NOTABLE_MISFIT_RATIO = 1.1
NOTABLE_MISFIT = 0.002
# Change of the light of a camera pixel under white, relative to it and beyond the noise, from which
# on it does not see what it saw before.
MAX_WHITE_CHANGE = 0.3
WHITE_SIGMAS = 5.0
# Error of an update that holds, relative to that of the scan for the same pictures; and its error
# if that of the scan is not known.
MAX_ERROR_RATIO = 1.5
MAX_UNKNOWN_ERROR = 0.02
# Cells along each side whose errors are told apart, and the error of one that fails, relative to
# the largest that holds.
CELLS = 8
FAILING_RATIO = 2.0


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Update:
    """A scan that was carried over, and what pictures say of it to which it was not fitted.

    Attributes
    ----------
    transport : Transport
    store : Path
        Folder of the transport.
    photographs : int
    movement : Movement
        Where the light of the old projector pixels comes from now.
    gain : (channels,)
        Light of the lamp, relative to that in the scan.
    masked : int
        Pixels that light places beyond the old picture, that are saturated or covered, or that the
        camera does not tell from others, of which nothing is known.
    measured_again : int
        Pixels whose rows of T failed after the first photographs, and were measured again.
    errors, previous_errors : (judges,)
        Relative error of T p for each of these pictures, and what that was in the scan; NaN where
        a picture has no light, and of a scan that no picture has judged.
    error, previous_error : float
        Their root mean squares.
    bound : float
        What the error of other pictures is below, with a probability of 95 %.
    holds : bool
        Whether `error` is at most 1.5 times that of the scan, or 2 % if that is not known.
    failing : (h, w) bool
        Pixels in cells whose error is twice that or more, also after they were measured again.

    Examples
    --------
    >>> import ltcl, pathlib, tempfile
    >>> from ltcl.acquisition import VirtualRig
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> T = ltcl.scenes.dihedral(8, albedo=0.6).transport()
    >>> options = {"geometry": "aligned", "strategy": "sketch"}
    >>> _ = ltcl.acquire(VirtualRig(T, T.grid, bits=12), store=folder / "scan.zarr", **options)
    >>> aged = VirtualRig([0.9 * T.matrices[0]], T.grid, bits=12)
    >>> updated = ltcl.update(aged, folder / "scan.zarr", store=folder / "updated.zarr")
    >>> updated.photographs, updated.gain.round(2), updated.holds
    (12, array([0.9]), True)
    """

    transport: Transport
    store: Path
    photographs: int
    movement: Movement
    gain: np.ndarray
    masked: int
    measured_again: int
    errors: np.ndarray
    previous_errors: np.ndarray
    error: float
    previous_error: float
    bound: float
    holds: bool
    failing: np.ndarray

    def __repr__(self) -> str:
        return (
            f"<ltcl Update moved by {self.movement.largest:.2g} pixels, error {self.error:.2%}, "
            f"of the scan {self.previous_error:.2%}>"
        )

    def __str__(self) -> str:
        h, w = self.movement.grid
        gains = ", ".join(f"{gain:.3f}" for gain in self.gain)
        moved = "nothing has moved"
        if not self.movement.is_identity:
            down, across = self.shift
            moved = (
                f"moved by {self.movement.largest:.2f} projector pixels at most, in the middle by "
                f"{down:+.2f} rows and {across:+.2f} columns"
            )
        judged = f"error of T p {self.error:.2%} for pictures that it was not fitted to"
        if math.isnan(self.previous_error):
            judged += "; that of the scan is not known"
        else:
            judged += f", {self.previous_error:.2%} in the scan"
        lines = [
            f"{h} x {w} pixels, {self.photographs} photographs; {moved}; "
            f"light {gains} times that of the scan",
            judged,
        ]
        if self.masked:
            lines.append(
                f"{self.masked} pixels ({self.masked / (h * w):.1%}) are masked: they light places "
                "beyond the old picture, are saturated or covered, or the camera does not tell "
                "them from others"
            )
        if self.measured_again:
            lines.append(
                f"{self.measured_again} pixels ({self.measured_again / (h * w):.1%}) failed after "
                f"{PHOTOGRAPHS} photographs, and were measured again"
            )
        lines.append(self.judgement)
        return "\n".join(lines)

    @property
    def shift(self) -> tuple[float, float]:
        """Rows and columns by which the picture has moved over the scene, in its middle."""
        h, w = self.movement.grid
        middle = np.array([(h - 1) / 2.0]), np.array([(w - 1) / 2.0])
        row, column = self.movement.forward(*middle)
        return float(middle[0][0] - row[0]), float(middle[1][0] - column[0])

    @property
    def judgement(self) -> str:
        """A line that says if the update holds, and what must be measured again."""
        place = _place(self.failing)
        if self.holds and place:
            return f"the update holds; but {place}"
        if self.holds:
            return "the update holds"
        advice = "a new scan is needed"
        if self.photographs + BATCH_SIZE <= MAX_PHOTOGRAPHS:
            advice = f"up to {MAX_PHOTOGRAPHS} photographs measure it again"
        if place:
            return f"the update does not hold: {place}; {advice}"
        return f"the update does not hold; {advice}"


def _place(failing: np.ndarray) -> str:
    """The place (h, w) that fails, in words; nothing if there is none."""
    if not failing.any():
        return ""
    rows = np.flatnonzero(failing.any(axis=1))
    columns = np.flatnonzero(failing.any(axis=0))
    return (
        f"{failing.mean():.0%} of the picture fails, in rows {rows[0]} to {rows[-1]} and columns "
        f"{columns[0]} to {columns[-1]}"
    )


def update(
    rig: Rig,
    scan: str | os.PathLike[str],
    *,
    store: str | os.PathLike[str],
    photographs: int = MAX_PHOTOGRAPHS,
    progress: ProgressFunction | None = None,
    device: Any = None,
) -> Update:
    """Carry a finished scan over to where things stand now, by 12 photographs.

    For a projector that was bumped, or a lamp that has aged, while the camera and the scene are as
    they were. The old transport tells what each pattern would look like from another place; that,
    and the gain of the lamp, are fitted to photographs of black, white and seven patterns. Three
    more judge the result. If it does not hold, what fails is measured again, in rounds of 16
    photographs, from which its rows of T are found anew; all others are corrected by them, too.
    The old scan stays as it is.

    Parameters
    ----------
    rig : Rig
        The projector and the camera, as for `ltcl.acquire`. A `FolderRig` must be in a new folder,
        as its old one has old photographs.
    scan : path
        Folder of a finished scan of `ltcl.acquire`: a sketch, one by pixels or S-matrices, or an
        adaptive one of at most 4096 pixels.
    store : path
        Folder of the new transport, where nothing is yet.
    photographs : int
        Photographs at most, 12 or more. Below 28 nothing is measured again.
    progress : function of (str, int, int), optional
        Called with "update", photographs that are done, and all; then with "fit" and rows of T.
    device : Device or str, optional
        As in `Transport`; opened before the first photograph.

    Returns
    -------
    Update
        Its transport is like that of `ltcl.acquire`; pixels that light places beyond the old
        picture, or that the camera does not tell from others, are masked. If it does not hold after
        all photographs, a new scan is needed.

    Raises
    ------
    InputError, InputTypeError, DeviceError
        Bad arguments; a rig of another size; a scan in functions that cannot be moved.
    AcquisitionError
        The rig fails; the projector has moved too far; photographs show another scene.
        `PhotographMissing`: call again with it.
    FileError
        The scan is missing, damaged or not finished; the store exists.

    Examples
    --------
    >>> update(None, "scan.zarr", store="scan.zarr")
    Traceback (most recent call last):
    ltcl.errors.InputError: store is scan.zarr, which is the scan; it must be another folder
    """
    if progress is None:
        progress = ignore_progress
    if not callable(progress):
        raise InputTypeError(
            f"progress is {progress!r}; it must be a function of (str, int, int), or None"
        )
    photographs = checks.count("photographs", photographs, least=PHOTOGRAPHS)
    path = as_path(store, "store")
    if path.resolve() == as_path(scan, "scan").resolve():
        raise InputError(f"store is {path}, which is the scan; it must be another folder")
    if device is not None:
        device = open_device(device)
    if path.exists() and not _is_empty_folder(path):
        raise FileError(f"{path}: exists; store must be a new folder")
    shots = Shots(rig)
    previous = _open_scan(scan)
    _check_rig(previous, shots)
    carried = _carry_over(shots, previous, photographs, progress)
    _write(path, shots, previous, carried)
    judgement = carried.judgement
    result = Update(
        transport=load(path, on_dark="mask", device=device),
        store=path,
        photographs=carried.photographs,
        movement=carried.fit.movement,
        gain=carried.fit.gain,
        masked=carried.masked,
        measured_again=carried.measured_again,
        errors=judgement.errors,
        previous_errors=judgement.previous_errors,
        error=judgement.error,
        previous_error=judgement.previous_error,
        bound=judgement.bound,
        holds=judgement.holds,
        failing=judgement.failing,
    )
    if not result.holds:
        logger.warning("%s", result.judgement)
    return result


@dataclass(frozen=True, eq=False, kw_only=True)
class _Carried:
    """A scan that was carried over.

    `photographs` were taken; `masked` counts the pixels of which nothing is known,
    `measured_again` those whose rows failed at first; `own_variance` is that of the light of each
    pixel's own, (channels, N); `arrays` are those of the transport.
    """

    fit: MovementFit
    calibration: Calibration
    photographs: int
    masked: int
    measured_again: int
    judgement: _Judgement
    own_variance: np.ndarray
    arrays: dict[str, np.ndarray]


def _carry_over(
    shots: Shots, previous: BlockStore, most_photographs: int, progress: ProgressFunction
) -> _Carried:
    """Photograph, and carry the transport of a scan over to where things stand now."""
    T = HostTransport.of(previous)
    mapping = stored_map(previous)
    calibration = Calibration.of(previous)

    # 1. The photographs, on the old pixels.
    seconds = calibration.exposures[0]
    light = photograph(shots, seconds, calibration.camera, progress)
    # At the lowest code of a camera black has no value; longer exposures of the scan have one.
    black = completed(light.black, calibration.ambient, ImageFile())
    light = replace(
        light,
        black=black,
        fitted=_with_dark(light.fitted, black, light.white),
        judging=_with_dark(light.judging, black, light.white),
    )
    old_grid = ScanGrid(calibration)
    unit = _unit_of_light(T, old_grid.white)

    # 2. The movement.
    _check_white(old_grid, light, unit)
    fit = _find_movement(T, old_grid, mapping, light, unit)
    movement = fit.movement

    # 3. and 4. The transport at the new places, and its judges.
    now = _moved_calibration(calibration, mapping, fit, light)
    known = known_pixels(movement) & now.resampling.seen.ravel()
    moved = T
    focus = None
    if not movement.is_identity:
        near = T.around_diagonal()
        focus = find_focus(near, mapping, calibration.resampling, now.resampling, movement)
        moved = T.moved(movement, focus)
    correction = _Correction(
        ScanGrid(now), moved.limited(known).scaled(fit.gain), unit, known, light, previous
    )
    corrected = correction.correct(progress)

    # 5. What fails is measured again.
    photographs = PHOTOGRAPHS
    while not corrected.judgement.holds and photographs + BATCH_SIZE <= most_photographs:
        _tell_round(corrected, photographs, most_photographs)
        number = (photographs - PHOTOGRAPHS) // BATCH_SIZE
        taken = photograph_round(shots, number, seconds, calibration.camera, progress)
        more = _with_dark(taken, black, light.white)
        correction.add(sketch.more_patterns(shots.grid, number), more, corrected.judgement.failing)
        photographs += BATCH_SIZE
        corrected = correction.correct(progress)

    noise = _CarriedNoise(previous, movement, focus, known, fit.gain, corrected.judgement.ratio)
    return _Carried(
        fit=fit,
        calibration=now,
        photographs=photographs,
        masked=int(np.count_nonzero(~correction.known)),
        measured_again=len(correction.failed_rows),
        judgement=corrected.judgement,
        own_variance=noise.own_variance,
        arrays=_arrays(corrected, noise, now.mixing),
    )


def _with_dark(
    pictures: Sequence[StoredRadiance], black: RadiancePicture, white: RadiancePicture
) -> list[StoredRadiance]:
    """Pictures that are black where they are at the lowest code: white is not saturated there."""
    file = ImageFile()
    return [completed(picture, black, file, where=white) for picture in pictures]


def _tell_round(corrected: _Corrected, photographs: int, most: int) -> None:
    """Say why more photographs follow, and how many at most."""
    place = _place(corrected.judgement.failing)
    if not place:
        place = f"the error of T p is {corrected.judgement.error:.1%}"
    logger.warning(
        "after %d photographs %s; %d more measure it again, at most %d in all",
        photographs,
        place,
        BATCH_SIZE,
        most,
    )


def _write(path: Path, shots: Shots, previous: BlockStore, carried: _Carried) -> None:
    """Write the store of a scan that was carried over."""
    description = json.loads(json.dumps(shots.describe(), default=str))
    written = BlockStore.create(
        path,
        channels=shots.channels,
        shape=previous.layout.shape,
        grid=shots.grid,
        provenance={"acquisition": description},
    )
    carried.calibration.write(written)
    if carried.calibration.mixing is not None:
        written.extra("mixing", carried.calibration.mixing)
    written.extra("own_variance", carried.own_variance)
    judgement = carried.judgement
    written.update(
        settings=previous.attributes["settings"],
        plan=previous.attributes["plan"],
        why=f"updated from {previous.path} by {carried.photographs} photographs",
        strategy="sketch",
        patterns=carried.photographs,
        sketch={
            "error": judgement.error,
            "bound": judgement.bound,
            "errors": judgement.errors[np.isfinite(judgement.errors)].tolist(),
        },
        update={
            "of": str(previous.path),
            "coefficients": carried.fit.movement.coefficients.tolist(),
            "gain": carried.fit.gain.tolist(),
            "masked": carried.masked,
            "measured_again": carried.measured_again,
            "holds": judgement.holds,
        },
    )
    written.finalize(compressed=CompressedRecord(carried.arrays))


def _is_empty_folder(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def _open_scan(scan: str | os.PathLike[str]) -> BlockStore:
    """The store of a finished scan on the projector's own pixels."""
    opened = BlockStore.open(scan)
    if not is_calibrated(opened):
        raise FileError(f"{opened.path}: holds no calibration; scan must be made by ltcl.acquire")
    if not opened.final:
        raise FileError(f"{opened.path}: is still being scanned; it must be a finished scan")
    strategy = opened.attributes["strategy"]
    if strategy not in STRATEGIES:
        raise InputError(
            f"scan is {opened.path}, of strategy {strategy!r}; it must be one of "
            f"{', '.join(STRATEGIES)}"
        )
    height, width = Calibration.of(opened).resampling.grid
    if strategy == "adaptive" and height * width > MAX_ADAPTIVE_PIXELS:
        raise InputError(
            f"scan is {opened.path}, an adaptive one of {height} x {width} pixels; it must have at "
            f"most {MAX_ADAPTIVE_PIXELS}, or be a sketch"
        )
    numbers = height * width * functions_of_row((height, width)) * (opened.layout.channels + 1)
    checks.fits_host(f"updating T of {height} x {width} pixels", numbers * ROW_BYTES)
    return opened


def _check_rig(previous: BlockStore, shots: Shots) -> None:
    """Refuse a rig of another size than that of the scan."""
    path = previous.path
    check_same("rig.projector_grid", shots.grid, previous.layout.grid, path, RigError)
    check_same("rig.channels", shots.channels, previous.layout.channels, path, RigError)
    facts = previous.provenance["acquisition"]
    shots.expected = tuple(facts["camera_grid"]), facts["levels"]


def _unit_of_light(T: HostTransport, white: Picture) -> np.ndarray:
    """Light of the pictures of a scan for that of its transport, in each channel, by white."""
    known = white.known.T
    seen = np.where(known, white.value.T, 0.0)
    own = np.where(known, T.products(np.ones((1, len(seen))))[0], 0.0)
    squares = np.maximum((own**2).sum(axis=0), np.finfo(float).tiny)
    return (own * seen).sum(axis=0) / squares


def _judged_errors(pictures: _Pictures, explained: np.ndarray) -> np.ndarray:
    """Error of T p for each picture (k, N, channels), relative to it, less the noise, (k,)."""
    is_known = pictures.variance < KNOWN_VARIANCE
    left = np.where(is_known, pictures.value - explained, 0.0)
    noise = np.where(is_known, pictures.variance, 0.0).sum(axis=(1, 2))
    energy = np.maximum(pictures.squared_light(), np.finfo(float).tiny)
    return np.sqrt(np.maximum((left**2).sum(axis=(1, 2)) - noise, 0.0) / energy)


def _deviations(pictures: _Pictures) -> np.ndarray:
    """Standard deviations by noise of the squares of `_judged_errors`, (k,)."""
    noise = np.where(pictures.variance < KNOWN_VARIANCE, pictures.variance, 0.0)
    energy = np.maximum(pictures.squared_light(), np.finfo(float).tiny)
    return np.array([sketch.deviation_of_squares(variance) for variance in noise]) / energy


def _flat(patterns: Sequence[np.ndarray]) -> np.ndarray:
    """Patterns (k, N) of pictures (h, w)."""
    rows = [np.ravel(pattern) for pattern in patterns]
    return np.stack(rows).astype(np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Pictures:
    """Light less the ambient one, in the units of T, and its variance, (k, N, channels).

    The variance is `UNKNOWN` where nothing is known.
    """

    value: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(
        cls,
        grid: ScanGrid,
        black: StoredRadiance,
        lit: Sequence[StoredRadiance],
        unit: np.ndarray,
        known: np.ndarray | bool = True,
    ) -> _Pictures:
        """Radiance on the pixels of T, as far as these are known, (N,)."""
        dark = grid.picture(black)
        values = []
        variances = []
        for light in lit:
            picture = grid.picture(light)
            is_known = (picture.known & dark.known & known).T
            value = (picture.value - dark.value).T / unit
            variance = (picture.variance + dark.variance).T / unit**2
            values.append(np.where(is_known, value, 0.0))
            variances.append(np.where(is_known, variance, float(UNKNOWN)))
        return cls(value=np.stack(values), variance=np.stack(variances))

    def squared_light(self) -> np.ndarray:
        """The sums of squares of the known light of each picture, (k,)."""
        light = np.where(self.variance < KNOWN_VARIANCE, self.value, 0.0)
        return (light**2).sum(axis=(1, 2))

    def joined(self, others: _Pictures) -> _Pictures:
        """These pictures and others."""
        return _Pictures(
            value=np.concatenate([self.value, others.value]),
            variance=np.concatenate([self.variance, others.variance]),
        )


def _check_white(grid: ScanGrid, light: UpdateLight, unit: np.ndarray) -> None:
    """Refuse photographs of white that are saturated, or hardly brighter than black."""
    white = _Pictures.of(grid, light.black, [light.white], unit)
    was_known = grid.white.known.T
    light_before = np.where(was_known, grid.white.value.T, 0.0) / unit
    was_lit = light_before > MIN_WHITE_LIGHT * light_before.max()
    is_known = was_lit & (white.variance[0] < KNOWN_VARIANCE)
    saturated = 1.0 - np.count_nonzero(is_known) / max(np.count_nonzero(was_lit), 1)
    if saturated > MAX_SATURATED_SHARE:
        raise AcquisitionError(
            f"photographs of white are saturated at {saturated:.0%} of the pixels; there is more "
            "light than in the scan: darken the projector or the room, or scan anew"
        )
    before = light_before[is_known].sum()
    now = white.value[0][is_known].sum()
    if now < MIN_WHITE_LIGHT * before:
        raise AcquisitionError(
            f"photographs have {max(now / before, 0.0):.0%} more light under white than under "
            "black, relative to the scan; was the projector on, and its pattern shown? take them "
            "again"
        )


def _find_movement(
    T: HostTransport,
    grid: ScanGrid,
    mapping: Correspondence,
    light: UpdateLight,
    unit: np.ndarray,
) -> MovementFit:
    """The movement and the gains; AcquisitionError if no small movement explains the pictures."""
    patterns = _flat([np.ones(grid.grid), *fitted_patterns(grid.grid)])
    pictures = _Pictures.of(grid, light.black, [light.white, *light.fitted], unit)
    is_known = pictures.variance < KNOWN_VARIANCE
    views = Views(
        grid=grid.grid,
        patterns=patterns,
        pictures=pictures.value,
        variance=np.where(is_known, pictures.variance, np.inf),
        resampling=grid.calibration.resampling,
        mapping=mapping,
    )
    largest = MAX_MOVEMENT_SHARE * min(grid.grid)
    first = search_shift(views, SEARCH_RATIO * largest)
    fit = fit_movement(views, T.products, first)
    still = no_movement(views, T.products)
    if still.misfit <= NOTABLE_MISFIT_RATIO * fit.misfit + NOTABLE_MISFIT:
        fit = still
    taken = [light.black, light.white, *light.fitted, *light.judging]
    all_pictures = _Pictures.of(grid, light.black, taken, unit)
    # A fit to a picture of another pattern may be off; the search is less so.
    for movement in (first, fit.movement):
        _check_order_of(all_pictures, T, views, movement, fit.gain)
    if fit.typical_misfit > MAX_MISFIT:
        raise AcquisitionError(
            f"no movement of the projector by up to {largest:.1f} pixels explains the photographs: "
            f"{fit.typical_misfit:.0%} of their light is left, where at most {MAX_MISFIT:.0%} may "
            "be; it has moved further, or the camera or the scene has changed; a new scan is needed"
        )
    if fit.movement.largest > largest:
        raise AcquisitionError(
            f"the projector has moved by {fit.movement.largest:.1f} of its pixels; an update "
            f"follows {largest:.1f} at most, an eighth of the picture; a new scan is needed"
        )
    return fit


def _check_order_of(
    pictures: _Pictures, T: HostTransport, views: Views, movement: Movement, gain: np.ndarray
) -> None:
    """Refuse pictures of all photographs of which one shows the pattern of another."""
    lit = views.resampled(movement) @ _flat(all_patterns(views.grid)).T
    is_known = pictures.variance.max(axis=0) < KNOWN_VARIANCE
    check_order(gain * T.products(lit.T), pictures.value, is_known)


def _moved_calibration(
    calibration: Calibration, mapping: Correspondence, fit: MovementFit, light: UpdateLight
) -> Calibration:
    """The calibration with the ambient light and white of now, on the pixels of now."""
    file = ImageFile()
    white = difference(light.white, light.black, file)
    now = replace(calibration, ambient=light.black, white=white, anchor=None)
    if fit.movement.is_identity:
        return replace(now, mapping=StoredMap.of(mapping, file))
    row, column = fit.movement.forward(mapping.y, mapping.x)
    height, width = mapping.grid
    is_in_rows = (row > -0.5) & (row < height - 0.5)
    valid = mapping.valid & is_in_rows & (column > -0.5) & (column < width - 0.5)
    valid &= _lit_as_before(calibration.white, white, fit.gain)
    moved = Correspondence(column, row, valid, mapping.grid)
    resampling = Resampling.of(moved).ascertained_by(planes(white, "value"))
    return replace(now, resampling=resampling, mapping=StoredMap.of(moved, file))


def _lit_as_before(before: RadiancePicture, now: RadiancePicture, gain: np.ndarray) -> np.ndarray:
    """Camera pixels (H, W) that white lights as in the scan, but for the lamp.

    Those just beyond the old picture saw it by light that bounced; they may be in the map all the
    same, and see the new picture itself.
    """
    is_same = np.ones(now.shape[:2], bool)
    values = zip(planes(before, "value"), planes(now, "value"), gain, strict=True)
    noise = zip(planes(before, "variance"), planes(now, "variance"), strict=True)
    for (old, new, factor), (old_variance, new_variance) in zip(values, noise, strict=True):
        light = factor * old
        deviation = np.sqrt(factor**2 * old_variance + new_variance)
        allowed = MAX_WHITE_CHANGE * np.maximum(light, new) + WHITE_SIGMAS * deviation
        is_same &= np.abs(new - light) <= allowed
    return is_same


class _RowCounter:
    """Progress of the rows that are solved, of which there are more than can be foretold."""

    def __init__(self, progress: ProgressFunction, rows: int) -> None:
        self._progress = progress
        # Those that learn the prior are a quarter in each of eight rounds.
        self._expected = 3 * rows
        self._done = 0

    def count(self, rows: int) -> None:
        """Count rows."""
        self._done += rows
        self._progress("fit", self._done, max(self._done, self._expected))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Judgement:
    """The verdict of the judges, as `Update` has it."""

    errors: np.ndarray
    previous_errors: np.ndarray
    error: float
    previous_error: float
    bound: float
    holds: bool
    failing: np.ndarray

    @classmethod
    def of(
        cls,
        T: HostTransport,
        patterns: np.ndarray,
        pictures: _Pictures,
        white: float,
        previous: BlockStore,
    ) -> _Judgement:
        """The judgement on T by pictures of patterns that it was not fitted to.

        `white` is the squared light of white.
        """
        explained = T.products(patterns)
        errors = _judged_errors(pictures, explained)
        is_lit = np.zeros(len(patterns), bool)
        for number, light in enumerate(pictures.squared_light()):
            is_lit[number] = sketch.is_lit_judge(patterns[number], light, white)
        errors = np.where(is_lit, errors, math.nan)
        error = math.sqrt((errors[is_lit] ** 2).mean())
        previous_errors = _previous_errors(previous, T.grid)
        previous_error = math.sqrt((previous_errors[is_lit] ** 2).mean())
        allowed = MAX_UNKNOWN_ERROR
        if not math.isnan(previous_error):
            allowed = MAX_ERROR_RATIO * previous_error
        return cls(
            errors=errors,
            previous_errors=previous_errors,
            error=error,
            previous_error=previous_error,
            bound=sketch.error_bound(error, _deviations(pictures)[is_lit]),
            holds=error <= allowed,
            failing=_failing_cells(T.grid, pictures, explained, FAILING_RATIO * allowed),
        )

    @property
    def ratio(self) -> float:
        """Growth of the errors since the scan, at least 1."""
        if math.isnan(self.previous_error) or self.previous_error == 0.0:
            return 1.0
        return max(self.error / self.previous_error, 1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Corrected:
    """The moved transport with its change, the rows that took the place of others, and judges."""

    changed: ChangedTransport
    matches: Matches | None
    judgement: _Judgement


class _Correction:
    """The moved transport, corrected by all pictures that there are by now.

    Parameters
    ----------
    grid : ScanGrid
        That of now.
    moved : HostTransport
    unit : (channels,)
        Light of pictures for that of the transport.
    known : (N,) bool
        Pixels of which the old scan knows anything, and that the camera sees.
    light : UpdateLight
    previous : BlockStore
    """

    def __init__(
        self,
        grid: ScanGrid,
        moved: HostTransport,
        unit: np.ndarray,
        known: np.ndarray,
        light: UpdateLight,
        previous: BlockStore,
    ) -> None:
        self.known = known
        self._grid = grid
        self._moved = moved
        self._unit = unit
        self._black = light.black
        self._previous = previous
        self._patterns = _flat([np.ones(grid.grid), *fitted_patterns(grid.grid)])
        self._pictures = self._pictures_of([light.white, *light.fitted])
        self._judging = self._pictures_of(light.judging)
        self._is_failed = np.zeros(len(known), bool)

    @property
    def failed_rows(self) -> np.ndarray:
        """Numbers of the rows that failed, and are measured again."""
        return np.flatnonzero(self._is_failed & self.known)

    def add(
        self, patterns: Sequence[np.ndarray], light: Sequence[StoredRadiance], failing: np.ndarray
    ) -> None:
        """Add the pictures of a round, after pixels (h, w) have failed."""
        self._patterns = np.concatenate([self._patterns, _flat(patterns)])
        self._pictures = self._pictures.joined(self._pictures_of(light))
        self._is_failed |= failing.ravel()

    def correct(self, progress: ProgressFunction) -> _Corrected:
        """The transport that the pictures show, and what the judges say of it."""
        T = self._moved
        matches = None
        centres = None
        if self._is_failed.any():
            matches = match_rows(T, self._patterns, self._pictures.value, self.failed_rows)
            T = matches.apply(T)
            centres = matches.centres
        rows = _RowCounter(progress, len(T.cores) * len(self.known))
        changed = with_change(
            T,
            self._patterns,
            self._pictures.value,
            self._pictures.variance,
            self._pictures.value[0],
            rows.count,
            centres,
        )
        shown = _flat(judging_patterns(self._grid.grid))
        white = float(self._pictures.squared_light()[0])
        judgement = _Judgement.of(changed.transport, shown, self._judging, white, self._previous)
        return _Corrected(changed=changed, matches=matches, judgement=judgement)

    def _pictures_of(self, light: Sequence[StoredRadiance]) -> _Pictures:
        return _Pictures.of(self._grid, self._black, light, self._unit, self.known)


def _previous_errors(previous: BlockStore, grid: tuple[int, int]) -> np.ndarray:
    """Errors of a scan, or of an update, for the same pictures; NaN if they are not known."""
    errors = np.array(previous.attributes.get("sketch", {}).get("errors", ()), np.float64)
    if len(errors) == JUDGES:
        return errors
    if len(errors) == sketch.JUDGES:
        return errors[judge_places(grid)]
    # Of a sketch that left out some of its judges, which are not known, the mean.
    error = math.nan
    if len(errors):
        error = math.sqrt((errors**2).mean())
    return np.full(JUDGES, error)


def _failing_cells(
    grid: tuple[int, int], pictures: _Pictures, explained: np.ndarray, most: float
) -> np.ndarray:
    """Pixels (h, w) of cells whose error is above `most`, relative to the mean light of a cell."""
    is_known = pictures.variance < KNOWN_VARIANCE
    left = np.where(is_known, pictures.value - explained, 0.0)
    noise = np.where(is_known, pictures.variance, 0.0)
    light = np.where(is_known, pictures.value, 0.0)
    row, column = np.indices(grid).reshape(2, -1)
    cell = (row * CELLS // grid[0]) * CELLS + column * CELLS // grid[1]
    squares = np.bincount(cell, (left**2 - noise).sum(axis=(0, 2)), CELLS**2)
    energy = np.bincount(cell, (light**2).sum(axis=(0, 2)), CELLS**2)
    typical = energy.sum() / max(np.count_nonzero(energy), 1)
    errors = np.sqrt(np.maximum(squares, 0.0) / np.maximum(energy, max(typical, 1e-30)))
    return (errors > most)[cell].reshape(grid)


class _CarriedNoise:
    """Noise of the scan at the new places, as much larger as the errors are."""

    def __init__(
        self,
        previous: BlockStore,
        movement: Movement,
        focus: Focus | None,
        known: np.ndarray,
        gain: np.ndarray,
        ratio: float,
    ) -> None:
        self._rows = row_interpolation(movement)
        self._gain = gain
        self._ratio = ratio
        names = [name for name in previous.extras if name.startswith("noise_")]
        self._noise = Noise.from_arrays({name: previous.extra(name) for name in names})
        first_bounce = np.atleast_2d(previous.extra("first_bounce"))
        is_there = self._at_new_places(first_bounce > 0)
        light = self._at_new_places(first_bounce) / np.maximum(is_there, 0.5)
        if focus is not None:
            light = light * focus.own_change(self._rows)
        self.first_bounce = np.where(known & (is_there > 0.5), gain[:, None] * light, 0.0)
        variance = self._own_variance(previous, first_bounce)
        self.own_variance = (gain[:, None] * ratio) ** 2 * self._at_new_places(variance)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of the noise; none if the scan has none."""
        if self._noise is None:
            return {}
        scale = self._gain * self._ratio
        rows = self._at_new_places(self._noise.rows)
        columns = self._at_new_places(self._noise.columns)
        carried = replace(
            self._noise,
            photons=self._noise.photons * scale * self._ratio,
            floor=self._noise.floor * scale,
            rows=np.where(rows > 0, rows, 1.0),
            columns=np.where(columns > 0, columns, 1.0),
            white=np.full_like(self._noise.white, np.inf),
        )
        return carried.to_arrays()

    def _own_variance(self, previous: BlockStore, first_bounce: np.ndarray) -> np.ndarray:
        """Variance of each pixel's own light in the scan, (channels, N)."""
        if "own_variance" in previous.extras:
            return np.asarray(previous.extra("own_variance"))
        noise = self._noise
        if noise is None:
            return np.zeros_like(first_bounce)
        light = noise.photons[:, None] * np.maximum(first_bounce, 0.0) + noise.floor[:, None] ** 2
        return light * noise.rows * noise.columns * np.asarray(noise.direct)[:, None]

    def _at_new_places(self, pictures: np.ndarray) -> np.ndarray:
        """Pictures (channels, N) on the pixels of now; 0 where nothing is known."""
        return (self._rows @ np.asarray(pictures, np.float64).T).T


def _arrays(
    corrected: _Corrected, carried: _CarriedNoise, mixing: np.ndarray | None
) -> dict[str, np.ndarray]:
    """The arrays of the transport (`ltcl.transport.stored`), with its noise."""
    T = corrected.changed.transport
    cores = []
    diagonals = []
    for core in T.cores:
        products: Any = core.multiply(T.W.T)
        diagonals.append(products.sum(axis=1) - 1.0)
        identity = scipy.sparse.eye_array(*core.shape, format="csr")
        cores.append(scipy.sparse.csr_array(core - identity))
    direct = carried.first_bounce
    direct = np.where(direct > 0, direct + corrected.changed.own, 0.0)
    if corrected.matches is not None:
        # Rows of other places: the light of a pixel is what they have at its number.
        own = np.stack([core.diagonal() for core in T.cores])
        direct = np.where(corrected.matches.moved, np.maximum(own, 0.0), direct)
    first_bounce = drop_uncertain(direct, carried.own_variance, FIRST_BOUNCE_SIGMAS)
    transport = stored.arrays_of_scan(
        T.grid, cores, np.stack(diagonals), first_bounce, mixing, BASIS
    )
    return transport | carried.arrays()
