# SPDX-License-Identifier: BSD-3-Clause
"""Output that is there whole or not at all, and input files that are files.

New content goes into a temporary on the same disk, is flushed and renamed into place, which is atomic:
whatever ends a run early leaves the earlier file as it was. A killed process leaves a hidden temporary.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ltcl.errors import FileError, InputTypeError, LtclError


def input_file(path: Any) -> Path:
    """Return `path` as a Path if it is a regular file with something in it, else raise FileError."""
    path = as_path(path)
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):  # asked before opening: a named pipe would block
            kind = "a folder" if stat.S_ISDIR(mode) else "no regular file"
            raise FileError(f"{path}: is {kind}; it must be a file")
        path.open("rb").close()
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise error if isinstance(error, FileError) else _refusal(path, "cannot be read", error) from error
    if not path.stat().st_size:
        raise FileError(f"{path}: the file is empty")
    return path


def as_path(path: Any, name: str = "path") -> Path:
    """Return `path` (str or os.PathLike) as a Path; refuse everything else."""
    try:
        return Path(path)
    except TypeError:
        raise InputTypeError(f"{name} is {path!r}; it must be a str or a path") from None


def refuse_appended(path: Path, comment: bytes) -> None:
    """Refuse a zip archive with bytes, which readers skip, behind its end record and its `comment`."""
    size = 22 + len(comment)
    with path.open("rb") as file:
        file.seek(-size, os.SEEK_END)
        record = file.read(size)
    if not record.startswith(b"PK\x05\x06") or int.from_bytes(record[20:22], "little") != len(comment):
        raise FileError("the archive does not end where it says: bytes were appended, or it is damaged")


def unknown_extension(path: Path) -> str:
    """What is wrong with the extension of `path`, for a refusal."""
    return f"extension {path.suffix} is unknown" if path.suffix else "has no extension"


@contextlib.contextmanager
def replace_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file under a temporary name; put it at `path` only when the block ends well.

    The temporary lies beside `path` and has its extension. Missing parents are made, and removed on failure.
    Links are followed; an earlier file's permissions stay. FileError where `path` is no file, or an OSError
    comes up in the block.
    """
    with _written(path) as target:
        if target.exists() and not target.is_file():
            kind = "a folder" if target.is_dir() else "no regular file"
            raise FileError(f"{path}: is {kind}; a file cannot be written there")
        temporary = target.parent / f".{target.stem[:40]}-{secrets.token_hex(6)}{target.suffix}"
        try:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            yield temporary
            _flush(temporary)
            if target.exists():
                shutil.copymode(target, temporary)
            os.replace(temporary, target)
            _flush_folder(target.parent)
        finally:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def fill_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Fill a temporary folder; put it at `path` only when the block ends well.

    Renamed into place in one step; into an existing folder, which may be a disk of its own, files are moved
    one by one, each replacing its namesake; others stay. Parents, links, errors: see `replace_file`.
    """
    with _written(path) as target:
        if target.exists() and not target.is_dir():
            raise FileError(f"{path}: is a file; a folder cannot be written there")
        temporary = (target if target.exists() else target.parent) / f".ltcl-{secrets.token_hex(6)}"
        try:
            temporary.mkdir()
            yield temporary
            files = [file for file in sorted(temporary.rglob("*")) if file.is_file()]
            for file in files:
                _flush(file)
            if target.exists():
                _move_into(target, temporary, files)
            else:
                os.replace(temporary, target)
            _flush_folder(target.parent)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _move_into(target: Path, temporary: Path, files: list[Path]) -> None:
    moves = [(file, target / file.relative_to(temporary)) for file in files]
    for _, final in moves:  # refuse every clash before the first file moves
        inner = [p for p in final.parents if target in p.parents]
        if final.is_dir() or any(p.exists() and not p.is_dir() for p in inner):
            name = final.relative_to(target)
            raise FileError(f"{target}: {name} cannot be placed there, a name on its way is taken")
    for file, final in moves:
        final.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, final)
    for folder in {final.parent for _, final in moves}:
        _flush_folder(folder)


@contextlib.contextmanager
def _written(path: str | os.PathLike[str]) -> Iterator[Path]:
    """The place that `path` means, its parents made; an OSError of the block becomes one line about it."""
    shown, made = as_path(path), []
    try:
        target = Path(os.path.realpath(shown))
    except (OSError, ValueError) as error:  # a NUL byte, a loop of links
        raise _refusal(shown, "cannot be written", error) from error
    try:
        for folder in reversed([p for p in target.parents if not os.path.exists(p)]):
            folder.mkdir(exist_ok=True)
            made.append(folder)
        yield target
    except BaseException as error:
        for folder in reversed(made):
            with contextlib.suppress(OSError):  # no longer empty: somebody else's by now
                folder.rmdir()
        if not isinstance(error, OSError) or isinstance(error, LtclError):
            raise
        place = Path(error.filename) if isinstance(error.filename, (str, Path)) else target
        if not (place.is_relative_to(target.parent) or target.is_relative_to(place)):
            raise  # about another file, which the block read
        raise _refusal(shown, "cannot be written", error) from error


def _refusal(path: Path, what: str, error: Exception) -> FileError:
    reason = " ".join(str(getattr(error, "strerror", None) or error).split())
    return FileError(f"{path}: {what}: {reason}")


def _flush(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _flush_folder(path: Path) -> None:
    """Makes the rename itself survive a power cut; Windows cannot open a folder, and need not."""
    with contextlib.suppress(OSError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
