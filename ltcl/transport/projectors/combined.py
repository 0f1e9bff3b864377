# SPDX-License-Identifier: BSD-3-Clause
"""`combine`: one transport of several projectors, from scans with one camera that did not move.

    picture = sum_k T_k pattern_k,    T_k = S F_k

S belongs to the scene and F_k to a projector. F_k is what lies around the peaks of the rows of T_k,
and with patterns p_k = Q_k l_d that make direct light l_d (`ltcl.transport.projectors.sharing`),

    S = I + R,    R = sum_k (T_k - F_k) Q_k

is between camera pixels, whatever the projectors are. Light is undone by S once, shared out by Q_k,
and what Q_k does not make exact, as F_k Q_k blurs a little, is left to the solve within the bounds,
over the pixels of all projectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy  # its subpackage ndimage is loaded at the first use
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Product, as_operator
from ltcl.solvers import solve_each
from ltcl.transport import frames as layout
from ltcl.transport.covariance import EntryErrors
from ltcl.transport.noise import Noise
from ltcl.transport.projectors.direct_parts import direct_parts
from ltcl.transport.projectors.gamut import Gamut, common_gamut
from ltcl.transport.projectors.montage import Montage
from ltcl.transport.projectors.noise import (
    JoinedErrors,
    joined_noise,
    measured_noises,
    scene_noise,
)
from ltcl.transport.projectors.sharing import (
    ProjectorShare,
    drive_divisors,
    find_ramps,
    inner_pixels,
    share_out,
)
from ltcl.transport.transport import Transport, check_transport

MAX_PROJECTORS = 8
# Side of the median filter that takes the noise of single pixels out of the brightest black.
BLACK_FILTER = 3
# Tolerance of the solve that finds the level of black.
BLACK_RTOL = 1e-3


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """Light of white over that of black, in the median of the lit camera pixels.

    Attributes
    ----------
    measured : float
        With the blacks of all projectors as they are; infinite where they are 0.
    uniform : float
        With black lifted to one level.
    """

    measured: float
    uniform: float

    def __str__(self) -> str:
        return f"contrast {self.measured:.0f}, and {self.uniform:.0f} with a uniform black"


class SceneTransport(Transport):
    """S between the pixels of a camera, whose grid is known and not to be doubted."""

    def _warn_of_other_grid(self) -> None:
        pass


class CombinedTransport(Transport):
    """The transport of several projectors that one camera sees; `combine` makes it.

    Patterns of all projectors stand side by side in one picture on `grid`, as the outputs of a
    graphics card do; pixels below a pattern that is not the highest stay dark.

    Attributes
    ----------
    transports : tuple of Transport
        T_k as they were given.
    montage : Montage
        The places of the patterns.
    shares : tuple of ProjectorShare
        Weights, direct light and ceiling of each projector.
    scene : Transport
        S between camera pixels, whose first bounce is 1 where some projector lights them: for
        bounces, and for the analysis.
    ceilings : (N,)
        The largest light of each pixel, over the upper bound.
    background : list of (M, 1), or None
        Light that compensation counts as there already: the blacks, less `black_level`.
    blacks : list of (M, 1), or None
        The sum of the blacks of all projectors, for each channel.

    Examples
    --------
    >>> import ltcl, numpy
    >>> one = ltcl.Transport(numpy.eye(4), grid=(2, 2), camera_grid=(2, 2))
    >>> T = ltcl.combine([one, one])
    >>> isinstance(T, ltcl.CombinedTransport), T.grid
    (True, (2, 4))
    >>> print(T @ [numpy.full((2, 2), 0.5), numpy.full((2, 2), 0.25)])
    [[0.75 0.75]
     [0.75 0.75]]
    """

    def __init__(
        self,
        transports: Sequence[Transport],
        *,
        scene: Transport | None = None,
        blend: Any = "auto",
        balance: float = 0.5,
        blacks: Any = None,
        black: str = "measured",
        device: Any = None,
    ) -> None:
        members = check_members(transports)
        self.transports = tuple(map(_with_entries, members))
        # What `ltcl.acquisition.combine_scans` knows of the projectors, for files.
        self.displays: dict[str, np.ndarray] = {}
        first = self.transports[0]
        grids = [T.grid for T in self.transports]
        self.montage = Montage(tuple(grids))
        self.blend = blend
        self.balance = checks.number("balance", balance, least=0.0, most=1.0)
        self.black = checks.one_of("black", black, ("measured", "uniform"))
        self.given_scene = scene
        direct_of = _direct_of_member
        if scene is not None:
            check_scene(scene, first)
            direct_of = _sparse_member
        directs = [direct_of(number, T) for number, T in enumerate(self.transports)]
        ramps = find_ramps(directs, self.montage.grids, first.camera_grid, blend)
        self.shares: tuple[ProjectorShare, ...] = share_out(directs, ramps, self.balance)
        self.divisors = drive_divisors(self.shares)
        self.mixings: list[np.ndarray] = []
        for T in self.transports:
            self.mixings.append(np.eye(first.channels) if T.mixing is None else T.mixing)
        matrix, mixing = self._side_by_side(first.channels)
        own_device = None
        if scene is None:
            own_device = device
        super().__init__(
            matrix,
            self.montage.grid,
            camera_grid=first.camera_grid,
            device=own_device,
            mixing=mixing,
            noise=self._joined_noise(),
        )
        is_dark = self.montage.vector([T.masked for T in self.transports])
        self.masked = self.montage.is_empty | is_dark
        self.ceilings: np.ndarray | None = self.montage.vector([s.ceiling for s in self.shares])
        self.blacks = self._check_blacks(blacks)

    def __reduce__(self) -> Any:
        """Combine the same transports again, in another process."""
        options = {
            "scene": self.given_scene,
            "blend": self.blend,
            "balance": self.balance,
            "blacks": None if self.blacks is None else self.black_pictures(),
            "black": self.black,
        }
        return _combine_again, (self.transports, options, self.displays)

    def __repr__(self) -> str:
        sizes = ", ".join(f"{h} x {w}" for h, w in self.montage.grids)
        H, W = self.camera_grid
        kind = "grey" if self.channels == 1 else "colour"
        count = len(self.transports)
        return f"<ltcl Transport of {count} projectors, {sizes}, {kind}, camera {H} x {W}>"

    # Construction.

    def _side_by_side(self, channels: int) -> tuple[Any, np.ndarray | None]:
        """The matrices of all projectors, and the mixing that they have in common."""
        is_mixed_alike = all(np.array_equal(M, self.mixings[0]) for M in self.mixings)
        if is_mixed_alike:
            matrices = []
            for channel in range(channels):
                columns = [self._matrix_of_projector(T, channel) for T in self.transports]
                matrices.append(self._under_scene(channel, self.montage.columns(columns)))
            return matrices, self.transports[0].mixing
        rows = []
        for c in range(channels):
            row = []
            for d in range(channels):
                columns = []
                for T, mixing in zip(self.transports, self.mixings, strict=True):
                    columns.append(self._matrix_of_projector(T, c) * mixing[c, d])
                row.append(self._under_scene(c, self.montage.columns(columns)))
            rows.append(row)
        return rows, None

    def _matrix_of_projector(self, T: Transport, channel: int) -> Any:
        """The matrix of one projector and channel, as an array or a csr_array."""
        return _in_memory(T.matrices[channel])

    def _under_scene(self, channel: int, matrix: Any) -> Any:
        """T from the direct light of all projectors, where S was given; else the matrix itself."""
        if self.given_scene is None:
            return matrix
        S = self.given_scene.systems[channel]
        return Product(S, as_operator(matrix, S.device))

    def _joined_noise(self) -> Noise | None:
        """The noise of all projectors; None if it is not known, or that of direct light alone."""
        if self.given_scene is not None:
            return None
        matrices = []
        for T in self.transports:
            matrices.append(
                [self._matrix_of_projector(T, channel) for channel in range(T.channels)]
            )
        return joined_noise(self.transports, matrices, self.montage)

    def errors_of(self, noise: Noise, inverse: Any = None) -> EntryErrors:
        """The errors of the entries: those of the scans, where these tell them."""
        noises = measured_noises(self.transports)
        if noises is None or noise is not self.measured_noise:
            return EntryErrors(self, noise, inverse)
        members = []
        for T, own in zip(self.transports, noises, strict=True):
            members.append(EntryErrors(T, own))
        return JoinedErrors(self, noise, members, self.montage, self.mixings)

    def _check_blacks(self, blacks: Any) -> list[np.ndarray] | None:
        """The sum (M, 1) of the blacks of all projectors, for each channel."""
        if blacks is None:
            if self.black == "uniform":
                raise InputError(
                    "black is 'uniform', but blacks is None; give the picture of each projector's "
                    "black"
                )
            return None
        pictures = list(blacks)
        if len(pictures) != len(self.transports):
            raise InputError(
                f"blacks has {len(pictures)} pictures; it must have one for each of "
                f"{len(self.transports)} projectors"
            )
        total = [np.zeros((self.shape[0], 1)) for _ in range(self.channels)]
        for number, picture in enumerate(pictures):
            columns, _ = layout.unpack(
                f"blacks[{number}]", picture, self.camera_grid, self.channels
            )
            if columns[0].shape[1] != 1:
                colour = " in grey" if self.channels == 1 else ""
                raise InputError(
                    f"blacks[{number}] has shape {np.shape(picture)}; it must be one picture "
                    f"{self.camera_grid}{colour}"
                )
            total = [sum_ + column for sum_, column in zip(total, columns, strict=True)]
        return total

    def black_pictures(self) -> list[np.ndarray]:
        """Pictures with the sum of the blacks that were given: all of it, and nothing."""
        assert self.blacks is not None  # noqa: S101 - only then it is called
        shape = layout.PictureLayout(False, None, self.channels == 3)
        total = shape.pack(self.blacks, self.camera_grid)
        return [total, *[np.zeros_like(total)] * (len(self.transports) - 1)]

    @property
    def is_square(self) -> bool:
        """False: S is that of `scene`."""
        return False

    def _require_first_bounce(self) -> np.ndarray:
        raise InputError(
            "T is of several projectors, whose S is that of T.scene, between the camera's pixels: "
            "compensate, relight, separate, analyze and invert take T, others T.scene or one scan"
        )

    @cached_property
    def unlit(self) -> np.ndarray:
        """Camera pixels (M,) without direct light of any projector."""
        return ~np.any(self.divisors > 0.0, axis=0)

    # Light.

    @property
    def light_of_white(self) -> np.ndarray:
        """Direct light of all projectors, weighted as they share it, (channels, M)."""
        return self.divisors

    def sharing_matrix(self) -> scipy.sparse.csr_array:
        """Patterns (N, M) of all projectors from the light, over `light_of_white`, of the scene.

        (3 N, 3 M), channel below channel, where projectors mix colours each in its own way.
        """
        rows = []
        for share in self.shares:
            weighted = scipy.sparse.diags_array(share.own) @ share.back
            rows.append(scipy.sparse.csr_array(weighted.T))
        matrix = scipy.sparse.csr_array(self.montage.columns(rows).T)
        if self.blocks is None:
            return matrix
        unmixings = [np.linalg.inv(mixing) for mixing in self.mixings]
        blocks = []
        for c in range(3):
            row = []
            for d in range(3):
                factors = []
                for share, unmixing in zip(self.shares, unmixings, strict=True):
                    factors.append(np.full(len(share.own), unmixing[c, d]))
                row.append(scipy.sparse.diags_array(self.montage.vector(factors)) @ matrix)
            blocks.append(row)
        return scipy.sparse.csr_array(scipy.sparse.block_array(blocks))

    @cached_property
    def black_level(self) -> np.ndarray:
        """The level to which ``black="uniform"`` lifts black, (channels,); 0 without.

        The light that lifts the darkest places bounces to the brightest one, too: the level L is
        the least with S^-1 (L - black) of at least 0, but for single pixels.
        """
        level = np.zeros(self.channels)
        if self.blacks is None or self.black != "uniform":
            return level
        sides = [np.hstack([np.ones_like(total), total]) for total in self.blacks]
        solutions = solve_each(self.scene.systems, sides, rtol=BLACK_RTOL)
        for channel, solution in enumerate(solutions):
            even, black = solution.x.T
            is_lit = (self.divisors[channel] > 0.0) & (even > 0.0)
            ratio = np.divide(black, even, out=np.zeros_like(black), where=is_lit)
            picture = ratio.reshape(self.camera_grid)
            filtered = scipy.ndimage.median_filter(picture, BLACK_FILTER, mode="nearest")
            level[channel] = float(np.max(filtered, where=is_lit.reshape(picture.shape), initial=0))
        return level

    @property
    def background(self) -> list[np.ndarray] | None:
        """The blacks (M, 1) of each channel, less the level to which black is lifted."""
        if self.blacks is None:
            return None
        pairs = zip(self.blacks, self.black_level, strict=True)
        return [total - level for total, level in pairs]

    @cached_property
    def contrast(self) -> Contrast | None:
        """The contrast with and without a uniform black; None if blacks are unknown."""
        if self.blacks is None:
            return None
        measured = []
        uniform = []
        is_lit = self.divisors > 0.0
        level = self.black_level
        if self.black == "measured":
            level = np.array([total.max() for total in self.blacks])
        for channel, total in enumerate(self.blacks):
            lit = is_lit[channel]
            black = np.maximum(total[lit, 0], 0.0)
            white = self.divisors[channel, lit] + black
            # Without any black it is infinite.
            with np.errstate(divide="ignore"):
                measured.append(np.median(white / black))
                uniform.append(np.median(white / max(level[channel], black.min())))
        return Contrast(measured=float(min(measured)), uniform=float(min(uniform)))

    @cached_property
    def gamut(self) -> Gamut:
        """The colours that all projectors have in common, and how far these differ."""
        whites = []
        are_inside = inner_pixels(self.shares, self.camera_grid)
        for share, is_inside in zip(self.shares, are_inside, strict=True):
            white = [share.white(channel)[is_inside] for channel in range(self.channels)]
            whites.append(np.stack(white))
        return common_gamut(whites, self.mixings)

    @property
    def scene(self) -> Transport:
        """S between camera pixels, on the device at its first use."""
        if self.given_scene is not None:
            return self.given_scene
        return self._found_scene

    @cached_property
    def _found_scene(self) -> Transport:
        M = self.shape[0]
        is_lit = (self.divisors > 0.0).all(axis=0)
        checks.fits_host("S between camera pixels", 8 * self.channels * M**2)
        systems = []
        for channel in range(self.channels):
            R = 0.0
            for T, share in zip(self.transports, self.shares, strict=True):
                R = R + self._bounce(T, share, channel)
            S = R + scipy.sparse.diags_array(is_lit.astype(np.float32))
            if scipy.sparse.issparse(S):
                S = scipy.sparse.csr_array(S)
            systems.append(S)
        return SceneTransport(
            systems if self.channels == 3 else systems[0],
            self.camera_grid,
            first_bounce=is_lit.astype(np.float64),
            device=self._requested_device,
            noise=self._scene_noise(systems),
        )

    def _scene_noise(self, systems: Sequence[Any]) -> Noise | None:
        """The noise of S; None if that of some scan was not measured."""
        noises = measured_noises(self.transports)
        if noises is None:
            return None
        matrices = []
        directs = []
        sharing = []
        for T, share in zip(self.transports, self.shares, strict=True):
            matrices.append([_in_memory(T.matrices[channel]) for channel in range(self.channels)])
            directs.append(share.direct)
            sharing.append([self._sharing(share, channel) for channel in range(self.channels)])
        return scene_noise(noises, matrices, directs, sharing, systems)

    def _sharing(self, share: ProjectorShare, channel: int) -> scipy.sparse.csr_array:
        """Q_k (N_k, M) of one channel: the pattern of a projector from direct light."""
        divisor = self.divisors[channel]
        inverses = np.divide(1.0, divisor, out=np.zeros_like(divisor), where=divisor > 0.0)
        Q = scipy.sparse.diags_array(share.own) @ share.back @ scipy.sparse.diags_array(inverses)
        return scipy.sparse.csr_array(Q)

    def _bounce(self, T: Transport, share: ProjectorShare, channel: int) -> Any:
        """(T_k - F_k) Q_k of one channel, (M, M)."""
        Q = self._sharing(share, channel)
        matrix = _in_memory(T.matrices[channel])
        direct: Any = share.direct[channel] @ Q
        if scipy.sparse.issparse(matrix):
            return scipy.sparse.csr_array(matrix) @ Q - direct
        product = (scipy.sparse.csr_array(Q.T).astype(np.float32) @ matrix.T).T
        return product - direct.toarray().astype(np.float32)

    def share_light(self, direct: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Patterns (N, k) of each system that make direct light (M, k) of each channel."""
        drives = []
        for light, divisor in zip(direct, self.divisors, strict=True):
            safe = np.where(divisor > 0.0, divisor, np.inf)
            drives.append(light / safe[:, None])
        shared = []
        for share, mixing in zip(self.shares, self.mixings, strict=True):
            own = np.stack([share.own[:, None] * (share.back @ drive) for drive in drives])
            if self.couples:
                own = np.einsum("ij,jnk->ink", np.linalg.inv(mixing), own)
            shared.append(own)
        channels = []
        for channel in range(self.channels):
            patterns = [own[channel] for own in shared]
            channels.append(self.montage.vector(patterns))
        if self.couples:
            return [np.concatenate(channels)]
        return channels

    # Use.

    def split(self, pattern: Any) -> tuple[np.ndarray, ...]:
        """The pattern of each projector from a picture of all, and from codes of a Compensator."""
        return self.montage.split(pattern)

    def join(self, patterns: Sequence[Any]) -> np.ndarray:
        """The picture of all patterns, one for each projector."""
        return self.montage.join(patterns)

    def __matmul__(self, pattern: Any) -> np.ndarray:
        """Relight: the picture under one pattern for each projector, or under a picture of all."""
        if isinstance(pattern, (list, tuple)):
            pattern = self.join(pattern)
        return super().__matmul__(pattern)


