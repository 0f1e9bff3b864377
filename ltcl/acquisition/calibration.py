# SPDX-License-Identifier: BSD-3-Clause
"""`Calibration`: a measured set-up, as arrays in a store; `Setup`: the same on the pixels of T.

With light p of a pattern in [0, 1], codes x that the projector is fed, its response g and ambient
light a,

    x = g^-1(p)                 for each channel, on the projector's own pixels
    picture = T p + a           in linear sensor values a second

T is for light relative to white less black: a includes the light of a black projector.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.acquisition.agreement import CameraModel
from ltcl.acquisition.anchor import Anchor
from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.acquisition.geometry.blocks import Blocks
from ltcl.acquisition.geometry.sharpness import Sharpness
from ltcl.acquisition.radiance import RadiancePicture, StoredRadiance, on_projector
from ltcl.acquisition.radiometry import NoiseModel, Radiance, Response
from ltcl.acquisition.scratch import ImageFile, StoredImage, scratch_array
from ltcl.acquisition.session import Photograph
from ltcl.errors import FileError
from ltcl.store import BlockStore
from ltcl.transport.transport import Transport

PREFIX = "calibration."
"""Beginning of the names of the extra arrays that a calibration is kept in."""
# Between the name of a large array and the number of its part.
PART = ".part"
# Bytes of an extra array: a part is in memory several times when it is written or checked.
PART_BYTES = 1 << 25
# Beginnings of the names of pictures, and of the map.
MAP = "map."
PICTURES = ("ambient.", "white.", MAP)
# Share of the camera pixels of a projector pixel that must be valid; with less its value is
# unknown.
MIN_VALID_SHARE = 0.5
# Random patterns by which a transport is compared with a known scene.
COMPARED_PATTERNS = 4


@dataclass(frozen=True, kw_only=True)
class StoredMap:
    """The coordinates of a `Correspondence` in a temporary file, NaN where they are not valid."""

    x: StoredImage
    y: StoredImage

    @classmethod
    def of(cls, mapping: Correspondence, file: ImageFile) -> StoredMap:
        """A map, written to a file."""
        return cls(x=file.append(mapping.x), y=file.append(mapping.y))


@dataclass(frozen=True, repr=False, eq=False)
class Calibration:
    """Measured facts about a set-up.

    Attributes
    ----------
    exposures : tuple of float
        Seconds of the photographs of each pattern, ascending.
    response, noise, offset : Response, NoiseModel, ndarray
        Of the camera; `offset` is its linear value without light, (channels,).
    ambient, white : Radiance or StoredRadiance
        Light (H, W[, 3]) of a black projector, and what a white one adds; large pictures are in a
        temporary file.
    projector : Response
        The projector's response: light of each code.
    mixing : ndarray, optional
        How its colours mix, (3, 3); None with one channel.
    resampling : Resampling
        From the camera's pixels to the projector's.
    sharpness : Sharpness, optional
        None with an aligned camera.
    anchor : Anchor, optional
        The pattern of blocks, which is photographed again during the scan.
    mapping : StoredMap, optional
        The map behind the resampling, for a store; `stored_map` reads it again. None with an
        aligned camera.
    stripes : sequence of Photograph
        Photographs of the bits of Gray code, which are patterns of a sketch as well, if they have
        the exposure of the scan; not kept.
    """

    exposures: tuple[float, ...]
    response: Response
    noise: NoiseModel
    offset: np.ndarray
    ambient: RadiancePicture
    white: RadiancePicture
    projector: Response
    mixing: np.ndarray | None
    resampling: Resampling
    sharpness: Sharpness | None = None
    anchor: Anchor | None = None
    mapping: StoredMap | None = None
    stripes: Sequence[Photograph] = ()

    @property
    def light(self) -> np.ndarray:
        """Light that each channel of T answers to when all of the projector's are at full code.

        (channels,)
        """
        return np.ones(1) if self.mixing is None else self.mixing.sum(axis=1)

    @property
    def camera(self) -> CameraModel:
        """Response, noise and offset of the camera."""
        return CameraModel(response=self.response, noise=self.noise, offset=self.offset)

    @classmethod
    def of(cls, store: str | os.PathLike[str] | BlockStore) -> Calibration:
        """Read the calibration in a store of `ltcl.acquire`.

        FileError if it has none, or is damaged.
        """
        scan = BlockStore.of(store)
        names = [name for name in scan.extras if name.startswith(PREFIX)]
        if not names:
            raise FileError(f"{scan.path}: holds no calibration; ltcl.acquire writes one")
        arrays = _small_arrays(scan, names)
        sharpness = None
        if "sharpness" in arrays:
            y, x, width = arrays["sharpness"].tolist()
            sharpness = Sharpness((y, x), width)
        anchor = _group(arrays, "anchor.")
        *noise, levels = arrays["noise"].tolist()
        return cls(
            exposures=tuple(arrays["exposures"].tolist()),
            response=Response(arrays["response"]),
            noise=NoiseModel(*noise, levels=int(levels)),
            offset=arrays["offset"],
            ambient=_read_radiance(scan, "ambient."),
            white=_read_radiance(scan, "white."),
            projector=Response(arrays["projector"]),
            mixing=arrays.get("mixing"),
            resampling=_resampling_from_arrays(_group(arrays, "resampling.")),
            sharpness=sharpness,
            anchor=Anchor(**anchor) if anchor else None,
        )

    def write(self, store: BlockStore) -> None:
        """Commit it to a store, as extra arrays."""
        arrays = {
            "exposures": np.array(self.exposures),
            "response": self.response.values,
            "noise": np.array(astuple(self.noise), np.float64),
            "offset": self.offset,
            "projector": self.projector.values,
            **_resampling_arrays(self.resampling),
        }
        if self.sharpness is not None:
            arrays["sharpness"] = np.hstack(astuple(self.sharpness))
        if self.mixing is not None:
            arrays["mixing"] = self.mixing
        if self.anchor is not None:
            arrays["anchor.pixels"] = self.anchor.pixels
            arrays["anchor.value"] = self.anchor.value
            arrays["anchor.variance"] = self.anchor.variance
        for name, array in arrays.items():
            _write_parts(store, name, len(array), array.nbytes, array.__getitem__)
        _write_radiance(store, "ambient.", self.ambient)
        _write_radiance(store, "white.", self.white)
        if self.mapping is not None:
            for name, image in (("x", self.mapping.x), ("y", self.mapping.y)):
                nbytes = 4 * math.prod(image.shape)
                _write_parts(store, f"{MAP}{name}", image.shape[0], nbytes, image.read)


def is_calibrated(store: BlockStore) -> bool:
    """True if a whole calibration is in the store.

    The strategy of the scan, which the calibration decides, is written last: that commits it.
    """
    return "strategy" in store.attributes


def stored_map(store: BlockStore) -> Correspondence:
    """The map from camera pixels to the projector's in a store of `ltcl.acquire`.

    FileError if it was made before maps were kept.
    """
    extras = _extras_of_arrays(store, MAP)
    grid = np.shape(store.extra(f"{PREFIX}resampling.coverage"))
    height, width = grid
    if not extras:
        camera_grid = np.array(store.extra(f"{PREFIX}resampling.camera_grid")).tolist()
        if store.attributes["settings"]["geometry"] != "aligned" or camera_grid != [*grid]:
            raise FileError(
                f"{store.path}: does not keep which projector pixel each camera pixel sees; "
                "ltcl.acquire keeps it now: scan again"
            )
        return Correspondence.aligned((height, width))
    x = _joined(store, extras[f"{MAP}x"])
    y = _joined(store, extras[f"{MAP}y"])
    return Correspondence(x, y, np.isfinite(x), (height, width))


def _write_parts(
    store: BlockStore,
    name: str,
    length: int,
    nbytes: int,
    read: Callable[[slice], np.ndarray],
) -> None:
    """Commit an array to a store, in several extra arrays if it is large: NAME.part0, ..."""
    if nbytes <= PART_BYTES:
        store.extra(PREFIX + name, read(slice(0, length)))
        return
    step = max(length * PART_BYTES // nbytes, 1)
    for number, top in enumerate(range(0, length, step)):
        store.extra(f"{PREFIX}{name}{PART}{number}", read(slice(top, min(top + step, length))))


def _extras_of_arrays(store: BlockStore, prefix: str) -> dict[str, list[str]]:
    """Extra arrays of the arrays that begin with `prefix`, by their names without `PREFIX`."""
    return _group_strips(name for name in store.extras if name.startswith(PREFIX + prefix))


def _group_strips(names: Iterable[str]) -> dict[str, list[str]]:
    """The extra arrays of each array of a calibration, in order, by its name without `PREFIX`."""
    numbered: dict[str, dict[int, str]] = {}
    for name in names:
        array, _, number = name.removeprefix(PREFIX).partition(PART)
        numbered.setdefault(array, {})[int(number or 0)] = name
    grouped = {}
    for array, strips in numbered.items():
        grouped[array] = [strips[number] for number in sorted(strips)]
    return grouped


def _small_arrays(store: BlockStore, names: Iterable[str]) -> dict[str, np.ndarray]:
    """The arrays of a calibration but pictures, by their names without `PREFIX`."""
    arrays = {}
    for name, strips in _group_strips(names).items():
        if name.startswith(PICTURES):
            continue
        if len(strips) == 1:
            arrays[name] = np.array(store.extra(strips[0]))
        else:
            arrays[name] = _joined(store, strips)
    return arrays


def _joined(store: BlockStore, names: list[str]) -> np.ndarray:
    """Join arrays of a store one below the other; a large array is in a temporary file."""
    file = ImageFile()
    strips = []
    for name in names:
        strips.append(file.append(np.array(store.extra(name))))
    length = sum(strip.shape[0] for strip in strips)
    joined = scratch_array((length, *strips[0].shape[1:]), strips[0].dtype)
    top = 0
    for strip in strips:
        joined[top : top + strip.shape[0]] = strip.read()
        top += strip.shape[0]
    return joined


def _group(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, Any]:
    """The arrays whose names begin with `prefix`, by the rest of their names."""
    group = {}
    for name, array in arrays.items():
        if name.startswith(prefix):
            group[name.removeprefix(prefix)] = array
    return group


def _write_radiance(store: BlockStore, prefix: str, light: RadiancePicture) -> None:
    for name in ("value", "variance", "valid"):
        itemsize = 1 if name == "valid" else 4

        def read(rows: slice, name: str = name) -> np.ndarray:
            return light.part(name, rows)

        nbytes = itemsize * math.prod(light.shape)
        _write_parts(store, f"{prefix}{name}", light.shape[0], nbytes, read)


def _read_radiance(store: BlockStore, prefix: str) -> RadiancePicture:
    """A picture of a store; a large one in a temporary file."""
    extras = _extras_of_arrays(store, prefix)
    names = [extras[prefix + name] for name in ("value", "variance", "valid")]
    if max(map(len, names)) == 1:
        value, variance, valid = (np.array(store.extra(name)) for [name] in names)
        return Radiance(value, variance, valid)
    file = ImageFile()
    values, variances, validity = (_copy_to_file(store, strips, file) for strips in names)
    return StoredRadiance(values=values, variances=variances, validity=validity)


def _copy_to_file(store: BlockStore, names: list[str], file: ImageFile) -> StoredImage:
    """Strips of a picture, one behind the other in a file, as one image."""
    strips = [file.append(store.extra(name)) for name in names]
    height = sum(strip.shape[0] for strip in strips)
    return replace(strips[0], shape=(height, *strips[0].shape[1:]))


def _resampling_arrays(resampling: Resampling) -> dict[str, np.ndarray]:
    weights = resampling.weights
    doubtful = resampling.doubtful
    if doubtful is None:
        doubtful = np.zeros(resampling.grid, bool)
    return {
        "resampling.coverage": resampling.coverage,
        "resampling.camera_grid": np.array(resampling.camera_grid),
        "resampling.doubtful": doubtful,
        "resampling.data": weights.data,
        "resampling.indices": weights.indices,
        "resampling.indptr": weights.indptr,
    }


def _resampling_from_arrays(arrays: dict[str, np.ndarray]) -> Resampling:
    """The inverse of `_resampling_arrays`, without the prefix."""
    h, w = arrays["coverage"].shape
    H, W = arrays["camera_grid"].tolist()
    entries = arrays["data"], arrays["indices"], arrays["indptr"]
    return Resampling(
        weights=scipy.sparse.csr_array(entries, shape=(h * w, H * W)),
        coverage=arrays["coverage"],
        grid=(h, w),
        camera_grid=(H, W),
        doubtful=arrays["doubtful"],
    )


@dataclass(frozen=True, eq=False)
class Setup:
    """A calibration on the pixels of T, which are `blocks` of projector pixels.

    Those of one of several projectors are squares of camera pixels: `CombinedSetup.of_scan` has
    codes on the pixels of the projector itself.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> store = f"{tempfile.mkdtemp()}/T.zarr"
    >>> rig = VirtualRig(np.eye(64) / 2, (8, 8), ambient=0.1)  # a projector of sRGB
    >>> T = ltcl.acquire(rig, geometry="aligned", store=store)
    >>> Setup.of(store).codes(np.full(T.grid, 0.214)).mean().round(1)
    np.float32(0.5)
    """

    calibration: Calibration
    blocks: Blocks

    @classmethod
    def of(cls, store: str | os.PathLike[str] | BlockStore) -> Setup:
        """Read the set-up in a store of `ltcl.acquire`; FileError as from `Calibration.of`."""
        scan = BlockStore.of(store)
        calibration = Calibration.of(scan)
        side = 1
        if scan.attributes.get("strategy") == "block":
            side = scan.attributes["settings"]["block"]
        return cls(calibration, Blocks(calibration.resampling.grid, side))

    @property
    def grid(self) -> tuple[int, int]:
        """(h, w) of the transport."""
        return self.blocks.grid

    @property
    def channels(self) -> int:
        """1 or 3."""
        return len(self.calibration.offset)

    @property
    def response(self) -> Response:
        """The projector's response: light of each code."""
        return self.calibration.projector

    @property
    def pixels(self) -> tuple[int, int]:
        """(h, w) of the codes of the projector."""
        return self.blocks.pixels

    @property
    def ambient(self) -> np.ndarray:
        """Light under a black projector, (h, w[, 3]) in the units of T; 0 where it is unknown."""
        resampling = self.calibration.resampling
        light = self.calibration.ambient
        weight = on_projector(light, "valid", resampling)
        value = on_projector(light, "value", resampling)
        mean = value / np.maximum(weight, MIN_VALID_SHARE)
        return self._block_means(np.where(weight >= MIN_VALID_SHARE, mean, 0.0))

    def codes(self, pattern: Any) -> np.ndarray:
        """Codes, float32 on the projector's pixels, for light (h, w[, 3]) relative to white.

        The light is clipped to [0, 1].
        """
        light = np.clip(self._in_channels("pattern", pattern, self.grid), 0.0, 1.0)
        return self.blocks.enlarged(self.calibration.projector.codes(light))

    def light(self, codes: Any) -> np.ndarray:
        """Light of codes (h, w[, 3]) in [0, 1] on the projector's pixels, relative to white."""
        own = self._in_channels("codes", codes, self.pixels)
        return self._block_means(self.calibration.projector.linear(own))

    def relative_error(self, rig: Any, T: Transport) -> tuple[float, ...]:
        """Relative error of T for each channel, by random patterns p of 0 and 1.

        It is ||s T p - c|| / ||c|| with s = <T p, c> / ||T p||^2. c is what `rig`, a `VirtualRig`,
        shows under p less black; the camera's unit of light is unknown.
        """
        random = np.random.default_rng(0)
        is_on = random.random((COMPARED_PATTERNS, *T.grid)) < 0.5
        # A rig of one of several projectors does not light all pixels.
        patterns = (is_on & getattr(rig, "lit", True)).astype(np.float32)
        black = self._picture(rig, np.zeros_like(patterns[0]))
        estimated = []
        expected = []
        for pattern in patterns:
            light = pattern
            if T.channels == 3:
                light = np.repeat(pattern[..., None], 3, axis=-1)
            estimated.append(T @ light)
            expected.append(self._block_means(self._picture(rig, pattern) - black))
        x = _lit_pixels(estimated, T)
        y = _lit_pixels(expected, T)
        squares = (x * x).sum(axis=(0, 1))
        scale = (x * y).sum(axis=(0, 1)) / np.maximum(squares, np.finfo(float).tiny)
        difference = ((scale * x - y) ** 2).sum(axis=(0, 1))
        error = np.sqrt(difference / (y * y).sum(axis=(0, 1)))
        return tuple(error.tolist())

    def _picture(self, rig: Any, pattern: np.ndarray) -> np.ndarray:
        """The light of a virtual rig under a pattern, on the projector's pixels."""
        picture = rig.radiance(self.blocks.enlarged(pattern))
        if rig.camera_grid == rig.projector_grid:
            return picture
        return self.calibration.resampling.apply(picture)

    def _in_channels(self, name: str, picture: Any, grid: tuple[int, int]) -> np.ndarray:
        """A checked picture on a grid, of as many channels as the projector has."""
        values = checks.finite(name, checks.real(name, picture)).astype(np.float32)
        checks.shape(name, values, grid, (*grid, 3))
        if values.ndim == 2 and self.calibration.projector.channels == 3:
            return np.repeat(values[..., None], 3, axis=-1)
        return values

    def _block_means(self, picture: np.ndarray) -> np.ndarray:
        """Means of a picture (h, w[, c]) on the projector's pixels over the pixels of T."""
        pixels = self.blocks.sum(np.ones_like(picture))
        return (self.blocks.sum(picture) / pixels).astype(np.float32)


def _lit_pixels(pictures: Any, T: Transport) -> np.ndarray:
    """Pictures without the masked pixels of T, (patterns, pixels, channels) float64."""
    values = np.reshape(pictures, (COMPARED_PATTERNS, -1, T.channels))
    return values[:, ~T.masked].astype(np.float64)
