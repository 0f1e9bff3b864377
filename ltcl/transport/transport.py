# SPDX-License-Identifier: BSD-3-Clause
"""`Transport`: a measured light transport T = S F of first bounce and interreflection (eq. 3).

    T   (M, N)   picture = T pattern, M camera pixels and N projector pixels
    F   (N,)     diagonal: the light that projector pixel j throws on what camera pixel j sees
    S   (N, N)   T F^-1 = I + R, on the device

The host keeps T as it was given. S and T are uploaded at their first use.
"""

from __future__ import annotations

import logging
import math
import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError
from ltcl.files import check_mapped_file
from ltcl.interop.calls import Differentiable
from ltcl.operators import (
    Coupled,
    IdentityPlus,
    Operator,
    ScaledColumns,
    as_operator,
    interreflections,
)
from ltcl.operators.colour_hats import mixed_colours, share_entries
from ltcl.operators.diagonal_blocks import joined_once
from ltcl.operators.interreflection import can_mask_pixels, common_device, nbytes, underlying_system
from ltcl.solvers import Inverse
from ltcl.transport import coverage, diagnostics, stored
from ltcl.transport import frames as layout
from ltcl.transport.first_bounce import (
    DARK_THRESHOLD,
    ENTRIES,
    DarkRule,
    find_first_bounce,
    mask_dark,
)
from ltcl.transport.matrices import check_mixing, split_channels
from ltcl.transport.noise import Noise, estimate
from ltcl.transport.relighting import Relighting

logger = logging.getLogger(__name__)
# Share of diag(S) = 1 + diag(R) that is diag(T) / F: from here on, I + R has all digits of T F^-1.
MIN_DIAGONAL_SHARE = 0.5
NOT_SHARED = "T is of one projector, which shares its light with no other one"
# Attributes that do not leave this process.
NOT_PICKLED = ("device", "systems", "operators", "checked_inverses", "reload")


def _relighting(self: Transport, pattern: Any) -> Relighting:
    return Relighting(self, pattern)


