# SPDX-License-Identifier: BSD-3-Clause
"""Output that is there whole or not at all, and input files that are files.

A hidden temporary file on the same disk is written, flushed and renamed, which is atomic. A new
folder is exchanged with the one that it replaces, which is atomic, too, where the file system is
able to (on Linux and macOS; not NFS).

A writer holds a lock on its temporary, a reader of a folder on a file in it. What nobody has locked
any more is removed by the next writer in the same place. Windows has no such locks: nothing is
removed there.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import importlib
import os
import platform
import re
import secrets
import shutil
import stat
import weakref
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

# Some network file systems have locks that only their own host sees.
HOST = f"{zlib.crc32(platform.node().encode()):08x}"
TEMPORARY_NAME = re.compile(rf"\..*-{HOST}-[0-9a-f]{{16}}(\.[^.]*)?", re.DOTALL)
# Arguments of renameat2(2) and renamex_np(2) that exchange two names.
CURRENT_FOLDER = -100
RENAME_EXCHANGE = 2
# Errors of file systems that cannot exchange; EPERM is that of sandboxes.
CANNOT_EXCHANGE = (
    errno.EINVAL,
    errno.ENOSYS,
    errno.ENOTSUP,
    errno.EOPNOTSUPP,
    errno.EXDEV,
    errno.EPERM,
)
# Errors of file systems without locks; EBADF is that of NFS.
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL, errno.EBADF)
# Errors of a writer that another one overtakes.
OVERTAKEN = (errno.ENOENT, errno.ENOTEMPTY, errno.EEXIST)
# Attempts to open a folder; it is nowhere for an instant while it is replaced in two steps.
OPEN_ATTEMPTS = 100


def input_file(path: Any, shown: Path | None = None) -> Path:
    """Return `path` as a Path if it is a regular file with content, else raise FileError.

    The message names it as `shown`.
    """
    path = as_path(path)
    label: Path = shown or path
    try:
        status = path.stat()
        is_regular = stat.S_ISREG(status.st_mode)
        # The kind is asked before the file is opened: a named pipe would block.
        if is_regular:
            path.open("rb").close()
    except FileNotFoundError:
        raise FileError(f"{label}: no such file") from None
    except OSError as error:
        raise _refusal(label, "cannot be read", error) from error

    if path.is_dir():
        kind = "a folder"
    elif not is_regular:
        kind = "no regular file"
    elif status.st_size == 0:
        kind = "empty"
    else:
        return path
    raise FileError(f"{label}: is {kind}; it must be a file with content")


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
        suffix = target.suffix.lower()
        with _temporary(_make_file, target.parent, target.stem, suffix) as temporary:
            yield temporary
            flush(temporary)
            if target.exists():
                shutil.copymode(target, temporary)
            os.replace(temporary, target)
            flush(target.parent)


@contextlib.contextmanager
def fill_folder(path: str | os.PathLike[str], *, replace: bool = False) -> Iterator[Path]:
    """Fill a temporary folder; put it at `path` only when the block ends well.

    Into an existing folder files are moved one by one, and its other files stay; with `replace` the
    new folder takes its place. Parents, links and errors are as in `replace_file`.
    """
    with _place_to_write(path) as target:
        if target.exists() and not target.is_dir():
            raise FileError(f"{path}: is a file; a folder cannot be written there")
        is_joining = target.exists() and not replace
        folder = target if is_joining else target.parent
        stem = "ltcl" if is_joining else target.name
        with _temporary(Path.mkdir, folder, stem) as temporary:
            yield temporary
            files = flush_tree(temporary)
            if is_joining:
                _move_into(target, temporary, files)
            else:
                _put_folder(temporary, target)
            flush(target.parent)
            if not is_joining:
                _discard(_earlier(target))


def _put_folder(temporary: Path, target: Path) -> None:
    """Put a folder in its place; the one that was there is called `temporary` then."""
    while True:
        try:
            if not target.exists():
                os.replace(temporary, target)
            elif not exchange(temporary, target):
                _put_folder_in_two_steps(temporary, target)
            return
        except OSError as error:
            if error.errno not in OVERTAKEN or not temporary.exists():
                raise


def exchange(first: Path, second: Path) -> bool:
    """Exchange the names of two folders at once; False where that cannot be done."""
    if IS_WINDOWS:
        return False
    system = ctypes.CDLL(None, use_errno=True)
    names = os.fsencode(first), os.fsencode(second)
    if hasattr(system, "renameat2"):
        from_name = (CURRENT_FOLDER, names[0])
        failed = system.renameat2(*from_name, CURRENT_FOLDER, names[1], RENAME_EXCHANGE)
    elif hasattr(system, "renamex_np"):
        failed = system.renamex_np(*names, RENAME_EXCHANGE)
    else:
        return False
    code = ctypes.get_errno()
    if failed and code not in CANNOT_EXCHANGE:
        raise OSError(code, os.strerror(code), str(second))
    return not failed


def _put_folder_in_two_steps(temporary: Path, target: Path) -> None:
    """Replace a folder where two cannot be exchanged; `restore` repairs what a kill leaves."""
    earlier = _earlier(target)
    _discard(earlier)
    os.replace(target, earlier)
    os.replace(temporary, target)


def restore(target: Path) -> None:
    """Bring the earlier folder back if its writer was killed before the new one had its place."""
    earlier = _earlier(target)
    if os.path.lexists(target) or not earlier.exists():
        return
    try:
        os.replace(earlier, target)
    except OSError as error:
        # Its writer has put the new one there by now, or another reader was first.
        if error.errno not in OVERTAKEN:
            raise


def _earlier(target: Path) -> Path:
    return target.with_name(f".{target.name[:80]}.ltcl-earlier")


def _discard(folder: Path) -> None:
    """Make a folder a temporary, which goes when its last reader has gone."""
    temporary = _temporary_path(folder.parent, folder.stem)
    # Another writer may have done so, or there is none.
    with contextlib.suppress(FileNotFoundError):
        os.replace(folder, temporary)
        _remove(temporary)


class PinnedFolder:
    """A folder that is read: it stays whole while this object lives, though others replace it.

    Attributes
    ----------
    root : Path
        Where its files are read, even if its name belongs to another folder by now.
    """

    def __init__(self, path: Path, file: str) -> None:
        """Pin the folder by a lock on one of its files."""
        self.root = path
        if IS_WINDOWS:
            return
        place = Path(os.path.realpath(path))
        folder, opened = _pin_what_is_there(place, file)
        weakref.finalize(self, _unpin, folder, opened, place)
        # Other systems than Linux read whatever has the name, and checksums tell.
        if Path(f"/proc/self/fd/{folder}").is_dir():
            self.root = Path(f"/proc/self/fd/{folder}")


def _pin_what_is_there(path: Path, file: str) -> tuple[int, contextlib.ExitStack]:
    """Open a folder and lock a file in it, again while other processes replace the folder."""
    missing = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    for _ in range(OPEN_ATTEMPTS):
        restore(path)
        try:
            locks = _pin(path, file)
        except FileNotFoundError as error:
            missing = error
        else:
            if locks is not None:
                return locks
    raise missing


def _pin(path: Path, file: str) -> tuple[int, contextlib.ExitStack] | None:
    """Open a folder and lock a file in it; None if another process removes the folder just now."""
    with contextlib.ExitStack() as opened:
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        opened.callback(os.close, folder)
        try:
            handle = os.open(file, os.O_RDONLY | os.O_NONBLOCK, dir_fd=folder)
        except FileNotFoundError:
            if _is_at(path, folder):
                raise
            return None
        opened.callback(os.close, handle)
        # In file systems without locks, a folder may be removed while it is read.
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_SH)
        is_removed = os.fstat(handle).st_nlink == 0
        return None if is_removed else (folder, opened.pop_all())


def _unpin(folder: int, opened: contextlib.ExitStack, path: Path) -> None:
    """Close a folder, and remove it if it was replaced and nobody else reads it."""
    with opened:
        is_replaced = not _is_at(path, folder)
    if is_replaced and path.parent.exists():
        sweep(path.parent)


def _is_at(path: Path, folder: int) -> bool:
    """True if an open folder is still the one at `path`."""
    with contextlib.suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(folder), path.stat())
    return False


@contextlib.contextmanager
def locked(folder: Path, *, wait: bool = True) -> Iterator[None]:
    """Allow one process at a time in a folder, which is made if need be.

    Without `wait` the second process is refused with a FileError.
    """
    created = _missing_folders(folder)
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
    """Remove the temporaries in a folder whose writers, and readers, no longer run."""
    if IS_WINDOWS or not os.access(folder, os.R_OK):
        return
    for name in os.listdir(folder):
        if TEMPORARY_NAME.fullmatch(name):
            _remove(folder / name, needs_lock=True)


def _remove(temporary: Path, *, needs_lock: bool = False) -> None:
    """Remove a temporary, unless somebody holds a lock on it or on a file in it.

    With `needs_lock` it stays, too, if the file system has no locks.
    """
    with contextlib.ExitStack() as locks:
        try:
            if not IS_WINDOWS:
                locks.enter_context(_exclusive(temporary))
                # Only now: until its writer has ended, the name may pass to the folder that it
                # replaces, in which there are other files, and readers.
                for place in _files_in(temporary):
                    locks.enter_context(_exclusive(place))
        except OSError as error:
            if needs_lock or isinstance(error, (BlockingIOError, FileNotFoundError)):
                return
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            with contextlib.suppress(PermissionError):
                temporary.unlink(missing_ok=True)


def _files_in(path: Path) -> list[Path]:
    """The files directly in a folder; none if `path` is a file."""
    if not path.is_dir():
        return []
    return [place for place in path.iterdir() if place.is_file()]


@contextlib.contextmanager
def _exclusive(path: Path) -> Iterator[None]:
    """Lock a file or folder; BlockingIOError if somebody else has, OSError if it cannot be."""
    # A named pipe would wait for its other end.
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW
    handle = os.open(path, flags)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def _temporary(
    make: Callable[[Path], object], folder: Path, stem: str, suffix: str = ""
) -> Iterator[Path]:
    """Make a temporary, locked during the block; what has its name at the end is removed."""
    sweep(folder)
    lock = contextlib.ExitStack()
    path = _temporary_path(folder, stem, suffix)
    try:
        make(path)
        # Another writer may take it for one of a killed process until it is locked.
        while not _has_locked(path, lock):
            path = _temporary_path(folder, stem, suffix)
            make(path)
        yield path
    finally:
        lock.close()
        _remove(path)


def _has_locked(path: Path, lock: contextlib.ExitStack) -> bool:
    """Lock a new temporary; False if another writer has removed it, or is about to."""
    if IS_WINDOWS:
        return True
    try:
        lock.enter_context(_exclusive(path))
    except (BlockingIOError, FileNotFoundError):
        return False
    except OSError as error:
        # File systems without locks, where nobody sweeps.
        if error.errno not in NO_LOCKS:
            raise
    return path.exists()


def _temporary_path(folder: Path, stem: str, suffix: str = "") -> Path:
    return folder / f".{stem[:40]}-{HOST}-{secrets.token_hex(8)}{suffix}"


def _make_file(path: Path) -> None:
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))


def _move_into(target: Path, temporary: Path, files: list[Path]) -> None:
    """Move files from a temporary folder to the same places in `target`."""
    destinations = [target / file.relative_to(temporary) for file in files]
    # Every clash is refused before the first file moves.
    for destination in destinations:
        is_used = destination.is_dir() or any(map(_is_no_folder, destination.parents))
        if is_used:
            name = destination.relative_to(target)
            raise FileError(f"{target}: {name} cannot be placed there, a name in its path is used")
    folders = set()
    for file, destination in zip(files, destinations, strict=True):
        make_folders(destination.parent)
        os.replace(file, destination)
        folders.add(destination.parent)
    for folder in folders:
        flush(folder)


def _is_no_folder(path: Path) -> bool:
    return path.exists() and not path.is_dir()


@contextlib.contextmanager
def _place_to_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Resolve `path` and make its parents; an OSError of the block becomes one line about it."""
    target = Path(os.path.realpath(as_path(path)))
    created = _missing_folders(target.parent)
    try:
        make_folders(target.parent)
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


def _missing_folders(folder: Path) -> list[Path]:
    """Return `folder` and its parents as far as they do not exist, the innermost first."""
    return [place for place in (folder, *folder.parents) if not os.path.exists(place)]


def make_folders(folder: Path) -> None:
    """Make a folder and its missing parents, each flushed into the one that holds it."""
    missing = _missing_folders(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for place in missing:
        flush(place.parent)


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
        flush(place)
    return [place for place in places if place.is_file()]


def flush(path: Path) -> None:
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
