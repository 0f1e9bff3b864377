# SPDX-License-Identifier: BSD-3-Clause
"""`Transport`: a measured light transport T, split as T = S F into first bounce and interreflection (eq. 3).

F is diagonal: projector pixel j lights the point that camera pixel j sees. Dividing its columns by F gives
S = T F^-1 = I + R, one operator per colour channel, on the device from its first use on.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from ltcl import channels, checks, first_bounces, inverse_diagonal, layout, reciprocity
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Coupled, IdentityPlus, Operator, ScaledColumns, as_operator, interreflections
from ltcl.operators.interreflection import device_of, made_with, maskable, nbytes

logger = logging.getLogger(__name__)
_SAME = 1e-6  # relative difference of first bounces, which float32 hardly tells from none


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
        self.blocks = channels.blocks(matrix)
        self.matrices = (
            channels.own(matrix) if self.blocks is None else tuple(self.blocks[c][c] for c in range(3))
        )
        self.mixing = None if mixing is None else channels.mixing(mixing, self.channels, self.blocks)
        self.shape: tuple[int, int] = self.matrices[0].shape
        self.grid = checks.grid("grid", grid, self.shape[1])
        self.camera_grid = _camera_grid(camera_grid, self.shape, self.grid)
        self._wanted_device = device
        self._device: Device | None = device_of(self.blocks or [self.matrices], device)
        self._systems: tuple[IdentityPlus, ...] | None = None
        self._forward: tuple[Operator, ...] | None = None
        self.compression: Any = None
        self.masked: np.ndarray = np.zeros(self.shape[1], bool)
        self._first_bounce: np.ndarray | None = None
        self.first_bounce_error: np.ndarray | None = None
        self._reciprocity_defect: float | None = None
        checks.one_of("on_dark", on_dark, ("raise", "mask"))
        if not self.is_square and not (isinstance(first_bounce, str) and first_bounce == "diagonal"):
            kind = self.shape if self.blocks is None else "of 3 x 3 blocks"
            raise InputError(f"first_bounce is given, but T is {kind}; only a square T of channels has one")
        if self.is_square:
            F = self._find_first_bounce(first_bounce, probes, seed)
            dark = F <= 0.0
            if dark.any():
                first_bounces.refuse_dark(dark, self.grid, on_dark, all(map(maskable, self.matrices)))
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
        """Of the worst channel, by a sample of pixels (`ltcl.reciprocity`); computed at the first call."""
        if self._reciprocity_defect is None:
            pairs = zip(self.matrices, self._require_first_bounce(), strict=True)
            found = [reciprocity.defect(T, F, entries=reciprocity.QUICK) for T, F in pairs]
            self._reciprocity_defect = max(found)
        return self._reciprocity_defect

    @property
    def device(self) -> Device:
        """The device of the operators; opened here if it was not yet."""
        if self._device is None:
            self._device = open_device(self._wanted_device)
        return self._device

    @property
    def systems(self) -> tuple[IdentityPlus, ...]:
        """S = I + R of each channel, always as a tuple; uploaded at the first call."""
        if self._systems is None:
            self._systems = interreflections(self.matrices, self._require_first_bounce(), self.device)
        return self._systems

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
        """The largest `solution_error` of the systems: what light may be off by; 0 where all are exact.

        It is that of compression: rounding of products in float32, about 1e-7, comes on top.
        """
        return max(S.solution_error for S in self.systems) if self.is_compressed else 0.0

    @property
    def is_compressed(self) -> bool:
        """Whether some channel was given as S F, as `ltcl.compress` does; `error` is what that may cost."""
        return self.is_square and any(made_with(T) is not None for T in self.matrices)

    @property
    def operators(self) -> tuple[Operator, ...]:
        """T of each channel on the device, or one `Coupled` of all; see `join`."""
        if self._forward is None:
            if self.blocks is not None:
                self._forward = (
                    Coupled([[as_operator(T, self.device) for T in row] for row in self.blocks]),
                )
            elif self.mixing is not None:
                self._forward = (Coupled.mixed(self._own_channels(), self.mixing),)
            else:
                self._forward = self._own_channels()
        return self._forward

    def _own_channels(self) -> tuple[Operator, ...]:
        """S F where that is all of T, so that nothing is stored twice."""
        if not self.is_square or self.masked.any():
            return tuple(as_operator(matrix, self.device) for matrix in self.matrices)
        F = self._require_first_bounce()
        return tuple(
            T if isinstance(T, Operator) else ScaledColumns(S, f)
            for T, S, f in zip(self.matrices, self.systems, F, strict=True)
        )

    def join(self, columns: Sequence[np.ndarray]) -> list[np.ndarray]:
        """What `operators` take, of one (N, k) a channel: the same, or all below each other, (3 N, k)."""
        return [np.concatenate(columns)] if self.couples else list(columns)

    def split(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        """One array a channel again."""
        return np.split(parts[0], 3) if self.couples else list(parts)

    def __matmul__(self, pattern: Any) -> np.ndarray:
        """Relight: the picture (float32) under `pattern`, frames and colours as in `ltcl.relight`."""
        columns, shape = layout.unpack("pattern", pattern, self.grid, self.channels)
        pictures = [_product(T, x) for T, x in zip(self.operators, self.join(columns), strict=True)]
        return shape.pack(self.split(pictures), self.camera_grid)

    def to_light(self, columns: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Projector light F^-1 l_d from direct components (N, k) of each channel; 0 at masked pixels."""
        return first_bounces.undone(columns, self._require_first_bounce(), self.mixing)

    def _find_first_bounce(self, wanted: Any, probes: int, seed: int) -> np.ndarray:
        checks.count("probes", probes, least=2)
        checks.count("seed", seed, least=0)
        wanted_by_name = wanted if isinstance(wanted, str) else ""
        if wanted_by_name == "exact" and first_bounces.too_large(self.matrices[0]):
            logger.warning(
                "T of %d pixels is too large for a dense inverse; its first bounce is estimated",
                self.shape[1],
            )
            wanted_by_name = "estimate"
        if wanted_by_name != "estimate":
            return first_bounces.find(self.matrices, wanted)
        F, error = inverse_diagonal.estimate(self.matrices, self.device, probes, seed)
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


def _product(T: Operator, x: np.ndarray) -> np.ndarray:
    """T x on the host for x (N, k)."""
    return T.apply(T.device.upload(x)).get()


def _camera_grid(camera_grid: Any, shape: tuple[int, int], grid: tuple[int, int]) -> tuple[int, int]:
    if camera_grid is not None:
        return checks.grid("camera_grid", camera_grid, shape[0])
    if shape[0] != shape[1]:
        raise InputError(
            f"camera_grid is None, but matrix has shape {shape}; it must be (h, w) with h * w = {shape[0]}"
        )
    return grid
