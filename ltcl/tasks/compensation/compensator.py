# SPDX-License-Identifier: BSD-3-Clause
"""`Compensator`: a compensation that is prepared once, for the frames of a film or a show.

All that does not change from frame to frame is done when it is made. A frame is then one upload, a
fixed list of launches, and one download; codes become light, and light codes, on the device.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.errors import InputError, InputTypeError
from ltcl.interop.arrays import giver, kind_of, memory_of
from ltcl.solvers import Inverse
from ltcl.tasks.compensation.codes import (
    AUTO,
    CODE_NAMES,
    CODE_TYPES,
    DECODES,
    SRGB,
    CodeTable,
    code_table,
    light_of_codes,
    srgb_light,
)
from ltcl.tasks.compensation.compensate import compensate
from ltcl.tasks.compensation.inputs import CompensationRequest, check_inputs
from ltcl.tasks.compensation.prepared import PreparedFrames, Slot
from ltcl.transport.transport import Transport

# A gain that follows the frames changes by this factor in a second at most.
GAIN_CHANGE = 2.0
# Share of the strips of pixels that may be brighter than the bound at the gain that is aimed at.
BRIGHT_SHARE = 0.005
# Latencies that are kept.
MAX_LATENCIES = 10_000
LATE = ("wait", "drop")
MAX_DEPTH = 64
# Beyond, in units of what the bounds allow, squares of light leave float32.
MAX_LIGHT = 1e15
MAX_GAIN = 1e15


@dataclass(frozen=True, kw_only=True)
class FrameStatistics:
    """Numbers of a `Compensator` so far.

    Attributes
    ----------
    frames, dropped : int
        Frames whose codes were given, and those that came too early to be taken.
    latency_p50, latency_p99 : float
        Seconds from a frame to its codes: the median, and what 99 % are below; NaN before the
        first frame.
    gain : float
        Gain of the last frame.
    products : int
        Products with R that a frame takes at least; frames between two whose bounces are computed
        take none.
    """

    frames: int
    dropped: int
    latency_p50: float
    latency_p99: float
    gain: float
    products: int

    def __str__(self) -> str:
        p50 = 1e3 * self.latency_p50
        p99 = 1e3 * self.latency_p99
        return f"{self.frames} frames, {self.dropped} dropped, p50 {p50:.1f} ms, p99 {p99:.1f} ms"


@dataclass(frozen=True, kw_only=True)
class FrameError:
    """The distance of the last frame from its target, as in `Compensation`.

    Attributes
    ----------
    error : float
        ``||W (appearance - target)|| / ||W target||``; where the target is black, without the
        divisor.
    clipped : float
        Share of the values of lit pixels that would go beyond a bound.
    """

    error: float
    clipped: float


class Compensator:
    """Prepared compensation: codes of the projector for the codes of a picture, frame by frame.

    Parameters
    ----------
    T : Transport
    gain : float, "auto" or "follow"
        Scale of the target. "auto" is the largest for all frames of `film`, as in
        `ltcl.compensate`. "follow" goes after the content: the gain at which the brightest light
        is at the upper bound, but for the brightest half percent of strips of 256 pixels.
    bounds, background, weights, inverse, rtol
        As in `ltcl.compensate`; background and weights are one picture, in linear light.
    clamp : bool
        Clamp the light to the bounds, and leave it at that.
    deadline_ms : float, optional
        Milliseconds after which no further projected step is begun, from the call on; without it
        they go on until the error is the least there is up to `rtol`. The result is never worse
        than the clamped pattern.
    warm : bool
        Begin the projected steps with the pattern of the frame before, where that is nearer than
        the clamped one. False gives each frame the same pattern whatever came before.
    bounces_every : int
        The light of bounces is computed of every so many frames. It stands for that of the frames
        in between, scaled by the gain: these take no product with R, and their direct light is
        their own. With light b to add, after b' whose bounces are kept, the error of such a frame
        is R (b - b'): the light that bounces of the change since then. It is 0 in a still film, and
        after a cut all that bounces is that of the picture before, until the next frame whose
        bounces are computed.
    decode : "auto", "srgb" or "linear"
        Meaning of the codes of frames; "auto" takes whole numbers as sRGB and floats as linear
        light. Whole numbers have white at the largest code, floats at 1.
    encode : "srgb", "linear" or a response
        Codes of the projector: with white at the upper bound, or those of a measured response, such
        as ``setup.calibration.projector`` of a scan, for light relative to its white.
    dtype : "uint8", "uint16" or "float32"
        Type of the projector's codes. Linear floats are the light as it is.
    film : iterable of frames, optional
        Frames that decide on gain="auto".
    gain_change, fps : float
        A gain that follows changes by at most this factor in a second of so many frames.
    depth : int
        Frames that may be on their way at once after `submit`.
    late : "wait" or "drop"
        Fate of a frame that is submitted when `depth` frames are on their way: it waits, or
        its result is None.

    Attributes
    ----------
    gain : float
        Gain of the next frame, which may be set.
    bounds : (low, high)
        Bounds of the next frame, which may be set, too: this waits for frames on their way. Until
        the next frame is given, `light` and `judge` then raise InputError.
    rtol : float
        Tolerance, as given, or what was chosen.
    statistics : FrameStatistics

    Raises
    ------
    InputError, InputTypeError
        As in `ltcl.compensate`; another name of a curve or type, gain="auto" without a film, or
        a T whose light cannot be undone in a fixed number of steps, with ``clamp=True`` or
        ``bounces_every`` above 1, which is also refused for a T without S and for several
        projectors.

    Notes
    -----
    Without an inverse, light is undone by as many steps of Chebyshev's iteration as probes need:
    the light of white, of a random pattern and a random picture are within half of `rtol`. What a
    frame has reached is told by `judge`, when it is asked.

    Where light is beyond the bounds and `clamp` is False, projected steps follow in each frame,
    also in one in between: they take products with T, and lower its error.

    Threads that call a compensator wait for each other. A frame may be an array of the device of T,
    and so may `out`.

    Examples
    --------
    >>> import ltcl, numpy
    >>> T = ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2))
    >>> compensator = ltcl.Compensator(T, encode="linear", dtype="float32")
    >>> compensator(numpy.array([[0.3, 0.3]])).round(2).tolist()
    [[0.5, 0.5]]
    >>> future = compensator.submit(numpy.array([[0.15, 0.15]]))
    >>> future.result().round(2).tolist(), compensator.statistics.frames
    ([[0.25, 0.25]], 2)

    In each second frame bounces are those of the frame before; a still film shows no difference:

    >>> half = ltcl.Compensator(T, bounces_every=2, encode="linear", dtype="float32")
    >>> [half(numpy.array([[light, light]])).round(2).tolist() for light in (0.3, 0.3)]
    [[[0.5, 0.5]], [[0.5, 0.5]]]
    """

    def __init__(
        self,
        T: Transport,
        *,
        gain: float | str = 1.0,
        bounds: tuple[float, float] = (0.0, 1.0),
        background: Any = None,
        weights: Any = None,
        inverse: Inverse | None = None,
        rtol: float | None = None,
        clamp: bool = False,
        deadline_ms: float | None = None,
        warm: bool = True,
        bounces_every: int = 1,
        decode: str = AUTO,
        encode: Any = SRGB,
        dtype: str = "uint8",
        film: Iterable[Any] | None = None,
        gain_change: float = GAIN_CHANGE,
        fps: float = 25.0,
        depth: int = 3,
        late: str = "wait",
    ) -> None:
        self._decode = checks.one_of("decode", decode, DECODES)
        self._dtype = _check_dtype(dtype)
        self._depth = checks.count("depth", depth, most=MAX_DEPTH)
        self._drops = checks.one_of("late", late, LATE) == "drop"
        self._seconds = math.inf
        if deadline_ms is not None:
            self._seconds = checks.number("deadline_ms", deadline_ms, above=0.0) / 1e3
        change = checks.number("gain_change", gain_change, least=1.0)
        self._frame_change = change ** (1.0 / checks.number("fps", fps, above=0.0))
        self._clamp = checks.flag("clamp", clamp)
        self._is_warm = checks.flag("warm", warm)
        self._bounces_every = checks.count("bounces_every", bounces_every)
        self.T = T
        self._options = {
            "bounds": checks.interval("bounds", bounds),
            "background": _own_picture("background", background),
            "weights": _own_picture("weights", weights),
            "method": "auto",
            "rtol": rtol,
            "exact": None,
            "inverse": inverse,
            "clamp": clamp,
            "loss": None,
            "options": {},
        }
        self.follows_gain = isinstance(gain, str) and gain == "follow"
        self._has_gain = not self.follows_gain
        # The gain may follow again later.
        self._has_peaks = self.follows_gain
        self._is_closed = False
        self._gain = 1.0
        # A background or weights in colour make grey frames colour, too.
        self._is_coloured = getattr(T, "channels", 3) == 3
        for value in (background, weights):
            self._is_coloured |= np.ndim(value) > 2
        # Checks all arguments, before anything is uploaded.
        request = self._request(1, self._options)
        self.rtol = request.problem.settings.rtol
        if self.follows_gain and not T.is_square and T.scene is T:
            raise InputError(
                "gain is 'follow', but this T has no S, whose light it follows; give a number"
            )
        if self._bounces_every > 1:
            _check_keeps_bounces(T, self._bounces_every)
        self._encode = encode
        self._white = _white_of(request)
        self._code_table(1, self._white)
        self._prepared: dict[tuple[int, str], PreparedFrames] = {}
        # Of the last frame.
        self._last: tuple[PreparedFrames, float] | None = None
        self._last_colours = 0
        if self.follows_gain and film is not None:
            raise InputError("film is given, but gain is 'follow'; a film belongs to 'auto'")
        if not self.follows_gain:
            self.gain = self._find_gain(gain, film)

        self._lock = threading.Lock()
        self._latencies: deque[float] = deque(maxlen=MAX_LATENCIES)
        self._frames = 0
        self._dropped = 0
        self._on_the_way: deque[Future[Any]] = deque()
        self._turn = 0
        self._collector = ThreadPoolExecutor(1, thread_name_prefix="ltcl-frames")
        # The kind of frame that is most likely, so that the first one does not wait for it.
        self._frames_of(self._channels(1), np.dtype(np.uint8))

    @property
    def gain(self) -> float:
        """The gain of the next frame, which may be set; InputError if it is not above 0."""
        return self._gain

    @gain.setter
    def gain(self, value: float) -> None:
        self._gain = checks.number("gain", value, above=0.0, most=MAX_GAIN)
        self._has_gain = True

    @property
    def bounds(self) -> tuple[float, float]:
        """The bounds of the next frame, which may be set; InputError as in `ltcl.compensate`."""
        return self._options["bounds"]

    @bounds.setter
    def bounds(self, value: tuple[float, float]) -> None:
        options = {**self._options, "bounds": checks.interval("bounds", value)}
        with self._lock:
            self._wait_for_all()
            kinds = list(self._prepared)
            frames = list(self._prepared.values())
            requests = [self._request(colours, options) for colours, _ in kinds]
            white = _white_of(requests[0])
            if all(map(PreparedFrames.takes_bounds, frames, requests)):
                for (colours, _), prepared, request in zip(kinds, frames, requests, strict=True):
                    prepared.set_bounds(request, self._code_table(colours, white))
            else:
                # What is refused here leaves all as it was.
                colours, dtype = kinds[0]
                first = self._prepare_anew(requests[0], colours, np.dtype(dtype), white)
                self._prepared = {kinds[0]: first}
            self._options = options
            self._white = white
            self._last = None

    # Preparation.

    def _channels(self, colours: int) -> int:
        """Channels of the light of frames of so many colours."""
        return 3 if self._is_coloured else colours

    def _code_table(self, colours: int, white: float) -> CodeTable:
        """The codes of the projector's light for frames of so many colours."""
        return code_table(self._encode, self._dtype, self._channels(colours), white)

    def _request(self, colours: int, options: dict[str, Any]) -> CompensationRequest:
        """Checked inputs for black pictures of so many colours, or of three if it must be."""
        grid = getattr(self.T, "camera_grid", (1, 1))
        shape = (*grid, 3) if self._channels(colours) == 3 else grid
        request = check_inputs(self.T, np.zeros(shape, np.float32), gain=1.0, **options)
        request.problem.check_range(1.0)
        return request

    def _find_gain(self, gain: Any, film: Iterable[Any] | None) -> float:
        """The gain of all frames."""
        if isinstance(gain, str) and gain == "auto":
            if film is None:
                raise InputError("gain is 'auto', but film is None; give the frames it is for")
            light = self._light_of_film(film)
            options = {**self._options}
            extra = options.pop("options")
            return compensate(self.T, light, gain="auto", **options, **extra).gain
        if film is not None:
            raise InputError(f"film is given, but gain is {gain!r}; a film belongs to 'auto'")
        if isinstance(gain, str):
            raise InputError(f"gain is {gain!r}; it must be 'auto', 'follow' or a number above 0")
        return checks.number("gain", gain, above=0.0, most=MAX_GAIN)

    def _light_of_film(self, film: Iterable[Any]) -> np.ndarray:
        """Linear light of all frames, (k, h, w) or (k, h, w, 3)."""
        if isinstance(film, str | bytes | Path) or not isinstance(film, Iterable):
            raise InputTypeError(
                f"film is {checks.shown(film)}; it must be frames, such as a list of arrays"
            )
        light = []
        for number, frame in enumerate(film, start=1):
            try:
                light.append(self._light_of_frame(_host_array("frame", frame)))
            except (InputError, InputTypeError) as error:
                raise type(error)(f"film, frame {number}: {error}") from None
        if not light:
            raise InputError("film has no frames; give the frames that decide on gain='auto'")
        if len({frame.ndim for frame in light}) > 1:
            light = [np.broadcast_to(np.atleast_3d(f), (*f.shape[:2], 3)) for f in light]
        return np.stack(light)

    def _light_of_frame(self, frame: np.ndarray) -> np.ndarray:
        """Linear light of codes; (h, w, 3) where T is in colour."""
        codes = self._codes_of(frame)
        assert not isinstance(codes, Array)  # noqa: S101 - an array of the host stays one
        light = codes
        if codes.dtype.kind != "f":
            light = light_of_codes(self._decode, codes.dtype)[codes]
        if light.ndim == 2 and self.T.channels == 3:
            light = np.repeat(light[..., None], 3, axis=-1)
        return light

    def _frames_of(self, colours: int, dtype: np.dtype) -> PreparedFrames:
        """The prepared steps for frames of so many colours and one type; made at the first one."""
        # The device has its own order of bytes.
        dtype = dtype.newbyteorder("=")
        key = (colours, dtype.name)
        if key not in self._prepared:
            self._prepared[key] = self._prepare(colours, dtype)
        return self._prepared[key]

    def _prepare(self, colours: int, dtype: np.dtype) -> PreparedFrames:
        channels = self._channels(colours)
        for known in self._prepared.values():
            if known.colours == channels:
                return known.for_codes(colours, dtype, self._decode)
        request = self._request(channels, self._options)
        return self._prepare_anew(request, colours, dtype, self._white)

    def _prepare_anew(
        self, request: CompensationRequest, colours: int, dtype: np.dtype, white: float
    ) -> PreparedFrames:
        """Steps that share nothing with those of other frames."""
        return PreparedFrames(
            request,
            frame_colours=colours,
            frame_dtype=dtype,
            decode=self._decode,
            dtype=self._dtype,
            table=self._code_table(colours, white),
            is_bounded=not self._clamp,
            is_warm=self._is_warm,
            has_peaks=self._has_peaks,
            slots=self._depth,
            bounces_every=self._bounces_every,
        )

    # Frames.

    def __call__(self, frame: Any, out: Any = None) -> Any:
        """Codes of the projector for a frame; waits.

        Parameters
        ----------
        frame : (h, w) or (h, w, 3), array or device array
            uint8, uint16 or float.
        out : array or device array, optional
            Where the codes are written, which is then returned.

        Returns
        -------
        array of the kind of the frame
            (h, w) on the projector's grid, or (h, w, 3) where T or the frame is in colour.
        """
        begun_at = time.perf_counter()
        with self._lock:
            self._wait_for_all()
            codes = self._codes_of(frame)
            memory = self._memory_of(out, codes)
            prepared, slot = self._begin(codes, begun_at)
            pattern_codes = self._end(prepared, slot)
            if isinstance(memory, Array):
                memory.set(pattern_codes)
            elif memory is not None:
                np.copyto(memory, pattern_codes)
        if out is not None:
            return out
        return giver(frame)(pattern_codes)

    def submit(self, frame: Any) -> Future[np.ndarray | None]:
        """Take a frame, and give its codes later, in order.

        Copies and launches of neighbouring frames overlap. The result is None if the frame was
        dropped. Where light is brought within the bounds by projected steps, this returns when they
        are done. A callback of a future must not call the compensator: its thread collects frames.
        """
        begun_at = time.perf_counter()
        with self._lock:
            self._forget_done()
            codes = self._codes_of(frame)
            if len(self._on_the_way) >= self._depth:
                if self._drops:
                    self._dropped += 1
                    dropped: Future[np.ndarray | None] = Future()
                    dropped.set_result(None)
                    return dropped
                wait([self._on_the_way.popleft()])
            prepared, slot = self._begin(codes, begun_at)
            prepared.keep_within_bounds(slot.begun_at + self._seconds)
            prepared.end(slot)
            give = giver(frame)
            future: Future[Any] = self._collector.submit(self._collect_as, give, prepared, slot)
            self._on_the_way.append(future)
            return future

    def _forget_done(self) -> None:
        while self._on_the_way and self._on_the_way[0].done():
            self._on_the_way.popleft()

    def _wait_for_all(self) -> None:
        """Wait for the frames on their way, whatever became of them."""
        wait(self._on_the_way)
        self._on_the_way.clear()

    def _begin(self, codes: np.ndarray | Array, begun_at: float) -> tuple[PreparedFrames, Slot]:
        """Queue a frame in the next slot."""
        colours = 3 if len(codes.shape) == 3 else 1
        prepared = self._frames_of(colours, codes.dtype)
        slot = prepared.slots[self._turn % self._depth]
        self._turn += 1
        if prepared.colours != self._last_colours:
            # Those that are kept for frames of these colours may be of any frame before.
            prepared.forget_bounces()
        self._last_colours = prepared.colours
        prepared.begin(slot, codes, self.gain, begun_at)
        self._last = (prepared, self.gain)
        if not self._has_gain:
            self._first_gain(prepared, slot, codes)
        return prepared, slot

    def _codes_of(self, frame: Any) -> np.ndarray | Array:
        """The frame as the device takes it: uint8, uint16, or linear float32."""
        if self._is_closed:
            raise InputError("the compensator is closed; make another one for further frames")
        if isinstance(frame, Array):
            self._check_frame(frame)
            if frame.dtype.name not in CODE_TYPES:
                raise InputTypeError(
                    f"frame holds {frame.dtype} on the device; it must be one of {CODE_NAMES}"
                )
            if frame.dtype.kind == "f" and self._decode == SRGB:
                raise InputError(
                    "frame is a device array of floats, but decode is 'srgb'; give codes of whole "
                    "numbers, or decode='auto'"
                )
            if frame.device is not self.T.device:
                raise InputError(f"frame is on {frame.device}; it must be on {self.T.device}")
            # Floats on the device are not read for a check.
            self._check_brightness(1.0)
            return frame
        codes = _host_array("frame", frame)
        self._check_frame(codes)
        if codes.dtype.kind != "f":
            self._check_brightness(1.0)
            return codes
        light = srgb_light(codes) if self._decode == SRGB else codes
        light = checks.finite("frame", light)
        self._check_brightness(float(np.max(np.abs(light))))
        return light.astype(np.float32, copy=False)

    def _check_brightness(self, brightest: float) -> None:
        """Refuse light, 1 for white of whole numbers, far beyond what the bounds allow."""
        highest = MAX_LIGHT
        for prepared in self._prepared.values():
            highest = min(highest, MAX_LIGHT * prepared.unit)
        if brightest * self.gain > highest:
            raise InputError(
                f"frame reaches {brightest:.3g} at a gain of {self.gain:.3g}; with bounds of "
                f"{self.bounds} light must be at most {highest:.3g}"
            )

    def _memory_of(self, out: Any, codes: np.ndarray | Array) -> np.ndarray | Array | None:
        """The place of the codes of this frame; one that does not take them as they are is refused.

        None where there is none.
        """
        if out is None:
            return None
        colours = self._channels(3 if len(codes.shape) == 3 else 1)
        shape = (*self.T.grid, 3) if colours == 3 else self.T.grid
        memory = out if isinstance(out, Array) else memory_of(out)
        if memory is None or memory.shape != shape or memory.dtype.name != self._dtype:
            raise InputError(
                f"out is {checks.shown(out)}; it must be an array {shape} of {self._dtype}, in "
                "memory that NumPy can write to"
            )
        if isinstance(memory, np.ndarray) and not memory.flags.writeable:
            raise InputError("out is read-only; it must be an array that can be written")
        return memory

    def _check_frame(self, frame: Any) -> None:
        grid = self.T.camera_grid
        if frame.dtype.kind not in "biufc":
            raise InputTypeError(f"frame is {checks.shown(frame)}; it must be a picture")
        if frame.shape not in (grid, (*grid, 3)):
            raise InputError(f"frame has shape {frame.shape}; it must be {grid} or {(*grid, 3)}")
        if frame.dtype.name not in ("uint8", "uint16", "float32", "float64", "float16"):
            raise InputTypeError(f"frame holds {frame.dtype}; it must be uint8, uint16 or floats")

    def _end(self, prepared: PreparedFrames, slot: Slot) -> np.ndarray:
        prepared.keep_within_bounds(slot.begun_at + self._seconds)
        prepared.end(slot)
        return self._collect(prepared, slot)

    def _collect_as(
        self, give: Callable[[np.ndarray], Any], prepared: PreparedFrames, slot: Slot
    ) -> Any:
        """The codes of a frame in the kind of array that it was."""
        return give(self._collect(prepared, slot))

    def _collect(self, prepared: PreparedFrames, slot: Slot) -> np.ndarray:
        """Wait for the codes of a frame, and take note of it."""
        codes = prepared.take(slot)
        self._latencies.append(time.perf_counter() - slot.begun_at)
        self._frames += 1
        if self.follows_gain:
            self._follow(slot)
        return codes

    # The gain that follows.

    def _first_gain(self, prepared: PreparedFrames, slot: Slot, codes: np.ndarray | Array) -> None:
        """Begin at the gain of the first frame, which is then computed again."""
        prepared.end(slot)
        prepared.take(slot)
        gain_of_peaks = _gain_of_peaks(slot)
        self._has_gain = True
        if gain_of_peaks is None:
            return
        self.gain = min(gain_of_peaks, MAX_GAIN)
        prepared.forget_bounces()
        prepared.begin(slot, codes, self.gain, slot.begun_at)
        self._last = (prepared, self.gain)

    def _follow(self, slot: Slot) -> None:
        """Bring the gain of frames to come nearer to what this one allows."""
        gain_of_peaks = _gain_of_peaks(slot)
        if gain_of_peaks is not None:
            lowest = self.gain / self._frame_change
            highest = self.gain * self._frame_change
            self.gain = min(max(gain_of_peaks, lowest), highest, MAX_GAIN)

    # Facts.

    @property
    def statistics(self) -> FrameStatistics:
        """Numbers so far."""
        p50 = math.nan
        p99 = math.nan
        latencies = list(self._latencies)
        if latencies:
            p50, p99 = np.quantile(latencies, [0.5, 0.99]).tolist()
        prepared = next(iter(self._prepared.values()))
        products = 0
        if prepared.direct_steps is not None:
            products = prepared.direct_steps.products
        last_gain = self.gain if self._last is None else self._last[1]
        return FrameStatistics(
            frames=self._frames,
            dropped=self._dropped,
            latency_p50=p50,
            latency_p99=p99,
            gain=last_gain,
            products=products,
        )

    def light(self) -> np.ndarray:
        """The projector light of the last frame, (h, w) or (h, w, 3) float32.

        InputError before the first frame, also the first one with other bounds.
        """
        with self._lock:
            if self._last is None:
                raise InputError("no frame was given yet with these bounds; give one first")
            prepared = self._last[0]
            light = prepared.light()
        h, w = self.T.grid
        if prepared.colours == 3:
            shape = (h, w, 3)
        else:
            shape = (h, w)
        return light.reshape(shape)

    def judge(self) -> FrameError:
        """The error and the clipped share of the last frame, by a product with T.

        InputError before the first frame, also the first one with other bounds.
        """
        with self._lock:
            self._wait_for_all()
            if self._last is None:
                raise InputError("no frame was given yet with these bounds; give one first")
            error, clipped = self._last[0].judge()
        return FrameError(error=error, clipped=clipped)

    def close(self) -> None:
        """Wait for the frames on their way, and take no more; facts of the last one stay."""
        self._is_closed = True
        self._collector.shutdown(wait=True)

    def __reduce__(self) -> Any:
        raise InputTypeError(
            "Compensator lies on a device and cannot be pickled; pickle its T and options, and "
            "make it where it works, such as in a worker process"
        )

    def __enter__(self) -> Compensator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _white_of(request: CompensationRequest) -> float:
    """The light of the largest code."""
    high = float(request.problem.limits.high)
    return high if high > 0.0 else 1.0


