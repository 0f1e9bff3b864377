# SPDX-License-Identifier: BSD-3-Clause
"""`compensate_frames`: patterns for a folder or a video of frames, a batch of right-hand sides at a time.

Every frame gets the same gain: one that followed the frames would make the scene flicker. gain="auto" is
found once, on a sample of frames from all over the source, and kept. A frame that needs more light than the
sample did is brought as near as the bounds allow, and its record tells how much of it is clipped. What a
solve leaves, up to `rtol`, differs from frame to frame; where that is seen, a smaller one helps.

Batches begin at the same frames in every run and share nothing but T, so that a run that was ended early and
resumed gives what an uninterrupted one does: to the last bit where `method` takes the same way, as a named
one does; "auto" may know more of S the second time.
"""

from __future__ import annotations

import inspect
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks, layout
from ltcl.batch import identity, manifest
from ltcl.batch.manifest import Manifest
from ltcl.batch.output import BITS, Output
from ltcl.batch.reading import Reader
from ltcl.batch.result import CompensatedFrames
from ltcl.batch.run import Run, staying
from ltcl.compensation import compensate, problem
from ltcl.errors import InputError
from ltcl.files import as_path
from ltcl.images.codes import Encoding
from ltcl.images.frames import check_video, open_frames, write_video
from ltcl.transport import Transport, require, resolve_reference

_USUAL_FPS = 25.0


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
    progress: Callable[[int, int | None], object] | None = None,
    codes: Callable[[np.ndarray], np.ndarray] | None = None,
    **options: Any,
) -> CompensatedFrames:
    """Find the patterns under which a scene shows the frames of a film.

    Parameters
    ----------
    T : Transport
        As in `ltcl.compensate`.
    source
        A folder of pictures, or a video file, as `ltcl.images.frames.open_frames` takes it; all of one size.
    out
        A folder: pattern_000001.png and so on, and frames.json, which tells settings and frames done. What is
        in it already stays.
    batch : int
        Frames solved at once; more need more memory and, up to a point, less time for each. What a solve
        leaves within `rtol` depends on the frames beside, and the sample for a gain is as large: when
        resuming it has to be the same.
    resume : bool
        Go on where an earlier run with the same T, settings and frames ended; from the beginning where there
        was none. Without it, a folder with frames of an earlier run is refused.
    frames : int, optional
        Only so many, from the first on.
    format : str
        "png", 16 bits in sRGB with white at the upper bound of the light; or "exr", the light as it is.
    appearance : bool
        Write T pattern + background, too, into a folder appearance within `out`.
    video : optional
        Also a video of the patterns: .mkv or .avi (lossless), .mp4. It is made from the pictures when all
        are done.
    fps : float, optional
        Of that video; that of the source, or 25.
    encoding, resize
        What the frames hold; whether to scale them to the camera's grid.
    gain : float or "auto"
        Of all frames; "auto" finds the largest for a sample of `batch` frames, evenly spread.
    loss : float, optional
        As in `ltcl.compensate`, of that sample.
    progress : callable(done, total), optional
        Called after every batch with the number of frames done, of earlier runs, too; total is None where the
        source does not tell.
    codes : callable(pattern), optional
        What the projector is fed for a pattern of light, (h, w) or (h, w, 3), such as
        `ltcl.acquisition.Setup.codes`: .png and video then hold these codes, and not sRGB.
    **options
        Of `ltcl.compensate`: bounds, method, rtol, exact, and so on; background and weights are one picture.

    Returns
    -------
    CompensatedFrames

    Raises
    ------
    FileError, InputError
        As `ltcl.compensate`, `open_frames` and `write_video`; a frame that cannot be read or has another
        size; a folder with frames of an earlier run; one whose T, settings or frames differ when resuming.
    ConvergenceError
        As in `ltcl.compensate`.
        After any of these, or Ctrl-C, the frames of all batches before stay done.

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
    checks.one_of("format", format, BITS)
    fps = None if fps is None else checks.number("fps", fps, above=0.0)
    limit = None if frames is None else checks.count("frames", frames)
    bounds = _checked(T, gain, loss, options)
    if video is not None:
        check_video(video, T.grid)
    opened = open_frames(source, encoding=encoding)
    _apart(opened.path, {"out": out, "video": video})
    kept = _manifest(
        T,
        as_path(out),
        resume,
        {"gain": gain, "loss": loss, "batch": checks.count("batch", batch), "format": format}
        | {"appearance": appearance, "encoding": encoding, "resize": resize, "codes": codes, **options},
    )
    white = bounds[1] if bounds[1] > 0 else 1.0
    output = Output(kept.path.parent, format, white, appearance, codes)
    output.sweep()
    run = Run(T, Reader(opened, T.camera_grid, resize, limit), output, kept, batch, options)
    with staying(kept):
        for _ in run.solve(gain, loss):
            if progress is not None:
                progress(len(run.passed), run.reader.count)
        if video is not None:
            write_video(video, output.patterns(run.passed), fps or opened.fps or _USUAL_FPS)
    return run.result(None if video is None else as_path(video), time.perf_counter() - start)


def _checked(T: Transport, gain: Any, loss: Any, options: dict[str, Any]) -> tuple[float, float]:
    """The bounds, (low, high); refuses what `compensate` would, and pictures that are not for all frames."""
    require(T, square=False)
    resolve_reference(T, options.get("exact"))
    problem.gain(gain, loss)
    for name in ("background", "weights"):
        value = options.get(name)
        if value is None or checks.real(name, value).ndim == 0:
            continue
        count = layout.unpack(name, value, T.camera_grid, T.channels)[1].frames
        if count is not None:
            raise InputError(f"{name} holds {count} frame(s); it must be one picture, for all frames alike")
    return checks.interval("bounds", options.get("bounds", (0.0, 1.0)))


def _apart(source: Path, targets: dict[str, Any]) -> None:
    """Refuse to write where the frames come from."""
    for name, target in targets.items():
        if target is not None and as_path(target).resolve() == source.resolve():
            raise InputError(f"{name} is {target}, where the frames are; it must be another place")


def _manifest(T: Transport, folder: Path, resume: bool, settings: dict[str, Any]) -> Manifest:
    known = inspect.signature(compensate).parameters.values()
    usual = {each.name: each.default for each in known if each.kind is each.KEYWORD_ONLY}
    used = {name: value for name, value in {**usual, **settings}.items() if name != "callback"}
    described = {name: identity.of_setting(value) for name, value in used.items()}
    kept = Manifest(folder / manifest.NAME, described, identity.of_transport(T))
    if resume:
        kept.take_up()
    else:
        manifest.refuse_earlier(kept.path)
    return kept
