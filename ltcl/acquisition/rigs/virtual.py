# SPDX-License-Identifier: BSD-3-Clause
"""`VirtualRig`: photographs of a scene whose light transport T is known.

With N = h w projector pixels, channels c and d, projector light p (`simulated`), ambient light a
(M,), and C (H W, M), the parts of the M pixels of T that camera pixels see:

    q_c = sum_d mixing[c, d] p_d            light that channel c of T responds to, (N,)
    L_c = C (T_c q_c + a_c)                 radiance on the camera's pixels

The unit of light is that of T: rows that sum to 1 give 1 per second under white. The only blur is
that of C.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.rigs.simulated import SimulatedRig
from ltcl.errors import InputError
from ltcl.transport.fingerprint import fingerprint
from ltcl.transport.matrices import check_matrices, check_mixing


class VirtualRig(SimulatedRig):
    """A projector and a camera around a known T.

    Parameters
    ----------
    T : (M, N) array, scipy.sparse matrix, LinearOperator, a sequence of 3, or a Transport
        Light transport of each channel; a Transport may have a mixing of its own.
    grid : (int, int)
        Height and width of the projector, N = h w.
    camera_grid : (int, int), optional
        Height and width of the photographs; None for that of the projector.
    camera_map : (H W, M) matrix, optional
        C, such as `ltcl.acquisition.camera_map` makes it; None for M = H W and C = I.
    mixing : (3, 3) array_like, optional
        Mixing of the projector's colours in the channels of the camera.
    ambient : float, (channels,), (M,) or (M, channels) array_like
        Radiance without the projector.
    sensitivity : float
        Linear value for radiance 1 in one second.
    **sensor
        Settings of `ltcl.acquisition.rigs.simulated.Sensor`.

    Raises
    ------
    InputError
        Shapes do not fit, or a value is out of its range.

    Examples
    --------
    >>> T = np.array([[0.5, 0.1], [0.1, 0.5]])
    >>> rig = VirtualRig(T, grid=(1, 2), response="linear", gain=None, read=0.0, black=0.0)
    >>> rig.photograph(np.array([[1.0, 0.0]]), seconds=1.0)
    array([[128,  26]], dtype=uint8)
    """

    def __init__(
        self,
        T: Any,
        grid: tuple[int, int],
        *,
        camera_grid: tuple[int, int] | None = None,
        camera_map: Any = None,
        mixing: Any = None,
        ambient: Any = 0.0,
        sensitivity: float = 1.0,
        **sensor: Any,
    ) -> None:
        if getattr(T, "blocks", None) is not None:
            raise InputError(
                "T has blocks between colours; it must have one matrix a channel, and a mixing"
            )
        matrices = check_matrices(getattr(T, "matrices", T), "T")
        self._matrices = [_as_floats(A) for A in matrices]
        rows, columns = self._matrices[0].shape
        grid = checks.grid("grid", grid, columns)
        super().__init__(grid, len(self._matrices), sensor)

        self._map = _check_camera_map(camera_map, rows)
        pixels = rows if self._map is None else self._map.shape[0]
        if camera_grid is None:
            camera_grid = grid
        self.camera_grid = checks.grid("camera_grid", camera_grid, pixels)

        if mixing is None:
            mixing = getattr(T, "mixing", None)
        self._mixing: np.ndarray | None = None
        if mixing is not None:
            self._mixing = check_mixing(mixing, self.channels, has_blocks=False)
        self.ambient = _check_ambient(ambient, rows, self.channels)
        self.sensitivity = checks.number("sensitivity", sensitivity, above=0.0)
        self._facts = self._describe_scene()

    def _describe_scene(self) -> dict[str, Any]:
        digests: dict[str, Any] = {
            "transport": fingerprint(*self._matrices),
            "ambient": fingerprint(self.ambient),
            "camera_map": None,
        }
        if self._map is not None:
            digests["camera_map"] = fingerprint(self._map)
        return {
            "kind": "virtual",
            "digests": digests,
            "camera_grid": self.camera_grid,
            "ambient": self.ambient.mean(axis=0).tolist(),
            "mixing": None if self._mixing is None else self._mixing.tolist(),
        }

    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        light = self._light(codes)
        if self._mixing is not None:
            light = light @ self._mixing.T
        q = light.reshape(-1, self.channels)
        planes = []
        for c, A in enumerate(self._matrices):
            planes.append(A @ q[:, c].astype(A.dtype))
        L = np.stack(planes, axis=-1) + self.ambient
        if self._map is not None:
            L = self._map @ L
        if self.channels == 1:
            return L.reshape(self.camera_grid)
        return L.reshape(*self.camera_grid, 3)


def _as_floats(matrix: Any) -> Any:
    """A matrix of integers or booleans in float32; others as they are."""
    if matrix.dtype.kind in "iub":
        return matrix.astype(np.float32)
    return matrix


def _check_camera_map(camera_map: Any, rows: int) -> Any:
    """The matrix C (H W, rows of T); None for the identity."""
    if camera_map is None:
        return None
    first, *others = check_matrices(camera_map, "camera_map")
    if others or first.shape[1] != rows:
        raise InputError(
            f"camera_map has shape {1 + len(others)} x {first.shape}; "
            f"it must be 1 x (H W, {rows}), the rows of T"
        )
    return first


def _check_ambient(ambient: Any, rows: int, channels: int) -> np.ndarray:
    """Ambient light as (1 or rows, 1 or channels) float64."""
    light = checks.real("ambient", ambient).astype(np.float64)
    checks.finite("ambient", light)
    checks.shape("ambient", light, (), (channels,), (rows,), (rows, channels))
    if light.min() < 0:
        raise InputError(f"ambient is as low as {light.min():g}; light is never negative")
    is_of_rows = light.shape == (rows,) and rows != channels
    if is_of_rows:
        return light[:, None]
    return np.atleast_2d(light)