def combine(
    transports: Sequence[Transport],
    *,
    blend: Any = "auto",
    balance: float = 0.5,
    blacks: Any = None,
    black: str = "measured",
    scene: Transport | None = None,
    device: Any = None,
) -> CombinedTransport:
    """Combine projectors that light one scene into one transport.

    Parameters
    ----------
    transports : sequence of 2 to 8 Transport
        T_k of each projector alone, of one camera that did not move: all of one `camera_grid`, in
        grey or in colour. Projectors may differ in resolution, brightness and mixing, and may miss
        parts of the scene.
    blend : "auto", "smooth", "linear" or a sequence of arrays (h, w)
        Weights of the pixels of each projector: "smooth" is the square of the distance to its
        border, in its own pixels, "linear" the distance itself, "auto" smooth unless an overlap is
        narrower than 16 pixels; or your own. Borders count where another projector lights the scene
        beyond.
    balance : float
        From 0, all light of all projectors counts where they overlap, to 1, as soft as possible
        near borders: a projector gives its full light where its weight is at least this part of the
        strongest one's.
    blacks : sequence of pictures (h, w[, 3]), optional
        Light of each projector that shows black, as the camera sees it.
    black : "measured" or "uniform"
        With "uniform", compensation lifts its target by the brightest black, so that black is the
        same everywhere; `contrast` says what that costs.
    scene : Transport, optional
        S between camera pixels, on the camera's grid. The `transports` are then direct light alone,
        such as those of ``strategy="direct"``, and sparse: T_k = S F_k.
    device : Device or str, optional
        As for `Transport`; that of `scene` where this is given.

    Returns
    -------
    CombinedTransport
        A `Transport` whose patterns stand side by side. `compensate` gives `patterns`, `relight`
        takes one pattern each, `separate` works in camera pixels.

    Raises
    ------
    InputError, InputTypeError
        Transports that do not fit each other, with blocks between colours, or without entries.

    Examples
    --------
    >>> import ltcl, numpy
    >>> left = ltcl.Transport([[0.5, 0.0], [0.1, 0.5], [0.0, 0.1]], (1, 2), camera_grid=(1, 3))
    >>> right = ltcl.Transport([[0.1, 0.0], [0.5, 0.1], [0.0, 0.5]], (1, 2), camera_grid=(1, 3))
    >>> T = ltcl.combine([left, right])
    >>> c = ltcl.compensate(T, numpy.full((1, 3), 0.4), rtol=1e-3)
    >>> [pattern.shape for pattern in c.patterns], bool(c.error < 2e-3)
    ([(1, 2), (1, 2)], True)
    """
    return CombinedTransport(
        transports,
        scene=scene,
        blend=blend,
        balance=balance,
        blacks=blacks,
        black=black,
        device=device,
    )


