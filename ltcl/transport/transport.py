# SPDX-License-Identifier: BSD-3-Clause
"""`Transport`: a measured light transport T = S F of first bounce and interreflection (eq. 3).

F is diagonal: projector pixel j lights what camera pixel j sees. S = T F^-1 = I + R is on the
device.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError
from ltcl.files import check_mapped_file
from ltcl.operators import (
    Coupled,
    IdentityPlus,
    Operator,
    ScaledColumns,
    as_operator,
    interreflections,
)
from ltcl.operators import stored as stored_operators
from ltcl.operators.interreflection import can_mask_pixels, common_device, nbytes, underlying_system
from ltcl.solvers import Inverse
from ltcl.transport import diagnostics
from ltcl.transport import first_bounce as _first_bounce
from ltcl.transport import frames as layout
from ltcl.transport.noise import Noise, estimate

logger = logging.getLogger(__name__)
_SAME = 1e-6  # relative difference of first bounces that float32 does not resolve
_ROUNDING = 1e-5  # of float32, in the products that show whether an inverse belongs to a transport
_CANCELLATION = 0.5  # of diag(S) = 1 + diag(R): from here on, I + R has all digits of T F^-1
_ON_DEVICE = ("device", "systems", "operators", "_inverses", "reload")  # do not leave this process


class Transport:
    """Light transport T of a scene: picture = T pattern.

    Parameters
    ----------
    matrix : (M, N) array, scipy.sparse matrix, LinearOperator, a sequence of 3 for RGB, or 3 x 3 of
    them
        T[i, j] is the radiance at camera pixel i for unit linear light from projector pixel j,
        row-major. matrix[c][d] is what camera channel c sees of projector channel d; such a T has
        no S, it relights and compensates. Arrays are kept, not copied: they must not be changed
        afterwards. A numpy.memmap, or rows of a store, that do not fit the device or the host stay
        on the disk and are read at each product.
    grid : (h, w)
        Of the projector; N = h * w. A warning is logged where rows of T are much smoother on
        another grid.
    first_bounce : "diagonal", "exact", "estimate" or array (N,) or (3, N)
        diag(T), which also holds light that came back; 1 / diag(T^-1), by a dense inverse, which
        does not, of Lambertian scenes; an estimate of this by products, as "exact" is where the
        host lacks memory; or F.
    camera_grid : (h, w), optional
        Of the camera where T is rectangular, M = h * w; S then does not exist: T relights and
        compensates.
    device : Device or str, optional
        As `open_device` takes it, "all" for rows on several; opened at the first product. Operators
        have one.
    on_dark : "mask" or "raise"
        Pixels whose first bounce is 0 or within 5 standard deviations of its noise, estimated if
        need be: leave them dark in compensations and warn of it, or refuse them. Relighting stays
        exact.
    dark : float
        First bounces below that many times the median one are dark, too; 0 leaves them lit.
    mixing : (3, 3), optional
        Of the projector's colours: channel c of T answers to mixing[c] @ (red, green, blue) of the
        pattern.
    noise : Noise or Transport, optional
        Standard deviations of the entries (`ltcl.noise.Noise`), or a second measurement of the same
        scene, whose entries are compared at the first use of `noise`.
    probes, seed : int
        Of the estimate, at least 2 probes of about 20 products each; its error falls as 1 /
        sqrt(probes).

    Attributes
    ----------
    channels : 1 or 3
    matrices : tuple of 1 or 3
        T on the host, checked. Of 3 x 3 matrices those on the diagonal; all are in `blocks`, else
        None.
    is_compressed : bool
        Whether some channel is an operator S F; see `error` and `compression`, `ltcl.Compression`
        or None.
    masked : (N,) bool, projector pixels dropped by ``on_dark="mask"``, in any channel
    dark : str, how many these are and why; empty where all of them are 0 in an array `first_bounce`
    first_bounce_error : array like first_bounce, or None, the standard error of an estimate

    Raises
    ------
    InputError
        Wrong shapes, NaN, a first bounce that is dark and cannot be masked, a singular mixing.

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
        on_dark: str = "mask",
        dark: float = _first_bounce.DARK,
        mixing: Any = None,
        noise: Any = None,
        probes: int = 128,
        seed: int = 0,
    ) -> None:
        self.blocks = layout.blocks(matrix)
        diagonal = [row[c] for c, row in enumerate(self.blocks or ())]
        self.matrices = tuple[Any, ...](diagonal or layout.matrices(matrix))
        self.channels = len(self.matrices)
        self.mixing = None if mixing is None else layout.mixing(mixing, self.channels, self.blocks)
        self.shape: tuple[int, int] = self.matrices[0].shape
        M, N = self.shape
        self.grid = checks.grid("grid", grid, N)
        if camera_grid is None and M != N:
            raise InputError(
                f"camera_grid is None, but matrix has shape {self.shape}; h * w must be {M}"
            )
        self.camera_grid = (
            self.grid if camera_grid is None else checks.grid("camera_grid", camera_grid, M)
        )
        self.compression: Any = None
        self.reload: Callable[[], Transport] | None = None  # as `ltcl.load` made it
        self.masked: np.ndarray = np.zeros(N, bool)
        self.dark = ""
        self.first_bounce_error: np.ndarray | None = None
        self._arrays: dict[str, np.ndarray] = {}  # of an unpickled compressed T
        self.is_compressed = self.is_square and any(
            underlying_system(T) is not None for T in self.matrices
        )
        self._inverses: weakref.WeakSet[Inverse] = (
            weakref.WeakSet()
        )  # that were found to be of this T
        self._requested_device = device
        if (own := common_device(self.blocks or [self.matrices], device)) is not None:
            self.device = own
        self._noise = self._checked_noise(noise)
        self._F: np.ndarray | None = None  # (channels, N)
        checks.one_of("on_dark", on_dark, ("raise", "mask"))
        share = checks.number("dark", dark, least=0.0, below=1.0)
        if self.is_square:
            known = noise is not None and getattr(noise, "source", "") != "estimated"
            rule = partial(_first_bounce.dark, self.matrices, share, lambda: self.noise, known)
            own, may_mask = (
                lambda: self.device,
                on_dark == "mask" and all(map(can_mask_pixels, self.matrices)),
            )
            F, error = _first_bounce.find(self.matrices, first_bounce, own, probes, seed, rule)
            self._F, self.masked, why = _first_bounce.mask_dark(F, rule(F), self.grid, may_mask)
            if self.masked.any() and (
                isinstance(first_bounce, str) or np.any(self.masked & (F > 0))
            ):
                self.dark = why
                logger.warning("%s; they stay unlit", why)
            if (other := diagnostics.other_grid(self.matrices[0], self.grid)) is not None:
                logger.warning("grid is %s, but T is much smoother on a grid %s", self.grid, other)
            self.first_bounce_error = (
                error[0] if error is not None and self.channels == 1 else error
            )
        elif not isinstance(first_bounce, str) or first_bounce != "diagonal":
            kind = self.shape if self.blocks is None else "of 3 x 3 blocks"
            raise InputError(
                f"first_bounce is given, but T is {kind}; only a square T of channels has one"
            )

    def __repr__(self) -> str:
        (M, N), (h, w), kind = self.shape, self.grid, "grey" if self.channels == 1 else "colour"
        text = f"{M} x {N}, {kind}, grid {h} x {w}"
        if self.is_compressed:
            text += f", compressed to {checks.size(self.nbytes)} with an error of {self.error:.2g}"
        return f"<ltcl Transport {text}>"

    def _repr_html_(self) -> str:
        from ltcl.images.thumbnails import thumbnails  # brings OpenCV

        if self._F is None:
            return thumbnails(self, {"picture under white": self @ np.ones(self.grid)})
        first_bounce = np.moveaxis(self._F.reshape(-1, *self.grid), 0, -1).squeeze()
        return thumbnails(self, {"first bounce": first_bounce})

    def to_numpy(self) -> np.ndarray:
        """T on the host, dense: (M, N), (3, M, N) in colour, (3, 3, M, N) of blocks; `mixing` is left out."""
        rows = self.blocks or (self.matrices,)
        checks.fits_host(
            "T as an array", 8 * len(rows) * len(rows[0]) * self.shape[0] * self.shape[1]
        )

        def dense(T: Any) -> np.ndarray:
            T = (
                T.tocsr().toarray() if hasattr(T, "tocsr") else T
            )  # of memory, or of the rows of a store
            return (
                check_mapped_file(T)
                if isinstance(T, np.ndarray)
                else as_operator(T, self.device).to_dense()
            )

        whole = np.array([[dense(T) for T in row] for row in rows])
        return whole if self.blocks else whole[0] if self.channels == 3 else whole[0, 0]

    def __getstate__(self) -> dict[str, Any]:
        """For `pickle` and `copy.deepcopy`: without the device, which is opened again when it is needed."""
        state = {name: value for name, value in vars(self).items() if name not in _ON_DEVICE}
        if isinstance(device := self._requested_device, Device):
            state["_requested_device"] = device.description.index
        rows = self.blocks or ([self.matrices] if "matrices" in state else [])
        if any(isinstance(T, Operator) for row in rows for T in row):
            state["_arrays"] = to_arrays(self)
            del state["matrices"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _inverses=weakref.WeakSet(), reload=None)

    @cached_property
    def matrices(self) -> tuple[Any, ...]:
        """As `__init__` sets them; those of an unpickled compressed T are uploaded at their first use."""
        return from_arrays(self._arrays, on_dark="mask", device=self.device).matrices

    @cached_property
    def noise(self) -> Noise:
        """Standard deviations of the entries: as given or measured, else estimated from T at the first call.

        InputError where T does not show its entries (compressed, or a LinearOperator) and none is
        given.
        """
        if isinstance(self._noise, Transport):
            return Noise.measured_twice(self.matrices, self._noise.matrices)
        return self._noise or estimate(self.matrices, self.grid, self.camera_grid)

    @property
    def measured_noise(self) -> Noise | None:
        """`noise`, or None where it is an estimate from T alone."""
        return None if self._noise is None else self.noise

    def _checked_noise(self, noise: Any) -> Noise | Transport | None:
        if isinstance(noise, Noise):
            entries = all(isinstance(T, _first_bounce.ENTRIES) for T in self.matrices)
            known = entries or (
                self.is_square and all(hasattr(T, "diagonal") for T in self.matrices)
            )
            light = [(T if entries else T.diagonal()).max() for T in self.matrices if known]
            noise.require(self.channels, self.shape, light or 0.0)
        elif isinstance(noise, Transport):
            for name in ("grid", "camera_grid", "channels"):
                if getattr(noise, name) != getattr(self, name):
                    both = f"{getattr(noise, name)}; a second measurement has {name} {getattr(self, name)}"
                    raise InputError(f"noise is a T of {name} {both}, as matrix")
        elif noise is not None:
            kind = type(noise).__name__
            raise InputTypeError(
                f"noise is a {kind}; it must be a Noise, or a Transport measured once more"
            )
        return noise

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

    @cached_property
    def reciprocity_defect(self) -> float:
        """Deviation of the worst channel from reciprocity, by a sample of pixels; computed once."""
        pairs = zip(self.matrices, self._require_first_bounce(), strict=True)
        return max(
            diagnostics.reciprocity_defect(T, F, entries=diagnostics.QUICK) for T, F in pairs
        )

    @cached_property
    def negative_bounces(self) -> tuple[float, ...]:
        """Light that one bounce takes away, of each channel (`ltcl.transport.diagnostics`); computed once."""
        return tuple(diagnostics.negative_bounce(S, self.grid) for S in self.systems)

    @cached_property
    def device(self) -> Device:
        """The device of the operators, opened at the first use."""
        return open_device(self._requested_device)

    @cached_property
    def systems(self) -> tuple[IdentityPlus, ...]:
        """S = I + R of each channel, always as a tuple; uploaded at the first call."""
        return interreflections(self.matrices, self._require_first_bounce(), self.device)

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
        """Relative error of solutions that compression leaves, as its `norm` states it: of pictures, or all.

        Rounding, 1e-7, comes on top.
        """
        return max(S.solution_error for S in self.systems) if self.is_compressed else 0.0

    @property
    def error_bound(self) -> float:
        """Bound on that error for every right-hand side, pictures or not."""
        return max(S.error_bound for S in self.systems) if self.is_compressed else 0.0

    @cached_property
    def operators(self) -> tuple[Operator, ...]:
        """T of each channel on the device, or one `Coupled` of all, channel below channel."""
        if self.blocks is not None:
            return (Coupled([[as_operator(T, self.device) for T in row] for row in self.blocks]),)
        own = tuple(self._operator(channel) for channel in range(self.channels))
        return own if self.mixing is None else (Coupled.mixed(own, self.mixing),)

    def _operator(self, channel: int) -> Operator:
        """T of one channel: S F where that has all of its digits, so that nothing is stored twice."""
        T = check_mapped_file(self.matrices[channel])
        if self._F is not None and not self.masked.any() and not isinstance(T, Operator):
            F = self._F[channel]
            if hasattr(T, "diagonal") and np.all(np.asarray(T.diagonal()) >= _CANCELLATION * F):
                return ScaledColumns(self.systems[channel], F)
        return as_operator(T, self.device)

    def __matmul__(self, pattern: Any) -> np.ndarray:
        """Relight: the picture (float32) under `pattern`, frames and colours as in `ltcl.relight`."""
        columns, shape = layout.unpack("pattern", pattern, self.grid, self.channels)
        columns = [np.concatenate(columns)] if self.couples else columns
        uploaded = [(T, T.device.upload(x)) for T, x in zip(self.operators, columns, strict=True)]
        pictures = [
            T.apply(x) for T, x in uploaded
        ]  # all are queued before the first is waited for
        return shape.pack([picture.get() for picture in pictures], self.camera_grid)

    def _require_first_bounce(self) -> np.ndarray:
        if self._F is None:
            kind = (
                f"a camera_grid {self.camera_grid}"
                if self.blocks is None
                else "blocks between colours"
            )
            needs = (
                "S = T F^-1 needs one grid and no blocks: this T can only relight and compensate"
            )
            raise InputError(f"T has a grid {self.grid} and {kind}; {needs}")
        return self._F


