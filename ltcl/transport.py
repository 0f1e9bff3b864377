# SPDX-License-Identifier: BSD-3-Clause
"""`Transport`: a measured light transport T, split as T = S F into first bounce and interreflection (eq. 3).

F is diagonal: projector pixel j lights the point that camera pixel j sees. Dividing the columns of T by F
gives S = T F^-1 = I + R, one operator per colour channel, on the device from its first use on.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ltcl import checks, diagnostics, layout
from ltcl import first_bounce as _first_bounce
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Coupled, IdentityPlus, Operator, ScaledColumns, as_operator, interreflections
from ltcl.operators import stored as stored_operators
from ltcl.operators.interreflection import device_of, made_with, maskable, nbytes
from ltcl.solvers import Inverse

logger = logging.getLogger(__name__)
_SAME = 1e-6  # relative difference of first bounces that float32 does not resolve
_ROUNDING = 1e-5  # of float32, in the products that show whether an inverse belongs to a transport
_CANCELLATION = 0.5  # of diag(S) = 1 + diag(R): from here on, I + R has all digits of T F^-1


class Transport:
    """Light transport T of a scene: picture = T pattern.

    Parameters
    ----------
    matrix : (M, N) array, scipy.sparse matrix, LinearOperator, a sequence of 3 for RGB, or 3 x 3 of them
        T[i, j] is the radiance at camera pixel i for unit linear light from projector pixel j; pixels
        are row-major. matrix[c][d] is what camera channel c sees of projector channel d; such a T has no S of
        one channel, it relights and compensates. An operator S diag(F) of `ltcl.operators`, S an
        `IdentityPlus`, is used as it stands where F is the first bounce: so are compressed transports made.
    grid : (h, w)
        Of the projector; N = h * w.
    first_bounce : "diagonal", "exact", "estimate" or array (N,) or (3, N)
        How F is found: diag(T), which also holds light that came back; 1 / diag(T^-1), which does not, for
        Lambertian scenes without self-illumination, at the cost of a dense inverse; a stochastic estimate
        of the same by products on the device, opened at once, which "exact" becomes where a dense inverse
        does not fit the host; or F itself.
    camera_grid : (h, w), optional
        Of the camera where T is rectangular, M = h * w; S then does not exist: T relights and compensates.
    device : Device or str, optional
        As `open_device` takes it; opened at the first product only. Operators have one already.
    on_dark : "raise" or "mask"
        What to do where F is zero or negative: refuse, or never light these projector pixels in a
        compensation. Relighting stays exact: what a pattern lights there is seen (not of an S diag(F)).
    mixing : (3, 3), optional
        Of the projector's colours, for a T of 3 channels: the light that channel c of T answers to is
        mixing[c] @ (red, green, blue) of the pattern.
    probes, seed : int
        Of the estimate, whose error falls as 1 / sqrt(probes), each of about 20 products; at least 2. With
        few, bounces may be worse than with the diagonal: compare `first_bounce_error` with F - diag(T).

    Attributes
    ----------
    matrices : tuple of 1 or 3
        T on the host, as given and checked.
        Of 3 x 3 matrices, those on the diagonal; all of them are in `blocks`, else None.
    is_compressed : bool
        Whether some channel is an operator S F, as `ltcl.compress` makes it; see `error`.
    masked : (N,) bool
        Projector pixels dropped by ``on_dark="mask"``, in any channel.
    first_bounce_error : array like first_bounce, or None
        Standard error of an estimated first bounce.
    compression : ltcl.Compression or None
        How `ltcl.compress` made it.

    Raises
    ------
    InputError
        Wrong shapes, NaN or infinite values, malformed sparse structure, a first bounce that is not
        positive, a mixing that cannot be undone.

    Examples
    --------
    >>> import ltcl, numpy
    >>> T = ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2))
    >>> print(T @ numpy.array([[1.0, 0.0]]))
    [[0.5 0.1]]
    """

    def __init__(
        self,
        matrix: Any,
        grid: tuple[int, int],
        first_bounce: Any = "diagonal",
        camera_grid: tuple[int, int] | None = None,
        device: Device | str | None = None,
        *,
        on_dark: str = "raise",
        mixing: Any = None,
        probes: int = 128,
        seed: int = 0,
    ) -> None:
        self.blocks = layout.blocks(matrix)
        self.matrices: tuple[Any, ...] = (
            layout.matrices(matrix) if self.blocks is None else tuple(self.blocks[c][c] for c in range(3))
        )
        self.mixing = None if mixing is None else layout.mixing(mixing, self.channels, self.blocks)
        self.shape: tuple[int, int] = self.matrices[0].shape
        self.grid = checks.grid("grid", grid, self.shape[1])
        self.camera_grid = _camera_grid(camera_grid, self.shape, self.grid)
        self.compression: Any = None
        self.masked: np.ndarray = np.zeros(self.shape[1], bool)
        self.first_bounce_error: np.ndarray | None = None
        self.is_compressed = self.is_square and any(made_with(T) is not None for T in self.matrices)
        self._requested_device = device
        self._first_bounce: np.ndarray | None = None
        self._is_diagonal = isinstance(first_bounce, str) and first_bounce == "diagonal"
        self._cache: dict[str, Any] = {"device": device_of(self.blocks or [self.matrices], device)}
        checks.one_of("on_dark", on_dark, ("raise", "mask"))
        if not self.is_square and not self._is_diagonal:
            kind = self.shape if self.blocks is None else "of 3 x 3 blocks"
            raise InputError(f"first_bounce is given, but T is {kind}; only a square T of channels has one")
        if self.is_square:
            F = self._find_first_bounce(first_bounce, probes, seed)
            dark = F <= 0.0
            if dark.any():
                _first_bounce.refuse_dark(dark, self.grid, on_dark, all(map(maskable, self.matrices)))
                self.masked = np.asarray(dark.any(axis=0))
                F = np.where(self.masked, 0.0, F)
            self._first_bounce = F

    def __repr__(self) -> str:
        kind = {1: "grey", 3: "colour"}[self.channels]
        (rows, columns), (h, w) = self.shape, self.grid
        size = ""
        if self.is_compressed:
            size = f", compressed to {checks.size(self.nbytes)} with an error of {self.error:.2g}"
        return f"<ltcl Transport {rows} x {columns}, {kind}, grid {h} x {w}{size}>"

    def __getstate__(self) -> dict[str, Any]:
        """For `pickle` and `copy.deepcopy`: without the device, which is opened again when it is needed."""
        state = {**self.__dict__, "_cache": {"device": None}}
        if isinstance(device := self._requested_device, Device):
            state["_requested_device"] = device.description.index
        if any(isinstance(part, Operator) for row in self.blocks or [self.matrices] for part in row):
            state["matrices"] = to_arrays(self)
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if isinstance(self.matrices, dict):
            self.matrices = from_arrays(self.matrices, on_dark="mask", device=self.device).matrices

    @property
    def channels(self) -> int:
        """1 for grey, 3 for colour."""
        return len(self.matrices)

    @property
    def is_square(self) -> bool:
        """Whether S exists: camera and projector have the same pixels, and colours no blocks between them."""
        return self.camera_grid == self.grid and self.blocks is None

    @property
    def couples(self) -> bool:
        """Whether the light of one colour is seen in another."""
        return self.blocks is not None or self.mixing is not None

    @property
    def first_bounce(self) -> np.ndarray:
        """Diagonal of F: (N,) float64, or (3, N) in colour; 0 at masked pixels."""
        F = self._require_first_bounce()
        return F[0] if self.channels == 1 else F

    @property
    def reciprocity_defect(self) -> float:
        """Of the worst channel, by a sample of pixels (`ltcl.diagnostics`); computed at the first call."""
        if "defect" not in self._cache:
            pairs = zip(self.matrices, self._require_first_bounce(), strict=True)
            defects = [diagnostics.reciprocity_defect(T, F, entries=diagnostics.QUICK) for T, F in pairs]
            self._cache["defect"] = max(defects)
        return self._cache["defect"]

    @property
    def negative_bounces(self) -> tuple[float, ...]:
        """Light that one bounce takes away, of each channel (`ltcl.diagnostics`); computed once."""
        if "negative" not in self._cache:
            self._cache["negative"] = tuple(diagnostics.negative_bounce(S, self.grid) for S in self.systems)
        return self._cache["negative"]

    @property
    def device(self) -> Device:
        """The device of the operators; opened here if it was not yet."""
        if self._cache["device"] is None:
            self._cache["device"] = open_device(self._requested_device)
        return self._cache["device"]

    @property
    def systems(self) -> tuple[IdentityPlus, ...]:
        """S = I + R of each channel, always as a tuple; uploaded at the first call."""
        if "systems" not in self._cache:
            F = self._require_first_bounce()
            self._cache["systems"] = interreflections(self.matrices, F, self.device)
        return self._cache["systems"]

    @property
    def interreflection(self) -> IdentityPlus | tuple[IdentityPlus, ...]:
        """S = I + R: the operator itself, or three of them in colour."""
        return self.systems[0] if self.channels == 1 else self.systems

    @property
    def nbytes(self) -> int:
        """Bytes of all S on the device; a pattern or a basis that channels share counts once."""
        return nbytes(self.systems)

    @property
    def error(self) -> float:
        """The largest `solution_error` of the systems, a bound on the relative error; 0 where all are exact.

        It is that of compression: rounding of products in float32, about 1e-7, comes on top.
        """
        return max(S.solution_error for S in self.systems) if self.is_compressed else 0.0

    @property
    def operators(self) -> tuple[Operator, ...]:
        """T of each channel on the device, or one `Coupled` of all; see `join`."""
        if "operators" not in self._cache:
            if self.blocks is not None:
                coupled = [[as_operator(T, self.device) for T in row] for row in self.blocks]
                self._cache["operators"] = (Coupled(coupled),)
            else:
                own = tuple(self._operator(channel) for channel in range(self.channels))
                M = self.mixing
                self._cache["operators"] = own if M is None else (Coupled.mixed(own, M),)
        return self._cache["operators"]

    def _operator(self, channel: int) -> Operator:
        """T of one channel: S F where that has all of its digits, so that nothing is stored twice."""
        T = self.matrices[channel]
        if (
            self.is_square
            and not self.masked.any()
            and hasattr(T, "diagonal")
            and not isinstance(T, Operator)
        ):
            F = self._require_first_bounce()[channel]
            if self._is_diagonal or np.all(np.asarray(T.diagonal()) >= _CANCELLATION * F):
                return ScaledColumns(self.systems[channel], F)
        return as_operator(T, self.device)

    def join(self, columns: Sequence[np.ndarray]) -> list[np.ndarray]:
        """What `operators` take, of one (N, k) a channel: the same, or all below each other, (3 N, k)."""
        return [np.concatenate(columns)] if self.couples else list(columns)

    def split(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        """One array a channel again."""
        return np.split(parts[0], 3) if self.couples else list(parts)

    def __matmul__(self, pattern: Any) -> np.ndarray:
        """Relight: the picture (float32) under `pattern`, frames and colours as in `ltcl.relight`."""
        columns, shape = layout.unpack("pattern", pattern, self.grid, self.channels)
        pictures = [T.matmat(x) for T, x in zip(self.operators, self.join(columns), strict=True)]
        return shape.pack(self.split(pictures), self.camera_grid)

    def to_light(self, columns: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Projector light F^-1 l_d from direct components (N, k) of each channel; 0 at masked pixels."""
        return layout.to_light(columns, self._require_first_bounce(), self.mixing)

    def _find_first_bounce(self, requested: Any, probes: int, seed: int) -> np.ndarray:
        checks.count("probes", probes, least=2)
        checks.count("seed", seed, least=0)
        how = requested if isinstance(requested, str) else ""
        if how == "exact" and _first_bounce.too_large(self.matrices[0]):
            n = self.shape[1]
            logger.warning("T of %d pixels is too large for a dense inverse; F is estimated", n)
            how = "estimate"
        if how != "estimate":
            return _first_bounce.find(self.matrices, requested)
        F, error = _first_bounce.estimate(self.matrices, self.device, probes, seed)
        self.first_bounce_error = error[0] if self.channels == 1 else error
        return F

    def _require_first_bounce(self) -> np.ndarray:
        if self.blocks is not None:
            raise InputError(
                "T has blocks between colours, which the S of one channel does not undo; this T can only "
                "relight and compensate"
            )
        if self._first_bounce is None:
            (h, w), (rows, columns) = self.grid, self.camera_grid
            raise InputError(
                f"T maps a projector of {h} x {w} pixels to a camera of {rows} x {columns}; S = T F^-1 needs "
                "both on one grid, this T can only relight and compensate"
            )
        return self._first_bounce