def _combine_again(
    transports: Sequence[Transport], options: dict[str, Any], displays: dict[str, np.ndarray]
) -> CombinedTransport:
    T = CombinedTransport(transports, **options)
    T.displays = displays
    return T


def check_members(transports: Any) -> tuple[Transport, ...]:
    """The transports, if they can be combined."""
    if not isinstance(transports, (list, tuple)):
        kind = type(transports).__name__
        raise InputTypeError(f"transports is a {kind}; it must be a list of ltcl.Transport")
    if not 2 <= len(transports) <= MAX_PROJECTORS:
        raise InputError(
            f"transports has {len(transports)} members; it must have 2 to {MAX_PROJECTORS}"
        )
    first = transports[0]
    for number, T in enumerate(transports):
        name = f"transports[{number}]"
        check_transport(T, square=False, name=name)
        if isinstance(T, CombinedTransport):
            raise InputError(f"{name} is a combination; give the transports of its projectors")
        if T.blocks is not None:
            raise InputError(f"{name} has 3 x 3 blocks between colours; give a mixing instead")
        for attribute in ("camera_grid", "channels"):
            value = getattr(T, attribute)
            expected = getattr(first, attribute)
            if value != expected:
                raise InputError(
                    f"{name} has {attribute} {value}; it must be {expected}, as that of "
                    "transports[0]"
                )
    return tuple(transports)


