# SPDX-License-Identifier: BSD-3-Clause
"""Output that is there whole or not at all, and input files that are files.

A hidden temporary file on the same disk is written, flushed and renamed, which is atomic. Its name
tells host and process: the next writer in a folder removes the temporaries of processes that were
killed (not on Windows).
"""

from __future__ import annotations

import contextlib
import importlib
import os
import platform
import re
import secrets
import shutil
import stat
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import FileError, InputTypeError, LtclError

IS_WINDOWS = os.name == "nt"
# Windows has no fcntl: nothing is locked there.
fcntl: Any = None if IS_WINDOWS else importlib.import_module("fcntl")

HOST = f"{zlib.crc32(platform.node().encode()):08x}"
TEMPORARY_NAME = re.compile(rf"\..*-{HOST}-(\d{{1,9}})-[0-9a-f]{{8}}(\.[^.]*)?", re.DOTALL)


def input_file(path: Any) -> Path:
    """Return `path` as a Path if it is a regular file with content, else raise FileError."""
    path = as_path(path)
    try:
        status = path.stat()
        is_regular = stat.S_ISREG(status.st_mode)
        # The kind is asked before the file is opened: a named pipe would block.
        if is_regular:
            path.open("rb").close()
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except OSError as error:
        raise _refusal(path, "cannot be read", error) from error

    if path.is_dir():
        kind = "a folder"
    elif not is_regular:
        kind = "no regular file"
    elif status.st_size == 0:
        kind = "empty"
    else:
        return path
    raise FileError(f"{path}: is {kind}; it must be a file with content")


def as_path(path: Any, name: str = "path") -> Path:
    """Return `path` (str or os.PathLike) as a Path; refuse all else, an empty text, and NUL."""
    text = str(path)
    if not text or "\0" in text:
        raise FileError(f"{path or name} is {text!r}; it must name a file or a folder")
    try:
        return Path(path)
    except TypeError:
        shown = checks.shown(path)
        raise InputTypeError(f"{name} is {shown}; it must be a str or a path") from None


def unknown_extension(path: Path) -> str:
    """Say why the extension of `path` is refused."""
    if path.suffix:
        return f"extension {path.suffix} is unknown"
    return "has no extension"


@contextlib.contextmanager
def replace_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file under a temporary name; put it at `path` only when the block ends well.

    The temporary file is next to `path`, its extension in lower case (SciPy appends .mtx to .MTX).
    Missing parents are made, and removed on failure; links are followed, permissions stay.
    FileError where `path` is no regular file, or the block raised an OSError.
    """
    with _place_to_write(path) as target:
        if target.exists() and not target.is_file():
            raise FileError(
                f"{path}: is a folder, or no regular file; a file cannot be written there"
            )
        temporary = _temporary(target.parent, target.stem, target.suffix.lower())
        try:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            yield temporary
            _flush(temporary)
            if target.exists():
                shutil.copymode(target, temporary)
            os.replace(temporary, target)
            _flush(target.parent)
        finally:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def fill_folder(path: str | os.PathLike[str], *, replace: bool = False) -> Iterator[Path]:
    """Fill a temporary folder; put it at `path` only when the block ends well.

    Into an existing folder files are moved one by one, and its other files stay; with `replace` the
    new folder takes its place (see `restore`). Parents, links and errors are as in `replace_file`.
    """
    with _place_to_write(path) as target:
        if target.exists() and not target.is_dir():
            raise FileError(f"{path}: is a file; a folder cannot be written there")
        is_joining = target.exists() and not replace
        if is_joining:
            temporary = _temporary(target, "ltcl")
        else:
            temporary = _temporary(target.parent, target.name)
        try:
            temporary.mkdir()
            yield temporary
            files = flush_tree(temporary)
            if is_joining:
                _move_into(target, temporary, files)
            else:
                if target.exists():
                    os.replace(target, _earlier(target))
                os.replace(temporary, target)
            _flush(target.parent)
        finally:
            if replace:
                restore(target)
            shutil.rmtree(temporary, ignore_errors=True)


def restore(target: Path) -> None:
    """Repair a folder whose writer was killed between the two renames of `fill_folder`.

    The earlier folder comes back where the new one is missing; else it is removed.
    """
    earlier = _earlier(target)
    if not os.path.lexists(target) and earlier.exists():
        os.replace(earlier, target)
    shutil.rmtree(earlier, ignore_errors=True)


@contextlib.contextmanager
def locked(folder: Path, *, wait: bool = True) -> Iterator[None]:
    """Allow one process at a time in a folder, which is made if need be.

    Without `wait` the second process is refused with a FileError.
    """
    created = [place for place in (folder, *folder.parents) if not place.exists()]
    handle = -1
    with _place_to_write(folder / "*"):
        if fcntl is not None:
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        if fcntl is not None:
            mode = fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB
            fcntl.flock(handle, mode)
        yield
    except BlockingIOError:
        advice = "wait for it, or give another folder"
        raise FileError(f"{folder}: another run writes there; {advice}") from None
    finally:
        if fcntl is not None:
            os.close(handle)
        _remove_empty(created)


def sweep(folder: Path) -> None:
    """Remove the temporaries of processes of this host that no longer run."""
    if IS_WINDOWS or not os.access(folder, os.R_OK):
        return
    for name in os.listdir(folder):
        match = TEMPORARY_NAME.fullmatch(name)
        if match is None or _is_running(int(match[1])):
            continue
        place = folder / name
        if place.is_dir():
            shutil.rmtree(place, ignore_errors=True)
        else:
            with contextlib.suppress(PermissionError):
                place.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    """True if a process of this host runs, be it somebody else's."""
    try:
        os.kill(process, 0)  # asks, and does nothing
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _temporary(folder: Path, stem: str, suffix: str = "") -> Path:
    sweep(folder)
    unique = f"{HOST}-{os.getpid()}-{secrets.token_hex(4)}"
    return folder / f".{stem[:40]}-{unique}{suffix}"


