# SPDX-License-Identifier: BSD-3-Clause
"""`VirtualRig`: photographs of a scene whose light transport T is known, as a real camera would take them.

With codes x (h, w[, 3]) in [0, 1], N = h w projector pixels, light p of the projector and channels c, d:

    q_c = sum_d mixing[c, d] p_d            the light that channel c of T answers to, (N,)
    L_c = C (T_c q_c + a_c)                 radiance on the camera's pixels: ambient a (M,), warp C (H W, M)

`sensor` makes p of x and codes of L. Light is linear throughout; its unit is that of T, so a T whose rows sum
to 1 gives 1 per second at full white. Radiance is uniform on each pixel of T; C averages it over what each
camera pixel covers. Known limit: no blur, no light that reaches the camera outside T.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks, layout
from ltcl.acquisition.fingerprint import fingerprint
from ltcl.acquisition.rigs.sensor import SimulatedRig
from ltcl.errors import InputError

_FEW = 8  # with one lit pixel of so many, gathering columns beats the whole product
Place = Callable[[np.ndarray, np.ndarray], tuple[Any, Any]]


class VirtualRig(SimulatedRig):
    """A projector and a camera around a known T.

    Parameters
    ----------
    T : (M, N) array, scipy.sparse matrix, LinearOperator, a sequence of 3, or a Transport
        Row-major pixels; negative light counts as none. A `ltcl.Transport` brings its own mixing.
    grid : (h, w)
        Of the projector, N = h w.
    camera_grid : (H, W), optional
        Of the photographs; needed where that is not `grid`.
    camera_map : (H W, M) matrix, optional
        C: what each camera pixel sees of the M pixels of T, by area, such as `camera_map` makes it from a
        function; without it M = H W and C = I.
    mixing : (3, 3), optional
        Of the projector's colours.
    ambient : float, (3,), (M,) or (M, 3)
        a: radiance without the projector; colours of a rig with three channels.
    sensitivity : float
        Linear sensor value for radiance 1 in one second.
    **sensor
        response, projector_response, bits, black, projector_black, gain, read, exposures, seed: see
        `ltcl.acquisition.rigs.sensor.SimulatedRig`.

    Examples
    --------
    >>> T = np.array([[0.5, 0.1], [0.1, 0.5]])
    >>> rig = VirtualRig(T, grid=(1, 2), response="linear", gain=None, read=0.0, black=0.0)
    >>> rig.photograph(np.array([[1.0, 0.0]]), seconds=1.0)
    array([[128,  26]], dtype=uint8)
    >>> rig.radiance(np.array([[1.0, 0.0]]))
    array([[0.5, 0.1]])
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
        self._T = _matrices(T)
        rows, columns = self._T[0].shape
        super().__init__(checks.grid("grid", grid, columns), len(self._T), **sensor)
        self._map, pixels = None, rows
        if camera_map is not None:
            self._map, *others = layout.matrices(camera_map, "camera_map")
            if others or self._map.shape[1] != rows:
                kind = "three channels" if others else f"shape {self._map.shape}"
                raise InputError(f"camera_map has {kind}; it must be (H W, M) with M = {rows}, the rows of T")
            pixels = self._map.shape[0]
        if camera_grid is None and pixels != columns:
            raise InputError(f"camera_grid is None; it must be (H, W) of the {pixels} camera pixels")
        self.camera_grid = checks.grid("camera_grid", grid if camera_grid is None else camera_grid, pixels)
        mixing = getattr(T, "mixing", None) if mixing is None else mixing
        self._mixing = None if mixing is None else layout.mixing(mixing, self.channels, None)
        self._ambient = _ambient(ambient, rows, self.channels)
        self.sensitivity = checks.number("sensitivity", sensitivity, above=0.0)

    def describe(self) -> dict[str, Any]:
        """What makes the photographs, as plain JSON."""
        return {
            "kind": "virtual",
            **super().describe(),
            "camera_grid": list(self.camera_grid),
            "mixing": None if self._mixing is None else self._mixing.tolist(),
            "ambient": [float(mean) for mean in self._ambient.mean(axis=0)],
            "digests": self._digests,
        }

    @cached_property
    def _digests(self) -> dict[str, Any]:
        """Of what is too large for the records."""
        return {
            "transport": fingerprint(*self._T),
            "camera_map": None if self._map is None else fingerprint(self._map),
            "ambient": fingerprint(self._ambient),
        }

    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        p = self._light(codes)
        q = (p if self._mixing is None else p @ self._mixing.T).reshape(-1, self.channels)
        L = np.stack([_product(T, q[:, c]) for c, T in enumerate(self._T)], axis=-1) + self._ambient
        L = L if self._map is None else self._map @ L
        return L.reshape(self.camera_grid if self.channels == 1 else (*self.camera_grid, 3))