def require(T: Any, *, square: bool = True, name: str = "T") -> Transport:
    """T itself; refused, before any upload, where it is no Transport or has no S."""
    if not isinstance(T, Transport):
        raise InputTypeError(
            f"{name} is a {type(T).__name__}; it must be a ltcl.Transport(matrix, grid)"
        )
    if square:
        T._require_first_bounce()
    return T


def refuse_other(name: str, other: Any, T: Transport, advice: str) -> None:
    """Refuse what was made of a transport with other pixels, colours or first bounce than T."""
    for what in ("grid", "channels"):
        value, expected = getattr(other, what), getattr(T, what)
        if value != expected:
            raise InputError(f"{name} has {what} {value}; it must be that of T, {expected}")
    if not np.allclose(other.first_bounce, T.first_bounce, rtol=_SAME, atol=0.0):
        raise InputError(f"{name} has another first bounce than T; {advice}")
    own, others = (np.eye(3) if M is None else M for M in (T.mixing, other.mixing))
    if not np.array_equal(own, others):
        raise InputError(f"{name} mixes colours in another way than T; {advice}")


def require_inverse(T: Transport, inverse: Any, rtol: float | None, **others: Any) -> None:
    """Refuse an `inverse` of another T, which a random light shows, or of less than `rtol`, and `others`."""
    if not isinstance(inverse, Inverse):
        raise InputTypeError(
            f"inverse is a {type(inverse).__name__}; it must be what ltcl.invert(T) gives"
        )
    for name, value in others.items():
        if value is not None:
            raise InputError(
                f"{name} is given, but inverse takes the place of all solves; leave one out"
            )
    inverse.refuse_beyond(rtol)
    if inverse in T._inverses:
        return
    refuse_other("inverse", inverse, T, "make it with ltcl.invert(T)")
    v = np.random.default_rng(0).standard_normal(T.shape[1]).astype(np.float32)
    misses = [
        np.linalg.norm(X @ (S @ v) - v) for X, S in zip(inverse.systems, T.systems, strict=True)
    ]
    deviation = float(max(misses) / np.linalg.norm(v))
    allowed = inverse.error + T.error * (1.0 + inverse.error) + _ROUNDING
    if not deviation <= allowed:
        raise InputError(
            f"inverse is not that of T: light comes back off by {deviation:.2g}, which may be "
            f"{checks.upwards(allowed)} at most; make it with ltcl.invert(T)"
        )
    T._inverses.add(inverse)


