# SPDX-License-Identifier: BSD-3-Clause
"""Output that is there whole or not at all, and input files that are files.

New content goes into a temporary file or folder on the same disk, is flushed and renamed into place. A rename
is atomic, so whatever ends a run early (an error, Ctrl-C, a power cut) leaves the earlier file as it was.
Known limit: a killed process leaves its temporary behind, under a hidden name with a random part.
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
    """Return `path` as a Path if it is a regular file with something in it.

    Raises
    ------
    FileError
        It is missing, a folder, a device, unreadable or empty.
    InputTypeError
        `path` is not a path.

    Examples
    --------
    >>> input_file("nowhere.npz")
    Traceback (most recent call last):
    ltcl.errors.FileError: nowhere.npz: no such file
    """
    path = as_path(path)
    empty = False
    try:
        mode = path.stat().st_mode
        if stat.S_ISREG(mode):  # asked before opening: a named pipe would block
            with path.open("rb") as file:
                empty = not file.read(1)
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise _refusal(path, "cannot be read", error) from error
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "no regular file"
        raise FileError(f"{path}: is {kind}; it must be a file")
    if empty:
        raise FileError(f"{path}: the file is empty")
    return path


def as_path(path: Any, name: str = "path") -> Path:
    """Return `path` (str or os.PathLike) as a Path; refuse everything else."""
    try:
        return Path(path)
    except TypeError:
        raise InputTypeError(
            f"{name} is {path!r}; it must be a str or a path, not {type(path).__name__}"
        ) from None


def refuse_appended(path: Path, comment: bytes) -> None:
    """Refuse a zip archive with bytes behind its end record, whose last field is the `comment`.

    Readers find that record from behind and skip what follows, such as another file or half of one.
    """
    size = 22 + len(comment)
    with path.open("rb") as file:
        file.seek(-size, os.SEEK_END)
        record = file.read(size)
    if not record.startswith(b"PK\x05\x06") or int.from_bytes(record[20:22], "little") != len(comment):
        raise FileError("the archive does not end where it says: bytes were appended, or it is damaged")


def unknown_extension(path: Path) -> str:
    """What is wrong with the extension of `path`, for a refusal.

    >>> unknown_extension(Path("T.xyz")), unknown_extension(Path("T"))
    ('extension .xyz is unknown', 'has no extension')
    """
    return f"extension {path.suffix} is unknown" if path.suffix else "has no extension"


@contextlib.contextmanager
def replace_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file under a temporary name; put it at `path` only when the block ends well.

    Missing parent folders are made up front (the temporary must lie beside its target) and removed again on
    failure. A symbolic link is followed: what it points at is replaced. An earlier file's permissions stay.

    Yields
    ------
    Path
        An empty temporary file in the folder of `path`, with the same extension.

    Raises
    ------
    FileError
        `path` is a folder or a device, cannot be created, or an OSError came up while it was written.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "notes.txt"
    >>> with replace_file(path) as temporary:
    ...     _ = temporary.write_text("whole or not at all")
    >>> path.read_text()
    'whole or not at all'
    """
    shown, target = as_path(path), _real(path)
    if os.path.exists(target) and not os.path.isfile(target):
        kind = "a folder" if os.path.isdir(target) else "no regular file"
        raise FileError(f"{shown}: is {kind}; a file cannot be written there")
    with _making_parents(shown, target), _refusing(shown, target.parent):
        temporary = target.parent / f".{target.stem[:40]}-{secrets.token_hex(6)}{target.suffix}"
        try:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            yield temporary
            _flush(temporary)
            if target.exists():
                shutil.copymode(target, temporary)
            os.replace(temporary, target)
            _flush_folder(target.parent)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def fill_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Fill a temporary folder; put it at `path` only when the block ends well.

    If nothing is at `path` the folder is renamed into place in one step. Into an existing folder the finished
    files are moved one by one, each replacing its namesake whole; other files there stay. Parents and links
    are treated as in `replace_file`.

    Yields
    ------
    Path
        An empty temporary folder: beside `path`, or inside it where it exists (it may be a disk of its own,
        and its parent read-only).

    Raises
    ------
    FileError
        `path` is a file, cannot be created, holds a folder where a file must go (or the reverse), or an
        OSError came up while it was filled.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "report"
    >>> with fill_folder(path) as temporary:
    ...     _ = (temporary / "summary.txt").write_text("done")
    >>> [file.name for file in path.iterdir()]
    ['summary.txt']
    """
    shown, target = as_path(path), _real(path)
    if os.path.exists(target) and not os.path.isdir(target):
        raise FileError(f"{shown}: is a file; a folder cannot be written there")
    with _making_parents(shown, target), _refusing(shown, target.parent):
        temporary = (target if target.exists() else target.parent) / f".ltcl-{secrets.token_hex(6)}"
        try:
            temporary.mkdir()
            yield temporary
            files = [file for file in sorted(temporary.rglob("*")) if file.is_file()]
            for file in files:
                _flush(file)
            if target.exists():
                _move_into(shown, target, temporary, files)
            else:
                os.replace(temporary, target)
            _flush_folder(target.parent)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _move_into(shown: Path, target: Path, temporary: Path, files: list[Path]) -> None:
    moves = [(file, target / file.relative_to(temporary)) for file in files]
    for _, final in moves:  # refuse every clash before the first file moves
        inner = [p for p in final.parents if target in p.parents]
        if final.is_dir() or any(p.exists() and not p.is_dir() for p in inner):
            name = final.relative_to(target)
            raise FileError(f"{shown}: {name} cannot be placed there, a name on its way is taken")
    for file, final in moves:
        final.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, final)
    for folder in {final.parent for _, final in moves}:
        _flush_folder(folder)


def _real(path: str | os.PathLike[str]) -> Path:
    try:
        return Path(os.path.realpath(path))
    except (OSError, ValueError) as error:  # a NUL byte, a loop of links
        raise _refusal(Path(path), "cannot be written", error) from error


@contextlib.contextmanager
def _making_parents(shown: Path, target: Path) -> Iterator[None]:
    made = []
    try:
        with _refusing(shown, Path(target.anchor)):
            for folder in reversed([p for p in target.parents if not os.path.exists(p)]):
                folder.mkdir(exist_ok=True)
                made.append(folder)
        yield
    except BaseException:
        for folder in reversed(made):
            with contextlib.suppress(OSError):  # no longer empty: somebody else's by now
                folder.rmdir()
        raise


@contextlib.contextmanager
def _refusing(shown: Path, folder: Path) -> Iterator[None]:
    """Turn an OSError of the block (full disk, no permission) into one line about `shown`."""
    try:
        yield
    except LtclError:
        raise
    except OSError as error:
        # An error about a file elsewhere (the block also read something) is not ours to rename.
        if isinstance(error.filename, (str, Path)) and not Path(error.filename).is_relative_to(folder):
            raise
        raise _refusal(shown, "cannot be written", error) from error


def _refusal(path: Path, what: str, error: Exception) -> FileError:
    reason = " ".join(str(getattr(error, "strerror", None) or error).split())
    return FileError(f"{path}: {what}: {reason}")


def _flush(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _flush_folder(path: Path) -> None:
    # Makes the rename itself survive a power cut. Windows cannot open a folder; there it is not needed.
    with contextlib.suppress(OSError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