def _earlier(target: Path) -> Path:
    return target.with_name(f".{target.name[:80]}.ltcl-earlier")


def _move_into(target: Path, temporary: Path, files: list[Path]) -> None:
    """Move files from a temporary folder to the same places in `target`."""
    destinations = [target / file.relative_to(temporary) for file in files]
    # Every clash is refused before the first file moves.
    for destination in destinations:
        is_used = destination.is_dir() or any(map(_is_no_folder, destination.parents))
        if is_used:
            name = destination.relative_to(target)
            raise FileError(f"{target}: {name} cannot be placed there, a name in its path is used")
    for file, destination in zip(files, destinations, strict=True):
        destination.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, destination)
    for folder in {destination.parent for destination in destinations}:
        _flush(folder)


def _is_no_folder(path: Path) -> bool:
    return path.exists() and not path.is_dir()


@contextlib.contextmanager
def _place_to_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Resolve `path` and make its parents; an OSError of the block becomes one line about it."""
    target = Path(os.path.realpath(as_path(path)))
    created = [folder for folder in target.parents if not os.path.exists(folder)]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield target
    except BaseException as error:
        _remove_empty(created)
        if not isinstance(error, OSError) or isinstance(error, LtclError):
            raise
        if not _is_about(error, target):
            raise
        raise _refusal(Path(path), "cannot be written", error) from error


def _is_about(error: OSError, target: Path) -> bool:
    """True if an error is about `target` or its folders, not about a file that the block read."""
    if not isinstance(error.filename, (str, Path)):
        return True
    place = Path(error.filename)
    return place.is_relative_to(target.parent) or target.is_relative_to(place)


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders, the innermost first, unless something is in them by now."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


def _refusal(path: Path, problem: str, error: OSError) -> FileError:
    reason = " ".join((error.strerror or str(error)).split())
    return FileError(f"{path}: {problem}: {reason}")


def flush_tree(folder: Path) -> list[Path]:
    """Flush all in a folder to the disk, and return its files."""
    places = sorted(folder.rglob("*"))
    for place in (*places, folder):
        _flush(place)
    return [place for place in places if place.is_file()]


def _flush(path: Path) -> None:
    """Flush a file to the disk; or a folder, so that a rename in it survives a power cut."""
    if not path.is_dir():
        _flush_handle(os.open(path, os.O_RDWR))
        return
    # Windows cannot open a folder, and need not.
    with contextlib.suppress(OSError):
        _flush_handle(os.open(path, os.O_RDONLY))


def _flush_handle(handle: int) -> None:
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read_ahead(read: Callable[[Any], Any], keys: Iterable[Any], ahead: int = 2) -> Iterator[Any]:
    """Yield `read(key)` of each key, in order; threads read up to `ahead` keys ahead."""
    with ThreadPoolExecutor(ahead) as threads:
        waiting: deque[Future[Any]] = deque()
        for key in keys:
            waiting.append(threads.submit(read, key))
            if len(waiting) > ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def check_mapped_file(array: Any) -> Any:
    """Return `array`; FileError if it is mapped to a file that has become shorter.

    Reading pages beyond the end of a file ends the process.
    """
    root = underlying_array(array)
    path = getattr(root, "filename", None)
    if path is None or not os.path.exists(path):
        return array
    if os.path.getsize(path) < root.offset + root.nbytes:
        raise FileError(f"{path}: has become shorter; it must stay as it is while T is used")
    return array


def underlying_array(array: Any) -> Any:
    """The array that owns the memory of `array`, which is a view of it or that array itself."""
    while isinstance(getattr(array, "base", None), np.ndarray):
        array = array.base
    return array
