# SPDX-License-Identifier: BSD-3-Clause
"""Output that is there whole or not at all, and input files that are files.

A hidden temporary on the same disk is written, flushed and renamed, which is atomic. Its name tells
host and process: the next writer in a folder removes those of processes that were killed (not on
Windows).
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

fcntl: Any = (
    None if os.name == "nt" else importlib.import_module("fcntl")
)  # Windows: nothing is locked
_HOST = f"{zlib.crc32(platform.node().encode()):08x}"
_TEMPORARY = re.compile(rf"\..*-{_HOST}-(\d{{1,9}})-[0-9a-f]{{8}}(\.[^.]*)?", re.DOTALL)


def input_file(path: Any) -> Path:
    """Return `path` as a Path if it is a regular file with something in it, else raise FileError."""
    path = as_path(path)
    try:
        status = path.stat()
        if stat.S_ISREG(status.st_mode):  # asked before opening: a named pipe would block
            path.open("rb").close()
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except OSError as error:
        raise _refusal(path, "cannot be read", error) from error
    if not stat.S_ISREG(status.st_mode) or not status.st_size:
        kind = (
            "a folder"
            if path.is_dir()
            else "empty"
            if stat.S_ISREG(status.st_mode)
            else "no regular file"
        )
        raise FileError(f"{path}: is {kind}; it must be a file with content")
    return path


def as_path(path: Any, name: str = "path") -> Path:
    """Return `path` (str or os.PathLike) as a Path; refuse everything else, an empty text, and NUL."""
    if not str(path) or "\0" in str(path):
        raise FileError(f"{path or name} is {str(path)!r}; it must name a file or a folder")
    try:
        return Path(path)
    except TypeError:
        raise InputTypeError(
            f"{name} is {checks.shown(path)}; it must be a str or a path"
        ) from None


def unknown_extension(path: Path) -> str:
    """What is wrong with the extension of `path`, for a refusal."""
    return f"extension {path.suffix} is unknown" if path.suffix else "has no extension"


@contextlib.contextmanager
def replace_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file under a temporary name; put it at `path` only when the block ends well.

    The temporary is next to `path`, its extension in lower case (SciPy appends .mtx to .MTX).
    Missing parents are made, removed on failure; links followed, permissions stay. FileError: no
    file, OSError in the block.
    """
    with _written(path) as target:
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

    Into an existing folder files are moved one by one, and others stay; with `replace` the new
    folder takes its place (see `restore`). Parents, links, errors: see `replace_file`.
    """
    with _written(path) as target:
        if target.exists() and not target.is_dir():
            raise FileError(f"{path}: is a file; a folder cannot be written there")
        joins = target.exists() and not replace
        temporary = _temporary(target, "ltcl") if joins else _temporary(target.parent, target.name)
        try:
            temporary.mkdir()
            yield temporary
            files = flush_tree(temporary)
            if joins:
                _move_into(target, temporary, files)
            elif target.exists():
                os.replace(target, _earlier(target))
            if not joins:
                os.replace(temporary, target)
            _flush(target.parent)
        finally:
            if replace:
                restore(target)
            shutil.rmtree(temporary, ignore_errors=True)


def restore(target: Path) -> None:
    """Make one folder of the two that a run leaves which ended between two renames of `fill_folder`."""
    earlier = _earlier(target)
    if not os.path.lexists(target) and earlier.exists():
        os.replace(earlier, target)
    shutil.rmtree(earlier, ignore_errors=True)


@contextlib.contextmanager
def locked(folder: Path, *, wait: bool = True) -> Iterator[None]:
    """One process at a time in a folder, made if need be; without `wait` the second is refused."""
    created = [place for place in (folder, *folder.parents) if not place.exists()]
    with _written(folder / "*"):
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY) if fcntl else -1
    try:
        if fcntl:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
    except BlockingIOError:
        raise FileError(
            f"{folder}: another run writes there; wait for it, or give another folder"
        ) from None
    finally:
        if fcntl:
            os.close(handle)
        for place in created:
            with contextlib.suppress(OSError):  # something is in it
                place.rmdir()


def sweep(folder: Path) -> None:
    """Remove the temporaries of processes of this host that are no more."""
    names = os.listdir(folder) if os.name != "nt" and os.access(folder, os.R_OK) else []
    for owner in filter(None, map(_TEMPORARY.fullmatch, names)):
        with contextlib.suppress(PermissionError):  # it lives, and is somebody else's
            try:
                os.kill(int(owner[1]), 0)  # asks, and does nothing
            except ProcessLookupError:
                place = folder / owner[0]
                shutil.rmtree(place, ignore_errors=True) if place.is_dir() else place.unlink(
                    missing_ok=True
                )


def _temporary(folder: Path, stem: str, suffix: str = "") -> Path:
    sweep(folder)
    return folder / f".{stem[:40]}-{_HOST}-{os.getpid()}-{secrets.token_hex(4)}{suffix}"


def _earlier(target: Path) -> Path:
    return target.with_name(f".{target.name[:80]}.ltcl-earlier")


def _move_into(target: Path, temporary: Path, files: list[Path]) -> None:
    moves = [(file, target / file.relative_to(temporary)) for file in files]
    for _, final in moves:  # refuse every clash before the first file moves
        if final.is_dir() or any(p.exists() and not p.is_dir() for p in final.parents):
            name = final.relative_to(target)
            raise FileError(f"{target}: {name} cannot be placed there, a name in its path is used")
    for file, final in moves:
        final.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, final)
    for folder in {final.parent for _, final in moves}:
        _flush(folder)


@contextlib.contextmanager
def _written(path: str | os.PathLike[str]) -> Iterator[Path]:
    """The place that `path` means, its parents made; an OSError of the block becomes one line about it."""
    target = Path(os.path.realpath(as_path(path)))
    created = [folder for folder in target.parents if not os.path.exists(folder)]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield target
    except BaseException as error:
        for folder in created:
            with contextlib.suppress(OSError):  # no longer empty: somebody else's by now
                folder.rmdir()
        if not isinstance(error, OSError) or isinstance(error, LtclError):
            raise
        place = Path(error.filename) if isinstance(error.filename, (str, Path)) else target
        if not (place.is_relative_to(target.parent) or target.is_relative_to(place)):
            raise  # about another file, which the block read
        raise _refusal(Path(path), "cannot be written", error) from error


def _refusal(path: Path, what: str, error: OSError) -> FileError:
    return FileError(f"{path}: {what}: {' '.join((error.strerror or str(error)).split())}")


def flush_tree(folder: Path) -> list[Path]:
    """Flush all in a folder to the disk; its files."""
    places = sorted(folder.rglob("*"))
    for place in (*places, folder):
        _flush(place)
    return [place for place in places if place.is_file()]


def _flush(path: Path) -> None:
    """Of a folder this makes a rename survive a power cut; Windows cannot open a folder, and need not."""
    with contextlib.suppress(OSError) if path.is_dir() else contextlib.nullcontext():
        handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def read_ahead(read: Callable[[Any], Any], keys: Iterable[Any], ahead: int = 2) -> Iterator[Any]:
    """`read` of each key, in order, by threads that are so many keys ahead of the caller."""
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