def check_scene(scene: Any, first: Transport) -> None:
    """Refuse an S that is not between the pixels of the camera."""
    check_transport(scene, name="scene")
    for attribute, expected in (("grid", first.camera_grid), ("channels", first.channels)):
        value = getattr(scene, attribute)
        if value != expected:
            raise InputError(
                f"scene has {attribute} {value}; it must be {expected}, as the camera of transports"
            )


def _in_memory(matrix: Any) -> Any:
    """An array or a csr_array from rows of a store, or the matrix itself."""
    if hasattr(matrix, "row_blocks"):
        return matrix.tocsr()
    return matrix


def _with_entries(T: Transport) -> Transport:
    """T, or the entries of a compressed one, such as a sketch; MemoryLimitError if too many."""
    if not T.is_compressed:
        return T
    matrices = T.to_numpy().astype(np.float32, copy=False)
    return Transport(
        list(matrices) if T.channels == 3 else matrices,
        T.grid,
        T.first_bounce,
        on_dark="mask",
        device=T.device,
        mixing=T.mixing,
        noise=T.measured_noise,
    )


def _entries(number: int, T: Transport) -> list[Any]:
    """The matrices of T on the host; refused if they show no entries."""
    matrices = [_in_memory(matrix) for matrix in T.matrices]
    for matrix in matrices:
        if not isinstance(matrix, (np.ndarray, scipy.sparse.csr_array)):
            kind = type(matrix).__name__
            raise InputTypeError(
                f"transports[{number}] is made of {kind}, which shows no entries; give arrays or "
                "sparse matrices, or direct light with scene="
            )
    return matrices


def _direct_of_member(number: int, T: Transport) -> tuple[scipy.sparse.csr_array, ...]:
    """F_k of each channel, searched in T_k."""
    return direct_parts(_entries(number, T), T.grid)


def _sparse_member(number: int, T: Transport) -> tuple[scipy.sparse.csr_array, ...]:
    """F_k of each channel, which T_k is where S is given."""
    return tuple(scipy.sparse.csr_array(matrix) for matrix in _entries(number, T))