def default_rtol(
    least: float, T: Transport, exact: Any = None, inverse: Inverse | None = None
) -> float:
    """Of a task without one: `least`, or the error of a compressed T or of an inverse where that is more."""
    error = inverse.error if inverse is not None else T.error if exact is None else 0.0
    return max(least, error) if error < 1.0 else least  # which is refused, with the reason


def to_arrays(T: Transport) -> dict[str, np.ndarray]:
    """The arrays of a compressed T, S diag(d) in each channel, for files and pickles.

    Those of `ltcl.operators.stored`, grid, first_bounce, mixing and noise if any, columns_0, ...
    where d is another F.
    """
    systems = [S for S in map(underlying_system, T.matrices) if S is not None]
    if not T.is_square or len(systems) < T.channels:
        kinds = ", ".join(sorted({type(matrix).__name__ for matrix in T.matrices}))
        raise InputTypeError(
            f"T is made of {kinds}; only arrays, sparse matrices and S diag(F) are stored"
        )
    F = np.atleast_2d(T.first_bounce)
    arrays = {"grid": np.array(T.grid), "first_bounce": F}
    if T.mixing is not None:
        arrays["mixing"] = T.mixing
    if T.measured_noise is not None:
        arrays |= T.measured_noise.to_arrays()
    for channel, (matrix, f) in enumerate(zip(T.matrices, F, strict=True)):
        if not np.array_equal(matrix.d, f):
            arrays[f"columns_{channel}"] = np.asarray(matrix.d, np.float64)
    return arrays | stored_operators.to_arrays(systems)