def require(T: Any, *, square: bool = True, name: str = "T") -> Transport:
    """T itself; refuses, before anything is uploaded, what is no Transport or has no S that is needed."""
    if not isinstance(T, Transport):
        kind = type(T).__name__
        raise InputTypeError(f"{name} is a {kind}; it must be a ltcl.Transport(matrix, grid=(h, w))")
    if square:
        T._require_first_bounce()
    return T


def refuse_other(name: str, other: Any, T: Transport, advice: str) -> None:
    """Refuse what was made of a transport with other pixels, colours or first bounce than T."""
    for what in ("grid", "channels"):
        if getattr(other, what) != getattr(T, what):
            raise InputError(
                f"{name} has {what} {getattr(other, what)}; it must be that of T, {getattr(T, what)}"
            )
    if not np.allclose(other.first_bounce, T.first_bounce, rtol=_SAME, atol=0.0):
        raise InputError(f"{name} has another first bounce than T; {advice}")
    own, others = (np.eye(3) if M is None else M for M in (T.mixing, other.mixing))
    if not np.array_equal(own, others):
        raise InputError(f"{name} mixes colours in another way than T; {advice}")


def require_inverse(T: Transport, inverse: Any, rtol: float | None, **others: Any) -> None:
    """Refuse an `inverse` that cannot serve for T at `rtol`, or arguments that it takes the place of.

    Whether it belongs to T is tested by one random light, the first time.

    Raises
    ------
    InputError, InputTypeError
        No inverse, one of another transport, an `rtol` below its error, or one of the `others` is not None.
    """
    if not isinstance(inverse, Inverse):
        raise InputTypeError(f"inverse is a {type(inverse).__name__}; it must be what ltcl.invert(T) gives")
    for name, value in others.items():
        if value is not None:
            raise InputError(f"{name} is given, but inverse takes the place of all solves; leave one out")
    require(T)
    inverse.refuse_beyond(rtol)
    tested = T._cache.setdefault("inverses", weakref.WeakSet())
    if inverse in tested:
        return
    refuse_other("inverse", inverse, T, "make it with ltcl.invert(T)")
    v = np.random.default_rng(0).standard_normal(T.shape[1]).astype(np.float32)
    misses = [np.linalg.norm(X @ (S @ v) - v) for X, S in zip(inverse.systems, T.systems, strict=True)]
    deviation = float(max(misses) / np.linalg.norm(v))
    allowed = inverse.error + T.error * (1.0 + inverse.error) + _ROUNDING
    if not deviation <= allowed:
        raise InputError(
            f"inverse is not that of T: a random light comes back off by {deviation:.2g}, which may be "
            f"{checks.upwards(allowed)} at most; make it with ltcl.invert(T)"
        )
    tested.add(inverse)


