# SPDX-License-Identifier: BSD-3-Clause
"""`compensate_frames`: patterns for a folder or a video of frames, a batch of right-hand sides at a time.

Every frame gets the same gain: one that followed the frames would make the scene flicker. Batches
begin at the same frames in every run and share nothing but T and a survey of S: a resumed run, or
one on a cluster, gives what an uninterrupted one does, to the last bit on devices of one kind with
one memory of timings. What is missing from a batch is solved alone, to the same tolerance: the rest
after `frames=`, or a lost pattern.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, islice, repeat, tee
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl import checks, images
from ltcl.batch import manifest
from ltcl.batch.cluster import is_there, stream
from ltcl.batch.manifest import OtherRun, Record, curve, identity, setting
from ltcl.errors import FileError, InputError, InputTypeError, LtclError
from ltcl.files import as_path, locked, read_ahead
from ltcl.images.encoding import Encoding
from ltcl.images.frames import Frame, Source, check_video, open_frames, write_video
from ltcl.solvers import Inverse
from ltcl.solvers.auto import SMALL, survey
from ltcl.tasks.compensation import compensate
from ltcl.tasks.compensation.inputs import check_gain
from ltcl.tasks.report import versions
from ltcl.tasks.requirements import error_note, resolve_reference
from ltcl.transport import frames as layout
from ltcl.transport.transport import Transport, check_transport

if TYPE_CHECKING:
    from distributed import Client

_Read = tuple[Frame, str, np.ndarray]  # a frame, its digest and its picture
_NAMED = 5  # broken frames, in an error
_WRITERS = 4  # threads: files are compressed and flushed side by side


@dataclass(frozen=True, eq=False, repr=False)
class CompensatedFrames:
    """Result of `compensate_frames`: a record a frame, in order, those of earlier runs, too.

    `solved` frames of this run took `seconds`. `transport_error` is not in the errors of the
    records.
    """

    folder: Path
    video: Path | None
    gain: float
    records: tuple[Record, ...]
    solved: int
    seconds: float
    transport_error: float = 0.0

    @property
    def frames_per_second(self) -> float:
        """Of this run; 0 where nothing was left to do."""
        return self.solved / self.seconds if self.solved else 0.0

    @property
    def worst(self) -> Record:
        """The frame with the largest error."""
        return max(self.records, key=lambda record: record.error)

    @property
    def most_clipped(self) -> Record:
        """The frame with the largest share of clipped values."""
        return max(self.records, key=lambda record: record.clipped)

    def __repr__(self) -> str:
        worst = self.worst
        error = f"largest error {worst.error:.2%}{error_note(self.transport_error)} in frame {worst.number}"
        return f"<ltcl CompensatedFrames {len(self.records)} in {self.folder}, {error}>"


def compensate_frames(
    T: Transport,
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    batch: int = 8,
    resume: bool = False,
    frames: int | None = None,
    format: str = "png",
    appearance: bool = False,
    video: str | os.PathLike[str] | None = None,
    fps: float | None = None,
    encoding: Encoding = "auto",
    resize: bool = False,
    gain: float | str = 1.0,
    loss: float | None = None,
    progress: Callable[[str, int, int | None], object] | None = None,
    codes: Callable[[np.ndarray], np.ndarray] | None = None,
    client: Client | None = None,
    share_gpu: bool = False,
    **options: Any,
) -> CompensatedFrames:
    """Find the patterns under which a scene shows the frames of a film.

    Parameters
    ----------
    T, source : Transport; folder of pictures or video file, as of `ltcl.images.frames.open_frames`
    out
        A folder: pattern_000001.png and so on, and frames.json with settings and frames. Other
        files in it stay; a second run in it at the same time is refused.
    batch : int
        Frames solved at once; more need more memory and, up to a point, less time each.
    resume : bool
        Go on where an earlier run with the same T, settings and frames ended, if there was one.
        Without it, a folder with frames of an earlier run is refused.
    frames : int, optional, only so many, from the first on
    format : str
        "png", 16 bits in sRGB with white at the upper bound of the light; or "exr", the light as it
        is.
    appearance : bool
        Write T pattern + background, too, into a folder appearance within `out`.
    video, fps : optional
        Also a video of the patterns: .mkv or .avi (lossless), .mp4; by default at the source's
        rate, or 25.
    encoding, resize : what the frames hold; whether to scale them to the camera's grid
    gain : float or "auto"
        Of all frames; "auto" finds the largest for a sample of `batch` frames, evenly spread. A
        frame that needs more light is clipped, and its record tells how much.
    progress : callable("frames", done, total), optional
        Called before every batch and at the end; done counts frames of earlier runs, too; total may
        be None.
    codes : callable(pattern), optional
        Codes of the projector for a pattern of light, such as `ltcl.acquisition.Setup.codes`: .png
        and video then hold these, and not sRGB.
    client : distributed.Client, optional
        Of a Dask cluster whose workers solve, as `ltcl.cluster.stream` does it. T is loaded there
        from the file that `ltcl.load` read here, if all see it, or sent once. Files are those of a
        run without it.
    share_gpu : bool
        Whether several workers may use one GPU.
    **options
        Of `ltcl.compensate`: bounds, method, rtol, exact, and so on; background and weights are one
        picture.

    Raises
    ------
    FileError, InputError, ConvergenceError
        As `ltcl.compensate`, `open_frames` and `write_video`; frames of another size or of another
        run. What was done stays, as after Ctrl-C. One that cannot be read, or is of another size
        than those before, is left out, and named when all others are done.
    ClusterError
        As `ltcl.cluster.stream`.

    Examples
    --------
    >>> import ltcl, numpy, pathlib, tempfile
    >>> T = ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2))
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> for number in range(3):
    ...     ltcl.images.write(folder / f"{number}.exr", numpy.full((1, 2), 0.1 * number))
    >>> done = ltcl.batch.compensate_frames(T, folder, folder / "patterns")
    >>> [record.name for record in done.records], done.worst.error < 1e-4
    (['0.exr', '1.exr', '2.exr'], True)
    >>> ltcl.images.read(folder / "patterns" / "pattern_000003.png").round(2)
    array([[0.33, 0.33]], dtype=float32)
    """
    start = time.perf_counter()
    checks.one_of("format", format, ("png", "exr"))
    checks.flag("resume", resume)
    checks.flag("appearance", appearance)
    fps = None if fps is None else checks.number("fps", fps, above=0.0)
    limit = None if frames is None else checks.count("frames", frames)
    bounds = _validate(T, gain, loss, {"codes": codes, "progress": progress}, options)
    if video is not None:
        check_video(video, T.grid)
    opened, folder = open_frames(source, encoding=encoding), as_path(out)
    for name, target in {"out": out, "video": video}.items():
        if target is not None and as_path(target).resolve() == opened.path.resolve():
            raise InputError(f"{name} is {target}, where the frames are; it must be another place")
    settings = {**(compensate.__kwdefaults__ or {}), "gain": gain, "loss": loss}
    settings |= {"batch": checks.count("batch", batch), "format": format, "appearance": appearance}
    settings |= {
        "encoding": encoding,
        "resize": resize,
        "codes": codes and curve(codes, T.grid),
        **options,
    }
    described = {name: setting(value) for name, value in settings.items() if name != "callback"}
    head = {"versions": versions(), "settings": described, "transport": identity(T), "gain": None}
    reload: Any = T.reload
    seen = client is not None and is_there(client, reload and reload.args[0])
    solver = _Solver(T, options, appearance, head["transport"], reload if seen else None)
    each = partial(stream, client, share_gpu=share_gpu)
    run = _Run(
        solver, each, opened, limit, folder, head, bounds[1] if bounds[1] > 0 else 1.0, codes
    )
    with locked(folder, wait=False):
        run.records |= manifest.read(folder, head, resume)
        try:
            for done in run.solve(gain, loss):
                if progress is not None:
                    progress("frames", done, run.count)
            if video is not None:
                write_video(video, run.patterns(), fps or opened.fps or 25.0)
        except LtclError as error:
            if run.records and not isinstance(error, OtherRun):
                done = f"{len(run.records)} frame(s) are done and stay in {folder}"
                error.args = (f"{error}; {done}; resume=True (--resume) goes on from there",)
            raise
    records = tuple(run.records[number] for number in sorted(run.done))
    error = (options.get("exact") or T).error
    seconds, film = time.perf_counter() - start, None if video is None else as_path(video)
    return CompensatedFrames(folder, film, head["gain"] or 0.0, records, run.solved, seconds, error)


def _validate(
    T: Transport, gain: Any, loss: Any, functions: dict[str, Any], options: dict[str, Any]
) -> tuple[float, float]:
    """The bounds; refuses what `compensate` would, and pictures that are not for all frames."""
    check_transport(T, square=False)
    resolve_reference(T, options.get("exact"))
    check_gain(gain, loss)
    for name, value in functions.items():
        if value is not None and not callable(value):
            raise InputTypeError(f"{name} is {checks.shown(value)}; it must be a function, or None")
    for name in ("background", "weights"):
        value = options.get(name)
        if value is None or checks.real(name, value).ndim == 0:
            continue
        count = layout.unpack(name, value, T.camera_grid, T.channels)[1].frames
        if count is not None:
            raise InputError(
                f"{name} holds {count} frame(s); it must be one picture, for all frames alike"
            )
    return checks.interval("bounds", options.get("bounds", (0.0, 1.0)))


@dataclass(eq=False)
class _Solver:
    """Pattern, appearance, errors and clipped parts of a batch: of a run what its workers get, once."""

    T: Transport
    options: dict[str, Any]
    appearance: bool
    identity: dict[str, Any]
    reload: Callable[[], Transport] | None = (
        None  # on workers, in the place of T: reads it from its file
    )
    gain: Any = None  # of all frames, when it is known

    def __call__(self, batch: tuple[list[int], np.ndarray]) -> tuple[Any, ...]:
        """Of numbers and pictures. With "auto", every batch sees the same survey of S."""
        numbers, pictures = batch
        try:
            if (
                self.options.get("method", "auto") == "auto"
                and self.T.is_square
                and self.T.shape[0] > SMALL
            ):
                for S in self.T.systems:
                    survey(S)
            solved = compensate(self.T, pictures, gain=self.gain, **self.options)
        except LtclError as error:
            error.args = (f"frames {numbers[0]} to {numbers[-1]}: {error}",)
            raise
        light = (solved.pattern, solved.appearance)[: 1 + self.appearance]
        return light, solved.frame_errors.tolist(), solved.frame_clipped.tolist()

    def __getstate__(self) -> dict[str, Any]:
        options = {name: value for name, value in self.options.items() if name != "callback"}
        return dict(vars(self), T=None if self.reload else self.T, options=options)

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if self.reload is not None:
            self.T = self.reload()
            if identity(self.T) != self.identity:
                raise InputError("the file of T holds another T there; give all workers the same")
        for value in (self.T, *self.options.values()):  # each worker has a device of its own
            if isinstance(value, Transport):
                value._requested_device = None
            elif isinstance(value, Inverse):
                vars(value)["_index"] = None


@dataclass(eq=False)
class _Run:
    """The loop over batches: read ahead, solve here or on workers, write, record, in this order."""

    solver: _Solver
    each: Callable[..., Iterator[Any]]  # results of the solver, here or by workers
    source: Source
    limit: int | None
    folder: Path
    head: dict[str, Any]  # of the manifest
    white: float  # light that is white in .png
    codes: Callable[[np.ndarray], np.ndarray] | None
    read: int = 0  # frames, of the right size
    records: dict[int, Record] = field(
        default_factory=dict
    )  # by number, of all runs into the folder
    done: set[int] = field(default_factory=set)  # numbers of frames, of earlier runs, too
    broken: dict[int, str] = field(default_factory=dict)  # frames that are left out, and why
    solved: int = 0

    def __post_init__(self) -> None:
        known, settings = self.source.count, self.head["settings"]
        self.count = known and min(known, self.limit or known)  # as far as the source tells
        self.size, self.format, self.resize = (
            settings[name] for name in ("batch", "format", "resize")
        )

    def solve(self, gain: float | str, loss: float | None) -> Iterator[int]:
        """All batches; yields the number of frames done, before the first that is not and after each."""
        ahead = read_ahead(partial(next, self._batches()), repeat(None), 1)
        batches = iter(partial(next, ahead), None)
        first = [*islice(batches, 1)]
        yield len(self.done)
        if first and self.head["gain"] is None:
            self.head["gain"] = self._gain(gain, loss, first[0])
        self.solver.gain = self.head["gain"]
        taken, waiting = tee(chain(first, batches))
        tasks = (([frame.number for frame, *_ in batch], _stack(batch)) for batch in taken)
        with ThreadPoolExecutor(_WRITERS) as writers:
            for (light, *numbers), batch in zip(
                self.each(self.solver, tasks), waiting, strict=True
            ):
                list(writers.map(self._write, (frame.number for frame, *_ in batch), *light))
                for (frame, digest, _), *others in zip(batch, *numbers, strict=True):
                    self.records[frame.number] = Record(frame.number, frame.name, digest, *others)
                    self.done.add(frame.number)
                manifest.write(self.folder, self.head, self.records)
                self.solved += len(batch)
                yield len(self.done)
        if self.broken:
            named = ", ".join(
                f"{number} ({why})" for number, why in sorted(self.broken.items())[:_NAMED]
            )
            more = f" and {len(self.broken) - _NAMED} more" if len(self.broken) > _NAMED else ""
            raise FileError(f"{self.source.path}: frames were left out: {named}{more}")

    def _gain(self, gain: float | str, loss: float | None, first: list[_Read]) -> float:
        """The one of all frames, of a sample: the first frames where their number is unknown."""
        if not isinstance(gain, str):
            return float(gain)
        count = self.count or self.size
        numbers = {*np.rint(np.linspace(1, count, min(self.size, count))).astype(int).tolist()}
        frames = (frame for frame in islice(self.source, max(numbers)) if frame.number in numbers)
        sample = [read for frame in frames for read in self._read(frame)]
        T, options = self.solver.T, self.solver.options
        return compensate(T, _stack(sample or first), gain=gain, loss=loss, **options).gain

    def _batches(self) -> Iterator[list[_Read]]:
        """The frames that no earlier run has done, without broken ones."""
        frames = islice(self.source, self.limit)
        while batch := [*islice(frames, self.size)]:
            if missing := [read for frame in batch for read in self._read(frame)]:
                yield missing

    def _read(self, frame: Frame) -> list[_Read]:
        """One frame, on the camera's grid; none where it is done, or broken, which is noted."""
        record, (h, w) = self.records.get(frame.number), self.solver.T.camera_grid
        place = f"{self.source.path}: frame {frame.number} ({frame.name})"
        try:
            digest = frame.digest()
            if record is not None and record.digest != digest:
                advice = f"give the same frames to go on, or another folder than {self.folder}"
                raise OtherRun(f"{place} has changed since its pattern was made; {advice}")
            if record and all(file.is_file() for file in self._files(frame.number)):
                self.done.add(frame.number)
                return []
            picture = frame.picture()
            if picture.shape[:2] != (h, w) and not self.resize:
                size = (
                    f"{picture.shape[0]} x {picture.shape[1]} pixels, but the camera has {h} x {w}"
                )
                raise InputError(
                    f"{place} is {size}; give resize=True (--resize) to scale all frames"
                )
        except InputError as error:
            if isinstance(error, OtherRun) or not (isinstance(error, FileError) or self.read):
                raise  # also where all seem to be of another size
            self.broken[frame.number] = str(error)
            return []
        self.read += 1
        return [
            (
                frame,
                digest,
                picture if picture.shape[:2] == (h, w) else images.resize(picture, (h, w)),
            )
        ]

    def patterns(self) -> Iterator[np.ndarray]:
        """As they were written, white at 1; codes as the light of which sRGB makes them."""
        for number in sorted(self.done):
            pattern = images.read(self._files(number)[0])
            if self.format == "exr":
                codes = self.codes
                pattern = (
                    images.from_srgb(codes(pattern)) if codes else pattern / np.float32(self.white)
                )
            yield pattern

    def _files(self, number: int) -> list[Path]:
        """Those of a frame: its pattern and, where asked for, its appearance."""
        names = ["pattern_{:06}.{}", "appearance/appearance_{:06}.{}"][: 1 + self.solver.appearance]
        return [self.folder / name.format(number, self.format) for name in names]

    def _write(self, number: int, *light: np.ndarray) -> None:
        """A frame's files; an appearance in a .png is divided by the gain, as the picture asked for."""
        whites = (self.white, self.head["gain"])[: len(light)]
        for file, values, white in zip(self._files(number), light, whites, strict=True):
            if self.format == "exr":
                images.write(file, values)
            elif self.codes is not None and values is light[0]:
                images.write(file, self.codes(values), bits=16, encoding="linear")
            else:
                images.write(file, values / np.float32(white), bits=16)


def _stack(batch: Sequence[_Read]) -> np.ndarray:
    """Its pictures: (frames, h, w), or (frames, h, w, 3) where one of them is in colour."""
    pictures = np.stack(np.broadcast_arrays(*(np.atleast_3d(picture) for *_, picture in batch)))
    return pictures if pictures.shape[-1] == 3 else pictures[..., 0]