def from_arrays(
    arrays: Mapping[str, np.ndarray],
    *,
    grid: Any = None,
    first_bounce: Any = None,
    on_dark: str = "mask",
    dark: float = _first_bounce.DARK,
    device: Device | str | None = None,
    noise: Any = None,
) -> Transport:
    """The transport of such arrays, on a device that is opened at once; `grid`, if any, must be theirs."""
    F, own = arrays["first_bounce"], checks.grid("grid", arrays["grid"].tolist())
    if grid is not None and checks.grid("grid", grid) != own:
        raise InputError(f"grid is {grid!r}; this transport is compressed on its own, {own}")
    systems = stored_operators.from_arrays(open_device(device), arrays)
    if len(systems) != len(F):
        raise InputError(
            f"first_bounce has {len(F)} channels, but there are {len(systems)} operators"
        )
    matrices = [ScaledColumns(S, arrays.get(f"columns_{c}", F[c])) for c, S in enumerate(systems)]
    first = F if first_bounce is None else first_bounce
    others: dict[str, Any] = {
        "mixing": arrays.get("mixing"),
        "noise": noise or Noise.from_arrays(arrays),
    }
    return Transport(matrices, own, first, on_dark=on_dark, dark=dark, **others)


def resolve_reference(
    T: Transport, exact: Any
) -> tuple[Transport, tuple[IdentityPlus | None, ...]]:
    """The transport that results are of, and the S that judges each channel: T and none without `exact`."""
    if exact is None:
        return T, (None,) * T.channels
    require(T)
    require(exact, name="exact")
    refuse_other("exact", exact, T, "it must be that of T, or T made from exact")
    return exact, exact.systems


def error_note(error: float) -> str:
    """Behind a result: by how much its T deviates."""
    return f" with a T that itself is off by {checks.upwards(error)}" if error else ""