def default_rtol(least: float, T: Transport, exact: Any = None, inverse: Inverse | None = None) -> float:
    """Of a task without one: `least`, or the error of a compressed T or of an inverse where that is more.

    >>> default_rtol(1e-3, Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2)))
    0.001
    """
    error = inverse.error if inverse is not None else T.error if exact is None else 0.0
    return max(least, error) if error < 1.0 else least  # which is refused, with the reason


def to_arrays(T: Transport) -> dict[str, np.ndarray]:
    """The arrays of a compressed T, whose every channel is S diag(d), by name: files and pickles hold these.

    Beside what `ltcl.operators.stored` names there are grid (2,), first_bounce (channels, N), mixing (3, 3)
    where colours mix, and columns_0, ... (N,) of channels with another d than the first bounce.

    Raises
    ------
    InputTypeError
        T is made of something else.
    """
    systems = [made_with(matrix) for matrix in T.matrices]
    known = [S for S in systems if S is not None]
    if not T.is_square or len(known) < len(systems):
        kinds = ", ".join(sorted({type(matrix).__name__ for matrix in T.matrices}))
        raise InputTypeError(
            f"T is made of {kinds}; only arrays, sparse matrices and operators S diag(F) can be stored"
        )
    F = np.atleast_2d(T.first_bounce)
    arrays = {"grid": np.array(T.grid), "first_bounce": F}
    if T.mixing is not None:
        arrays["mixing"] = T.mixing
    for channel, (matrix, f) in enumerate(zip(T.matrices, F, strict=True)):
        if not np.array_equal(matrix.d, f):
            arrays[f"columns_{channel}"] = np.asarray(matrix.d, np.float64)
    return arrays | stored_operators.to_arrays(known)