class Transport:
    """Light transport T of a scene: picture = T pattern.

    Parameters
    ----------
    matrix : (M, N) array, scipy.sparse matrix, LinearOperator, a sequence of 3 for RGB, or 3 x 3 of
    them
        T[i, j] is the radiance at camera pixel i for unit linear light from projector pixel j,
        row-major. matrix[c][d] is the light that camera channel c sees of projector channel d; such
        a T has no S, it relights and compensates. Arrays are kept, not copied: they must not be
        changed afterwards. A numpy.memmap, or rows of a store, that do not fit the device or the
        host stay on the disk and are read at each product.
    grid : (h, w)
        Projector pixels, N = h * w. A warning is logged if rows of T are much smoother on another
        grid.
    first_bounce : "diagonal", "exact", "estimate" or array (N,) or (3, N)
        "diagonal" is diag(T), which also holds light that returns to its pixel. "exact" is
        1 / diag(T^-1) by a dense inverse, without this light in Lambertian scenes. "estimate"
        estimates the same by products, as "exact" does if the host lacks memory. An array is F.
    camera_grid : (h, w), optional
        Camera pixels of a rectangular T, M = h * w. S then does not exist: T relights and
        compensates.
    device : Device or str, optional
        Device as `open_device` takes it, "all" for rows on several; opened at the first product. A
        matrix that is an operator has its own.
    on_dark : "mask" or "raise"
        Treatment of pixels whose first bounce is 0 or within 5 standard deviations of its noise,
        estimated if need be: leave them dark in compensations and warn of it, or refuse them.
        Relighting stays exact.
    dark_threshold : float
        First bounces below this share of the median one are dark, too; 0 leaves them lit.
    mixing : (3, 3), optional
        Mixing of the projector's colours: channel c of T answers to mixing[c] @ (red, green, blue)
        of the pattern.
    noise : Noise or Transport, optional
        Standard deviations of the entries (`ltcl.noise.Noise`), or a second measurement of the same
        scene, whose entries are compared at the first use of `noise`.
    probes, seed : int
        Number of probes of an estimate, at least 2, of about 20 products each, and their random
        seed. The error of the estimate falls as 1 / sqrt(probes).

    Attributes
    ----------
    channels : 1 or 3
    shape : (M, N)
    matrices : tuple of 1 or 3
        T on the host, checked. For 3 x 3 matrices those on the diagonal; `blocks` has all.
    blocks : tuple of 3 tuples of 3, or None
    is_compressed : bool
        Whether some channel is an operator S F; see `error` and `compression`, `ltcl.Compression`
        or None.
    masked : (N,) bool
        Projector pixels dropped by ``on_dark="mask"``, in any channel.
    dark_note : str
        Number of masked pixels and the reason; empty if all of them are 0 in an array
        `first_bounce`.
    first_bounce_error : array like first_bounce, or None
        Standard error of an estimate.
    ceilings : (N,) or None
        The largest light of each projector pixel over the upper bound, of several projectors that
        share their light; None where all pixels reach the bound.

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

    ceilings: np.ndarray | None = None

    def __init__(
        self,
        matrix: Any,
        grid: tuple[int, int],
        first_bounce: Any = "diagonal",
        camera_grid: tuple[int, int] | None = None,
        device: Device | str | None = None,
        *,
        on_dark: str = "mask",
        dark_threshold: float = DARK_THRESHOLD,
        mixing: Any = None,
        noise: Any = None,
        probes: int = 128,
        seed: int = 0,
    ) -> None:
        self.blocks, self.matrices = split_channels(matrix)
        self.channels = len(self.matrices)
        self.shape: tuple[int, int] = self.matrices[0].shape
        self.mixing: np.ndarray | None = None
        if mixing is not None:
            self.mixing = check_mixing(mixing, self.channels, has_blocks=self.blocks is not None)
        self.grid = checks.grid("grid", grid, self.shape[1])
        self.camera_grid = self._check_camera_grid(camera_grid)

        self.compression: Any = None
        self.is_compressed = self._has_underlying_system()
        # Loads T again in another process; set by `ltcl.load`.
        self.reload: Callable[[], Transport] | None = None
        # Inverses that were found to be of this T.
        self.checked_inverses: weakref.WeakSet[Inverse] = weakref.WeakSet()
        # Stored form of an unpickled compressed T.
        self._arrays: dict[str, np.ndarray] = {}

        self._requested_device = device
        matrix_device = common_device(self.blocks or [self.matrices], device)
        if matrix_device is not None:
            self.device = matrix_device
        self._noise = self._check_noise(noise)

        self._F: np.ndarray | None = None
        self.masked: np.ndarray = np.zeros(self.shape[1], bool)
        self.dark_note = ""
        self.first_bounce_error: np.ndarray | None = None
        checks.one_of("on_dark", on_dark, ("raise", "mask"))
        rule = self._dark_rule(dark_threshold)
        if self.is_square:
            self._set_first_bounce(first_bounce, rule, on_dark == "mask", probes, seed)
            self._warn_of_other_grid()
        else:
            self._refuse_first_bounce(first_bounce)

    def __repr__(self) -> str:
        M, N = self.shape
        height, width = self.grid
        kind = "grey" if self.channels == 1 else "colour"
        text = f"{M} x {N}, {kind}, grid {height} x {width}"
        if self.is_compressed:
            text += f", compressed to {checks.size(self.nbytes)} with an error of {self.error:.2g}"
        return f"<ltcl Transport {text}>"

    def _repr_html_(self) -> str:
        # Imported here, as it brings OpenCV.
        from ltcl.images.thumbnails import thumbnails

        if self._F is None:
            return thumbnails(self, {"picture under white": self @ np.ones(self.grid)})
        first_bounce = np.moveaxis(self._F.reshape(-1, *self.grid), 0, -1).squeeze()
        return thumbnails(self, {"first bounce": first_bounce})

    # Construction.

    def _check_camera_grid(self, camera_grid: Any) -> tuple[int, int]:
        M, N = self.shape
        if camera_grid is not None:
            return checks.grid("camera_grid", camera_grid, M)
        if M != N:
            raise InputError(
                f"camera_grid is None, but matrix has shape {self.shape}; h * w must be {M}"
            )
        return self.grid

    def _has_underlying_system(self) -> bool:
        """True if some channel is an operator S diag(d)."""
        if not self.is_square:
            return False
        return any(underlying_system(T) is not None for T in self.matrices)

    def _check_noise(self, noise: Any) -> Noise | Transport | None:
        if noise is None:
            return None
        if isinstance(noise, Noise):
            noise.check_fits(self.channels, self.shape, self._brightest_entries())
        elif isinstance(noise, Transport):
            self._check_second_measurement(noise)
        else:
            kind = type(noise).__name__
            raise InputTypeError(
                f"noise is a {kind}; it must be a Noise, or a Transport measured once more"
            )
        return noise

    def _brightest_entries(self) -> Any:
        """Brightest entry of each channel, or of its diagonal; 0 if T does not show them."""
        if all(isinstance(T, ENTRIES) for T in self.matrices):
            return [T.max() for T in self.matrices]
        if self.is_square and all(hasattr(T, "diagonal") for T in self.matrices):
            return [T.diagonal().max() for T in self.matrices]
        return 0.0

    def _check_second_measurement(self, second: Transport) -> None:
        for name in ("grid", "camera_grid", "channels"):
            value = getattr(second, name)
            expected = getattr(self, name)
            if value != expected:
                raise InputError(
                    f"noise is a T of {name} {value}; a second measurement has {name} {expected}, "
                    "as matrix"
                )

    def _dark_rule(self, threshold: float) -> DarkRule:
        is_measured = self._noise is not None
        if isinstance(self._noise, Noise):
            is_measured = self._noise.is_measured
        return DarkRule(
            matrices=self.matrices,
            threshold=checks.number("dark_threshold", threshold, least=0.0, below=1.0),
            noise=lambda: self.noise,
            is_measured=is_measured,
        )

    def _set_first_bounce(
        self, requested: Any, rule: DarkRule, mask: bool, probes: int, seed: int
    ) -> None:
        """Find F, its error, and the pixels where it is dark."""
        F, error = find_first_bounce(
            self.matrices, requested, lambda: self.device, probes, seed, rule
        )
        is_dark = rule.find_dark(F)
        may_mask = mask and all(map(can_mask_pixels, self.matrices))
        self._F, self.masked, reason = mask_dark(F, is_dark, self.grid, may_mask)
        # The zeros of a first bounce that the caller gave are no news to the caller.
        is_news = isinstance(requested, str) or np.any(self.masked & (F > 0))
        if is_news and self.masked.any():
            self.dark_note = reason
            logger.warning("%s; they stay unlit", reason)
        if error is not None and self.channels == 1:
            error = error[0]
        self.first_bounce_error = error

    def _warn_of_other_grid(self) -> None:
        better = diagnostics.other_grid(self.matrices[0], self.grid)
        if better is not None:
            logger.warning("grid is %s, but T is much smoother on a grid %s", self.grid, better)

    def _refuse_first_bounce(self, requested: Any) -> None:
        """Refuse a `first_bounce` other than the default for a T without S."""
        if isinstance(requested, str) and requested == "diagonal":
            return
        kind = self.shape if self.blocks is None else "of 3 x 3 blocks"
        raise InputError(
            f"first_bounce is given, but T is {kind}; only a square T of channels has one"
        )

    # Stored form, pickling and copying.

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays by name of a compressed T, as files hold them (`ltcl.transport.stored`)."""
        return stored.to_arrays(self)

    @classmethod
    def from_arrays(
        cls,
        arrays: Mapping[str, np.ndarray],
        *,
        grid: Any = None,
        first_bounce: Any = None,
        on_dark: str = "mask",
        dark_threshold: float = DARK_THRESHOLD,
        device: Device | str | None = None,
        noise: Any = None,
    ) -> Transport:
        """The transport of the arrays of `to_arrays`, on a device that is opened at once.

        A `grid` must be the stored one; `first_bounce` and `noise` replace the stored ones.
        """
        stored_grid = checks.grid("grid", arrays["grid"].tolist())
        if grid is not None and checks.grid("grid", grid) != stored_grid:
            raise InputError(
                f"grid is {grid!r}; this transport is compressed on its own, {stored_grid}"
            )
        matrices = stored.matrices_from_arrays(arrays, open_device(device))
        if first_bounce is None:
            first_bounce = arrays["first_bounce"]
        if noise is None:
            noise = Noise.from_arrays(arrays)
        return cls(
            matrices,
            stored_grid,
            first_bounce,
            on_dark=on_dark,
            dark_threshold=dark_threshold,
            mixing=arrays.get("mixing"),
            noise=noise,
        )

    def forget_device(self) -> None:
        """Let an unpickled transport open the default device where it is, at its first use."""
        self._requested_device = None

    def __getstate__(self) -> dict[str, Any]:
        """State for `pickle` and `copy.deepcopy`, without the device, which is opened again."""
        state = {name: value for name, value in vars(self).items() if name not in NOT_PICKLED}
        device = self._requested_device
        if isinstance(device, Device):
            state["_requested_device"] = device.description.index
        # An unpickled T that was not used yet has no matrices, but still its arrays.
        matrices = state.get("matrices", ())
        if self.blocks is not None:
            matrices = [block for row in self.blocks for block in row]
        if any(isinstance(T, Operator) for T in matrices):
            state["_arrays"] = self.to_arrays()
            del state["matrices"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)
        self.reload = None
        self.checked_inverses = weakref.WeakSet()

    @cached_property
    def matrices(self) -> tuple[Any, ...]:
        """T of each channel on the host; of an unpickled compressed T uploaded at the first use."""
        return stored.matrices_from_arrays(self._arrays, self.device)

    # Noise.

    @cached_property
    def noise(self) -> Noise:
        """Standard deviations of the entries: given, measured, or estimated at the first call.

        InputError if T does not show its entries (compressed, or a LinearOperator) and no noise is
        given.
        """
        if isinstance(self._noise, Transport):
            return Noise.measured_twice(self.matrices, self._noise.matrices)
        if self._noise is not None:
            return self._noise
        return estimate(self.matrices, self.grid, self.camera_grid)

    @property
    def measured_noise(self) -> Noise | None:
        """`noise`, or None if it is an estimate from T alone."""
        return None if self._noise is None else self.noise

    @property
    def is_acquired(self) -> bool:
        """True if T is of a scan by `ltcl.acquire`, which subtracts black; its noise tells."""
        return self._noise is not None and self.noise.source == "acquired"

    # First bounce and interreflection.

    @property
    def is_square(self) -> bool:
        """True if S exists: one grid of camera and projector, and no blocks between colours."""
        return self.camera_grid == self.grid and self.blocks is None

    @property
    def scene(self) -> Transport:
        """The transport whose S undoes light: T itself, or that of several projectors' scene."""
        return self

    @property
    def background(self) -> list[np.ndarray] | None:
        """No background: the scan, or the caller, subtracts the black of a single projector."""
        return None

    @property
    def light_of_white(self) -> np.ndarray:
        """Direct light of all projector pixels, (channels, M), where S undoes light."""
        return self._require_first_bounce()

    @property
    def couples(self) -> bool:
        """True if the light of one colour is seen in another."""
        return self.blocks is not None or self.mixing is not None

    @property
    def first_bounce(self) -> np.ndarray:
        """Diagonal of F: (N,) float64, or (3, N) in colour; 0 at masked pixels."""
        F = self._require_first_bounce()
        return F[0] if self.channels == 1 else F

    def _require_first_bounce(self) -> np.ndarray:
        """Diagonal of F (channels, N) float64; InputError if T has no S."""
        if self._F is None:
            kind = f"a camera_grid {self.camera_grid}"
            if self.blocks is not None:
                kind = "blocks between colours"
            raise InputError(
                f"T has a grid {self.grid} and {kind}; S = T F^-1 needs one grid and no blocks: "
                "this T can only relight and compensate"
            )
        return self._F

    @cached_property
    def reciprocity_defect(self) -> float:
        """Deviation of the worst channel from reciprocity, by a sample of pixels; computed once.

        It is what lies beyond the noise, if that was measured.
        """
        defects = []
        first_bounce = self._require_first_bounce()
        for channel, (T, F) in enumerate(zip(self.matrices, first_bounce, strict=True)):
            variance = None
            if self.measured_noise is not None:
                variance = partial(self.measured_noise.entry_variance, channel)
            defect = diagnostics.reciprocity_defect(
                T, F, entries=diagnostics.QUICK_ENTRIES, variance=variance
            )
            defects.append(defect)
        return max(defects)

    @cached_property
    def negative_bounces(self) -> tuple[float, ...]:
        """Share of light that one bounce takes away, for each channel; computed once."""
        return tuple(diagnostics.negative_bounce(S, self.grid) for S in self.systems)

    @property
    def bounce_spread(self) -> tuple[float, ...]:
        """Relative difference of bounces 1 to 3 under white with diag(T) and 1 / diag(T^-1) as F.

        Values of the worst channel, NaN if no method solves with S; computed once.
        """
        return tuple(self._bounce_spreads[0].tolist())

    @property
    def resolution_spread(self) -> tuple[float, ...]:
        """Relative change of bounces 1 to 3 under white by pixels of twice the size.

        About the error of bounces by light that is uneven within pixels. Values of the worst
        channel, NaN if T has more than 8192 pixels or shows no entries; computed once.
        """
        return tuple(self._bounce_spreads[1].tolist())

    @cached_property
    def _bounce_spreads(self) -> np.ndarray:
        """The spreads of the worst channel, (2, 3): by the choice of F, and by larger pixels."""
        spreads = []
        for T, F, S in zip(self.matrices, self._require_first_bounce(), self.systems, strict=True):
            spreads.append(diagnostics.bounce_spreads_of_system(T, F, S, self.grid))
        return np.max(spreads, axis=0)

    @cached_property
    def ambient_share(self) -> float:
        """Light that reaches all places alike, such as ambient light, as a share of a bounce.

        It is 0 if T shows no entries, or few, and if it is acquired, so that black is subtracted.
        """
        has_entries = all(isinstance(T, ENTRIES) for T in self.matrices)
        if self.is_acquired or not has_entries:
            return 0.0
        return diagnostics.ambient_share(self.systems, self.grid)

    # Operators on the device.

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
        """Bytes of all S on the device, or of T if it has no S; what they share counts once."""
        if not self.is_square:
            return nbytes(self.operators)
        if share_entries(self.systems):
            return nbytes([joined_once(self.systems)])
        return nbytes(self.systems)

    @property
    def error(self) -> float:
        """Relative error of solutions that compression leaves, besides rounding, 1e-7.

        It holds for pictures, or for all right-hand sides, as the `norm` of the compression states.
        """
        if not self.is_compressed:
            return 0.0
        return max(S.solution_error for S in self.systems)

    @property
    def error_bound(self) -> float:
        """Bound on that error for every right-hand side, pictures or not."""
        if not self.is_compressed:
            return 0.0
        return max(S.error_bound for S in self.systems)

    @cached_property
    def column_norms(self) -> np.ndarray:
        """Norms of the columns of `operators`, (systems, N), or (1, 3 N) if they are coupled."""
        return coverage.column_norms(self)

    @cached_property
    def unlit(self) -> np.ndarray:
        """Camera pixels (M,) that no projector pixel lights; `masked` ones of a square T."""
        if self.is_square:
            return self.masked
        return coverage.unlit_pixels(self)

    @cached_property
    def operators(self) -> tuple[Operator, ...]:
        """T of each channel on the device, or one `Coupled` of all, channel below channel."""
        if self.blocks is not None:
            rows = []
            for row in self.blocks:
                rows.append([as_operator(T, self.device) for T in row])
            return (Coupled(rows),)
        operators = tuple(self._operator(channel) for channel in range(self.channels))
        if self.mixing is not None:
            return (mixed_colours(operators, self.mixing),)
        return operators

    def _operator(self, channel: int) -> Operator:
        """T of one channel: S F if that has all of its digits, so that nothing is stored twice."""
        T = check_mapped_file(self.matrices[channel])
        if self._F is None or self.masked.any() or isinstance(T, Operator):
            return as_operator(T, self.device)
        F = self._F[channel]
        if hasattr(T, "diagonal") and np.all(np.asarray(T.diagonal()) >= MIN_DIAGONAL_SHARE * F):
            return ScaledColumns(self.systems[channel], F)
        return as_operator(T, self.device)

    # Use.

    def split(self, pattern: Any) -> tuple[np.ndarray, ...]:
        """The pattern of each projector: that of the only one."""
        return (np.asarray(pattern),)

    def share_light(self, direct: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Patterns of several projectors that make direct light."""
        raise InputError(NOT_SHARED)

    def sharing_matrix(self) -> scipy.sparse.csr_array:
        """Patterns (N, M) of several projectors from the light that drives all of them."""
        raise InputError(NOT_SHARED)

    @checks.takes_arrays("pattern", differentiable=Differentiable(("pattern",), _relighting))
    def __matmul__(self, pattern: Any) -> np.ndarray:
        """Relight: the picture (float32) under `pattern`, as in `ltcl.relight`."""
        columns, shape = layout.unpack("pattern", pattern, self.grid, self.channels)
        return shape.pack(self.multiply(columns), self.camera_grid)

    def multiply(
        self, columns: Sequence[np.ndarray], *, transpose: bool = False
    ) -> list[np.ndarray]:
        """T, or T^T, times right-hand sides (N, k) of each channel; one array if it couples."""
        if self.couples:
            columns = [np.concatenate(columns)]
        operators = self.operators
        if transpose:
            operators = [T.T for T in operators]
        uploaded = []
        for T, column in zip(operators, columns, strict=True):
            uploaded.append(T.device.upload(column))
        # All products are queued before the first one is waited for.
        products = []
        for T, x in zip(operators, uploaded, strict=True):
            products.append(T.apply(x))
        return [product.get() for product in products]

    def to_numpy(self) -> np.ndarray:
        """T on the host, dense, without `mixing`: (M, N), (3, M, N), or (3, 3, M, N) of blocks."""
        matrices = list(self.matrices)
        leading: tuple[int, ...] = (3,)
        if self.blocks is not None:
            matrices = [block for row in self.blocks for block in row]
            leading = (3, 3)
        elif self.channels == 1:
            leading = ()
        checks.fits_host("T as an array", 8 * len(matrices) * math.prod(self.shape))
        dense = np.array([self._to_dense(matrix) for matrix in matrices])
        return dense.reshape(*leading, *self.shape)

    def _to_dense(self, matrix: Any) -> np.ndarray:
        if hasattr(matrix, "tocsr"):
            # A sparse matrix in memory, or the rows of a store.
            matrix = matrix.tocsr().toarray()
        if isinstance(matrix, np.ndarray):
            return check_mapped_file(matrix)
        return as_operator(matrix, self.device).to_dense()


def check_transport(T: Any, *, square: bool = True, name: str = "T") -> Transport:
    """Return T if it is a Transport, and has an S or need not be `square`; refuse others."""
    if not isinstance(T, Transport):
        raise InputTypeError(
            f"{name} is a {type(T).__name__}; it must be a ltcl.Transport(matrix, grid)"
        )
    if square:
        T._require_first_bounce()
    return T
