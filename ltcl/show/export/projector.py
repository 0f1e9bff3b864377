# SPDX-License-Identifier: BSD-3-Clause
"""`ExportedProjector`: where a projector's pixels are for the camera, and their share of the light.

A camera pixel p sees the projectors k at the coordinates of their maps. Its light is shared by the
distance d_k to the border of each projector's picture, in its own pixels:

    alpha_k(p) = d_k(p) / sum_j d_j(p)

which is 1 where one projector alone is seen, and falls to 0 towards a border that another one
covers. The black of a projector is a part c_k of its white w_k: the slope of the ambient light over
the white of a scan. Relative to the white of all together it is

    r(p) = sum_k c_k w_k(p) / sum_k alpha_k(p) w_k(p)

and projector k adds alpha_k (max r - r(p)), so that black looks even.

Known limit: pixels without a coordinate in one of the scans, such as noisy ones, count as not
reached by that projector.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltcl.acquisition import Calibration, Correspondence
from ltcl.show.export.scan import ExportedScan, read_scans

# Quantile of the relative black that counts as the largest.
BLACK_QUANTILE = 0.999


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportedProjector:
    """A projector as static files describe it.

    Attributes
    ----------
    name : str
    mapping : Correspondence
        From the camera's pixels to those of the projector.
    calibration : Calibration or None
        None of imported photographs.
    camera_x, camera_y : (h, w) float32
        Column and row of the camera that each projector pixel is seen at; NaN where it is not.
    blend : (h, w) float32
        Share of the light, in [0, 1], in linear light; 0 where a pixel is not seen.
    black : (h, w) float32
        Light that is added for an even black, relative to white.
    """

    name: str
    mapping: Correspondence
    calibration: Calibration | None
    camera_x: np.ndarray
    camera_y: np.ndarray
    blend: np.ndarray
    black: np.ndarray

    @property
    def grid(self) -> tuple[int, int]:
        """Height and width of the projector."""
        return self.mapping.grid

    @property
    def camera_grid(self) -> tuple[int, int]:
        """Height and width of the camera."""
        return self.mapping.camera_grid

    @property
    def seen(self) -> np.ndarray:
        """Projector pixels that the camera sees, (h, w) bool."""
        return np.isfinite(self.camera_x)


def share_light(scans: Sequence[ExportedScan]) -> list[ExportedProjector]:
    """Share the light between the projectors of scans with one camera."""
    shares = _shares([scan.mapping for scan in scans])
    missing = _missing_black(scans, shares)
    projectors = []
    for scan, share in zip(scans, shares, strict=True):
        projectors.append(_on_projector(scan, share, missing))
    return projectors


def read_projectors(paths: Sequence[str | os.PathLike[str]]) -> list[ExportedProjector]:
    """Read scans of one camera, one for each projector, or the folder of several.

    Errors are those of `read_scans`.
    """
    return share_light(read_scans(paths))


def _shares(mappings: Sequence[Correspondence]) -> list[np.ndarray]:
    """The share of each projector in the light of the camera's pixels, (H, W)."""
    distances = []
    for mapping in mappings:
        height, width = mapping.grid
        x = mapping.x
        y = mapping.y
        to_border = np.minimum(
            np.minimum(x + 0.5, width - 0.5 - x), np.minimum(y + 0.5, height - 0.5 - y)
        )
        distances.append(np.where(mapping.valid, np.maximum(to_border, 0.0), 0.0))
    total = np.sum(distances, axis=0)
    scale = 1.0 / np.where(total > 0.0, total, 1.0)
    return [(distance * scale).astype(np.float32) for distance in distances]


def _missing_black(scans: Sequence[ExportedScan], shares: Sequence[np.ndarray]) -> np.ndarray:
    """Light that each camera pixel lacks for an even black, relative to white, (H, W)."""
    black = np.zeros(shares[0].shape)
    white = np.zeros(shares[0].shape)
    for scan, share in zip(scans, shares, strict=True):
        if scan.calibration is None:
            return np.zeros(shares[0].shape, np.float32)
        own_white = _grey(scan.calibration, "white")
        black += _black_share(scan) * own_white * scan.mapping.valid
        white += share * own_white
    is_lit = white > 0.0
    relative = np.where(is_lit, black, 0.0) / np.where(is_lit, white, 1.0)
    largest = np.quantile(relative[is_lit], BLACK_QUANTILE) if is_lit.any() else 0.0
    return np.where(is_lit, np.clip(largest - relative, 0.0, 1.0), 0.0).astype(np.float32)


def _black_share(scan: ExportedScan) -> float:
    """Black of a projector relative to its white: the slope of ambient light over white."""
    assert scan.calibration is not None  # noqa: S101 - the caller has seen to it
    white = _grey(scan.calibration, "white").ravel()
    ambient = _grey(scan.calibration, "ambient").ravel()
    deviation = white - white.mean()
    spread = float(deviation @ deviation)
    if spread <= 0.0:
        return 0.0
    return max(float(deviation @ ambient) / spread, 0.0)


def _grey(calibration: Calibration, name: str) -> np.ndarray:
    """The mean of the channels of white less black, or of ambient light, (H, W)."""
    picture = calibration.white if name == "white" else calibration.ambient
    value = picture.part("value", slice(0, picture.shape[0])).astype(np.float64)
    return value if value.ndim == 2 else value.mean(axis=-1)


def _on_projector(scan: ExportedScan, share: np.ndarray, missing: np.ndarray) -> ExportedProjector:
    """Bring a share and the missing black from the camera's pixels to those of the projector."""
    is_seen = scan.resampling.seen
    masks = np.stack([share, share * missing], axis=-1)
    blend, black = np.moveaxis(scan.resampling.apply(masks), -1, 0)
    camera_x, camera_y = _inverse_map(scan)
    return ExportedProjector(
        name=scan.name,
        mapping=scan.mapping,
        calibration=scan.calibration,
        camera_x=np.where(is_seen, camera_x, np.nan).astype(np.float32),
        camera_y=np.where(is_seen, camera_y, np.nan).astype(np.float32),
        blend=np.where(is_seen, np.clip(blend, 0.0, 1.0), 0.0).astype(np.float32),
        black=np.where(is_seen, np.clip(black, 0.0, 1.0), 0.0).astype(np.float32),
    )


def _inverse_map(scan: ExportedScan) -> tuple[np.ndarray, np.ndarray]:
    """Column and row of the camera at the centre of each projector pixel, (h, w).

    Means over the camera pixels of a projector pixel belong to the mean of their own coordinates,
    not to its centre: the slopes of the map lead from there to the centre.
    """
    v, u = np.indices(scan.mapping.camera_grid, np.float32)
    x = np.nan_to_num(scan.mapping.x)
    y = np.nan_to_num(scan.mapping.y)
    planes = scan.resampling.apply(np.stack([u, v, x, y], axis=-1))
    planes[~scan.resampling.seen] = np.nan
    rows, columns = np.indices(scan.mapping.grid)
    right = columns - planes[..., 2]
    down = rows - planes[..., 3]
    corrected = []
    for plane in (planes[..., 0], planes[..., 1]):
        step = _slope(plane, 1) * right + _slope(plane, 0) * down
        corrected.append(plane + step)
    return corrected[0], corrected[1]


def _slope(plane: np.ndarray, axis: int) -> np.ndarray:
    """Differences of neighbouring pixels of a plane; 0 where one is not known."""
    if plane.shape[axis] < 2:
        return np.zeros_like(plane)
    return np.nan_to_num(np.gradient(plane, axis=axis))