def from_arrays(
    arrays: Mapping[str, np.ndarray],
    *,
    grid: Any = None,
    first_bounce: Any = None,
    on_dark: str = "raise",
    device: Device | str | None = None,
) -> Transport:
    """The transport of such arrays as `to_arrays` names, on a device that is opened at once.

    Parameters
    ----------
    grid : (h, w), optional
        Has to be that of the arrays.
    first_bounce, on_dark, device
        As in `Transport`; the first bounce of the arrays when not given.

    Raises
    ------
    InputError
        Arrays that are missing, or do not fit each other.

    Examples
    --------
    >>> from ltcl.operators import Dense
    >>> S = IdentityPlus(Dense(open_device(), [[0.0, 0.5], [0.5, 0.0]]))
    >>> T = Transport(ScaledColumns(S, np.array([0.5, 0.25])), grid=(1, 2), first_bounce=[0.5, 0.25])
    >>> print(from_arrays(to_arrays(T)) @ np.array([[1.0, 1.0]]))
    [[0.625 0.5  ]]
    """
    F, own = arrays["first_bounce"], checks.grid("grid", arrays["grid"].tolist())
    if grid is not None and checks.grid("grid", grid) != own:
        raise InputError(f"grid is {grid!r}; this transport is compressed on its own, {own}")
    systems = stored_operators.from_arrays(open_device(device), arrays)
    if len(systems) != len(F):
        raise InputError(f"first_bounce has {len(F)} channels, but there are {len(systems)} operators")
    columns = [arrays.get(f"columns_{channel}", f) for channel, f in enumerate(F)]
    matrices = [ScaledColumns(S, d) for S, d in zip(systems, columns, strict=True)]
    return Transport(
        matrices,
        own,
        first_bounce=F if first_bounce is None else first_bounce,
        on_dark=on_dark,
        mixing=arrays.get("mixing"),
    )