def camera_map(
    place: Place, camera_grid: tuple[int, int], grid: tuple[int, int], *, points: int = 12
) -> scipy.sparse.csr_array:
    """C for `VirtualRig`: the part of the rays through camera pixel m that end in projector pixel n.

    A camera pixel integrates radiance over its square; a regular lattice of rays stands for that.

    Parameters
    ----------
    place : function of u, v
        Column and row of the projector (x, y) that the ray through column u and row v of the camera hits:
        pixels, centres at integers, arrays of any shape. NaN, or a place outside the grid: nothing lit. Folds
        and occluders are jumps of it. InputError where it returns arrays of another shape.
    camera_grid, grid : (H, W), (h, w)
        Of the camera and of the projector: C is (H W, h w), float64.
    points : int
        Rays to each side of a camera pixel: entries are good to about 1 / points^1.5.

    Examples
    --------
    A camera twice as coarse as the projector sees two pixels evenly:

    >>> camera_map(lambda u, v: (2 * u + 0.5, v), (1, 2), (1, 4)).toarray()
    array([[0.5, 0.5, 0. , 0. ],
           [0. , 0. , 0.5, 0.5]])
    """
    (H, W), (h, w) = checks.grid("camera_grid", camera_grid), checks.grid("grid", grid)
    k = checks.count("points", points)
    v, u = np.mgrid[:H, :W].astype(np.float64)
    offsets = (np.arange(k) + 0.5) / k - 0.5
    C = scipy.sparse.csr_array((H * W, h * w))
    for dv in offsets:
        for du in offsets:
            x, y = (np.asarray(axis, np.float64) for axis in place(u + du, v + dv))
            if x.shape != u.shape or y.shape != u.shape:
                raise InputError(
                    f"place gives {x.shape} and {y.shape}; they must be {u.shape}, as of u and v"
                )
            column, row = np.floor(x + 0.5).ravel(), np.floor(y + 0.5).ravel()
            hit = np.flatnonzero((column >= 0) & (column < w) & (row >= 0) & (row < h))  # NaN is nowhere
            n = (row[hit] * w + column[hit]).astype(np.int64)
            C = C + scipy.sparse.csr_array((np.ones(len(hit)), (hit, n)), shape=C.shape)
    return scipy.sparse.csr_array(C / k**2)


def _matrices(T: Any) -> tuple[Any, ...]:
    if getattr(T, "blocks", None) is not None:
        raise InputError("T has blocks between colours; it must have one matrix per channel, and a mixing")
    checked = layout.matrices(getattr(T, "matrices", T), "T")
    return tuple(matrix.astype(np.float32) if matrix.dtype.kind in "iub" else matrix for matrix in checked)


def _product(T: Any, q: np.ndarray) -> np.ndarray:
    """T q in the precision of T, which would be copied otherwise; of a dense T only the lit columns."""
    q = q.astype(T.dtype)
    if isinstance(T, np.ndarray):
        lit = np.flatnonzero(q)
        if _FEW * len(lit) < len(q):
            return T[:, lit] @ q[lit]
    return T @ q


def _ambient(value: Any, rows: int, channels: int) -> np.ndarray:
    """(M, channels) of radiance, or what broadcasts to it."""
    a = checks.finite("ambient", checks.real("ambient", value)).astype(np.float64)
    allowed = {(): (1, 1), (rows,): (rows, 1), (rows, channels): (rows, channels)}
    if channels == 3:
        allowed[(3,)] = (1, 3)  # colours, even of a T with three rows
    if a.shape not in allowed:
        raise InputError(f"ambient has shape {a.shape}; it must be one of {', '.join(map(str, allowed))}")
    if a.min() < 0:
        raise InputError(f"ambient is as low as {a.min():g}; light is never negative")
    return a.reshape(allowed[a.shape])