def _own_picture(name: str, value: Any) -> Any:
    """A copy of a picture, which its owner may change; None and a number as they are."""
    if value is None or np.ndim(value) == 0:
        return value
    return np.array(checks.real(name, value))


def _host_array(name: str, value: Any) -> np.ndarray:
    """An array of any library as NumPy's; what is no array of numbers is refused later."""
    if kind_of(type(value)) is None:
        return np.asarray(value)
    return checks.real(name, value)


def _check_dtype(dtype: Any) -> str:
    """The name of a type of codes."""
    try:
        name = np.dtype(dtype).name
    except TypeError:
        name = ""
    if name not in CODE_TYPES:
        raise InputError(f"dtype is {dtype!r}; it must be one of {CODE_NAMES}")
    return name


def _check_keeps_bounces(T: Transport, every: int) -> None:
    """Refuse a T without an S of its own, of whose bounces some frames could do without."""
    if T.is_square:
        return
    if T.scene is not T:
        raise InputError(
            f"bounces_every is {every}, but T has several projectors, which share the light of "
            "each frame; leave it out"
        )
    raise InputError(
        f"bounces_every is {every}, but this T has no S, whose bounces it keeps; leave it out"
    )


def _gain_of_peaks(slot: Slot) -> float | None:
    """The gain at which the light of a frame would reach the upper bound; None for a dark one."""
    peaks = np.sort(slot.peaks.take())
    place = math.ceil((1.0 - BRIGHT_SHARE) * (len(peaks) - 1))
    peak = float(peaks[place])
    if not peak > 0.0:
        return None
    return slot.gain / peak
