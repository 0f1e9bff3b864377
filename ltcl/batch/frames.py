# SPDX-License-Identifier: BSD-3-Clause
"""`compensate_frames`: patterns for a folder or video of frames, a batch of frames at a time.

Every frame gets the same gain: one that followed the frames would make the scene flicker. Batches
begin at the same frames in every run and share nothing but T and a survey of S. So a resumed run,
or one on a cluster, gives what an uninterrupted one does, to the last bit on devices of one kind
with one memory of timings. Frames that are missing from a batch are solved alone, to the same
tolerance: the rest after `frames=`, or a lost pattern.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl import checks
from ltcl.batch import manifest
from ltcl.batch.cluster import is_there, stream
from ltcl.batch.film_run import BatchSolver, FilmRun
from ltcl.batch.manifest import FrameRecord, OtherRun, curve, identity, setting
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.files import as_path, locked
from ltcl.images.encoding import Encoding
from ltcl.images.frames import Source, check_video, open_frames, write_video
from ltcl.images.pictures import RESIZES
from ltcl.tasks.compensation import compensate
from ltcl.tasks.compensation.inputs import ARGUMENTS, check_gain, check_solves
from ltcl.tasks.report import versions
from ltcl.tasks.requirements import error_note
from ltcl.transport import frames as picture_frames
from ltcl.transport.transport import Transport, check_transport

if TYPE_CHECKING:
    from distributed import Client

DEFAULT_FPS = 25.0
# Options of `compensate` that say how light is found.
SOLVES = ("method", "rtol", "exact", "inverse", "clamp")


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class CompensatedFrames:
    """Result of `compensate_frames`.

    Attributes
    ----------
    folder, video : Path, Path or None
    gain : float
    records : tuple of FrameRecord
        One for each frame, in order, those of earlier runs, too.
    solved : int
        Number of frames that this run solved, in `seconds`.
    transport_error : float
        Error of T, which is not in the errors of the records.
    """

    folder: Path
    video: Path | None
    gain: float
    records: tuple[FrameRecord, ...]
    solved: int
    seconds: float
    transport_error: float = 0.0

    @property
    def frames_per_second(self) -> float:
        """Speed of this run; 0 where nothing was left to do."""
        return self.solved / self.seconds if self.solved else 0.0

    @property
    def worst(self) -> FrameRecord:
        """The frame with the largest error."""
        return max(self.records, key=lambda record: record.error)

    @property
    def most_clipped(self) -> FrameRecord:
        """The frame with the largest share of clipped values."""
        return max(self.records, key=lambda record: record.clipped)

    def __repr__(self) -> str:
        count = f"{len(self.records)} in {self.folder}"
        error = f"{self.worst.error:.2%}{error_note(self.transport_error)}"
        place = f"frame {self.worst.number}"
        return f"<ltcl CompensatedFrames {count}, largest error {error} in {place}>"


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
    resize: str | None = None,
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
    T : Transport
    source : path
        Folder of pictures or video file, as `ltcl.images.frames.open_frames` takes it.
    out : path
        Folder for pattern_000001.png and so on, and frames.json with settings and frames. Other
        files in it stay; a second run in it at the same time is refused.
    batch : int
        Number of frames solved at once; more need more memory and, up to a point, less time each.
    resume : bool
        Go on where an earlier run with the same T, settings and frames ended, if there was one.
        Without it, a folder with frames of an earlier run is refused.
    frames : int, optional
        Solve only so many, from the first on.
    format : str
        "png", 16 bits in sRGB with white at the upper bound of the light; or "exr", the light as it
        is.
    appearance : bool
        Write T pattern + background, too, into a folder appearance within `out`.
    video, fps : optional
        Also a video of the patterns: .mkv or .avi (lossless), .mp4; by default at the source's
        rate, or 25.
    encoding : str
        Encoding of the frames, as `ltcl.images.read` takes it.
    resize : "crop", "letterbox" or "stretch", optional
        Scale frames to the camera's grid, as `ltcl.images.resize` does; None: they have its size.
    gain : float or "auto"
        The gain of all frames; "auto" finds the largest for a sample of `batch` frames, evenly
        spread. A frame that needs more light is clipped, and its record tells how much.
    progress : callable("frames", done, total), optional
        Called before every batch and at the end; done counts frames of earlier runs, too; total may
        be None.
    codes : callable(pattern), optional
        Codes of the projector for a pattern of light, such as `ltcl.acquisition.Setup.codes`: .png
        and video then hold these, and not sRGB.
    client : distributed.Client, optional
        Client of a Dask cluster whose workers solve, as in `ltcl.cluster.stream`. T is loaded there
        from the file that `ltcl.load` read here, if all workers see it, or sent once. Files are
        those of a run without it.
    share_gpu : bool
        Let several workers use one GPU.
    **options
        Options of `ltcl.compensate`: bounds, method, rtol, exact, and so on; background and weights
        are one picture.

    Raises
    ------
    FileError, InputError, ConvergenceError
        Those of `ltcl.compensate`, `open_frames` and `write_video`; frames of another size or of
        another run. Finished frames stay, as after Ctrl-C. A frame that cannot be read, or has
        another size than those before, is left out, and named when all others are done.
    ClusterError
        Those of `ltcl.cluster.stream`.

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
    checks.count("batch", batch)
    if fps is not None:
        fps = checks.number("fps", fps, above=0.0)
    if frames is not None:
        frames = checks.count("frames", frames)
    white = _check_light(T, gain, loss, options, has_client=client is not None)
    _check_functions(codes=codes, progress=progress)
    if video is not None:
        check_video(video, T.grid)
    if resize is not None:
        checks.one_of("resize", resize, RESIZES)
    source_frames = open_frames(source, encoding=encoding)
    folder = as_path(out)
    _check_places(source_frames, out=out, video=video)

    head = _head(
        T,
        gain=gain,
        loss=loss,
        batch=batch,
        format=format,
        appearance=appearance,
        encoding=encoding,
        resize=resize,
        codes=codes,
        **options,
    )
    solver = BatchSolver(
        T=T,
        options=options,
        needs_appearance=appearance,
        needs_codes=format == "png" and codes is None,
        identity=head["transport"],
        reload=_reload_on_workers(T, client),
    )
    run = FilmRun(
        solver=solver,
        stream=partial(stream, client, share_gpu=share_gpu),
        source=source_frames,
        limit=frames,
        folder=folder,
        head=head,
        white=white,
        codes=codes,
    )
    with locked(folder, wait=False):
        run.records |= manifest.read(folder, head, resume)
        with _finished_frames_named(run):
            _solve_batches(run, gain, loss, progress)
            if video is not None:
                rate = fps or source_frames.fps or DEFAULT_FPS
                video = as_path(video)
                write_video(video, run.patterns(), rate)
    records = [run.records[number] for number in sorted(run.done)]
    reference = options.get("exact") or T
    return CompensatedFrames(
        folder=folder,
        video=video,
        gain=head["gain"] or 0.0,
        records=tuple(records),
        solved=run.solved_count,
        seconds=time.perf_counter() - start,
        transport_error=reference.error,
    )


def _solve_batches(
    run: FilmRun,
    gain: float | str,
    loss: float | None,
    progress: Callable[[str, int, int | None], object] | None,
) -> None:
    """Solve and write all batches; tell `progress` of each."""
    # Closed at once where Ctrl-C ends it: a batch that is solved is written.
    with contextlib.closing(run.solve(gain, loss)) as batches:
        for done in batches:
            if progress is not None:
                progress("frames", done, run.count)


def _check_light(
    T: Transport,
    gain: float | str,
    loss: float | None,
    options: dict[str, Any],
    *,
    has_client: bool,
) -> float:
    """Check T and what `compensate` gets; return the light that is white in .png."""
    check_transport(T, square=False)
    check_gain(gain, loss)
    _check_pictures(T, options)
    _, high = checks.interval("bounds", options.get("bounds", (0.0, 1.0)))
    solves = {name: options[name] for name in SOLVES if name in options}
    if has_client:
        # An inverse is tried out on a device; the workers have one.
        solves.pop("inverse", None)
    others = {name: value for name, value in options.items() if name not in ARGUMENTS}
    check_solves(T, **solves, options=others)
    return high if high > 0 else 1.0


def _head(T: Transport, **settings: Any) -> dict[str, Any]:
    """Return the head of the list of frames: what must be the same when a run goes on."""
    if settings["codes"] is not None:
        settings["codes"] = curve(settings["codes"], T.grid)
    settings = {**_defaults(), **settings}
    settings.pop("callback", None)
    return {
        "versions": versions(),
        "settings": {name: setting(value) for name, value in settings.items()},
        "transport": identity(T),
        "gain": None,
    }


def _defaults() -> dict[str, Any]:
    """The options of `compensate` with their defaults."""
    defaults = {}
    for name, parameter in inspect.signature(compensate).parameters.items():
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY:
            defaults[name] = parameter.default
    return defaults


@contextlib.contextmanager
def _finished_frames_named(run: FilmRun) -> Iterator[None]:
    """Tell in an error of the block how many frames are done, and how to go on."""
    try:
        yield
    except LtclError as error:
        if run.records and not isinstance(error, OtherRun):
            done = f"{len(run.records)} frame(s) are done and stay in {run.folder}"
            advice = "resume=True (--resume) goes on from there"
            error.args = (f"{error}; {done}; {advice}",)
        raise


def _check_functions(**functions: Any) -> None:
    for name, value in functions.items():
        if value is not None and not callable(value):
            raise InputTypeError(f"{name} is {checks.shown(value)}; it must be a function, or None")


def _check_pictures(T: Transport, options: dict[str, Any]) -> None:
    """Refuse a background or weights that differ from frame to frame."""
    for name in ("background", "weights"):
        value = options.get(name)
        if value is None or checks.real(name, value).ndim == 0:
            continue
        _, layout = picture_frames.unpack(name, value, T.camera_grid, T.channels)
        if layout.frames is not None:
            raise InputError(
                f"{name} holds {layout.frames} frame(s); "
                "it must be one picture, for all frames alike"
            )


def _check_places(source: Source, **places: Any) -> None:
    """Refuse to write where the frames are."""
    for name, place in places.items():
        if place is not None and as_path(place).resolve() == source.path.resolve():
            raise InputError(f"{name} is {place}, where the frames are; it must be another place")


def _reload_on_workers(T: Transport, client: Any) -> Callable[[], Transport] | None:
    """Function that loads T from its file, where all workers see that."""
    reload: Any = T.reload
    if client is None:
        return None
    file = None if reload is None else reload.args[0]
    return reload if is_there(client, file) else None