def resolve_reference(T: Transport, exact: Any) -> tuple[Transport, tuple[IdentityPlus | None, ...]]:
    """The transport that counts, and the S that judges in each channel: T and none where `exact` is None.

    A compressed T solves, the exact one judges (`ltcl.solvers.refinement`), and all that is shown is of that.

    Raises
    ------
    InputError, InputTypeError
        `exact` is no Transport with an S, or not one of the same pixels, colours and first bounce as T.
    """
    if exact is None:
        return T, (None,) * T.channels
    require(T)
    require(exact, name="exact")
    refuse_other("exact", exact, T, "it must be that of T, or T made from exact")
    return exact, exact.systems


def error_note(error: float) -> str:
    """Behind a result, by how much the T that it is of deviates; nothing where that is 0.

    >>> error_note(0.0412), error_note(0.0)
    (' with a T that itself is off by 0.042', '')
    """
    return f" with a T that itself is off by {checks.upwards(error)}" if error else ""


def _camera_grid(camera_grid: Any, shape: tuple[int, int], grid: tuple[int, int]) -> tuple[int, int]:
    if camera_grid is not None:
        return checks.grid("camera_grid", camera_grid, shape[0])
    if shape[0] != shape[1]:
        raise InputError(
            f"camera_grid is None, but matrix has shape {shape}; it must be (h, w) with h * w = {shape[0]}"
        )
    return grid
