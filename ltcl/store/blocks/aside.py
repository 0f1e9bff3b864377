# SPDX-License-Identifier: BSD-3-Clause
"""Folders that appear whole or not at all: written aside, flushed, renamed into place.

A folder `name` lies at `name.0`; its next version is placed at `name.1` before the earlier one goes, and of
several the last one counts. So nothing committed is ever absent, whenever the process ends. What a killed
process leaves lies in `.aside` only, and `tidy` removes it; locks tell it from what a living one writes.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from ltcl.errors import FileError, LtclError
from ltcl.store.blocks import nodes

try:
    import fcntl
except ImportError:  # Windows: nothing is locked, so nothing is tidied either
    fcntl = None

FOLDER = ".aside"
_NAME = re.compile(r"(?P<name>[A-Za-z][A-Za-z0-9_.-]{0,120})\.(?P<version>\d{1,9})")


@contextlib.contextmanager
def placed(root: Path, parent: str, name: str) -> Iterator[Path]:
    """An empty folder that becomes the newest version of root / parent / name when the block ends well.

    Raises
    ------
    FileError
        The disk is full, or may not be written, or another process placed the same at this moment.
    """
    with refusing(root, f"{parent}/{name}"), _aside(root) as folder:
        yield folder
        earlier = versions(root, parent).get(name, [])
        place = root / parent / f"{name}.{earlier[-1] + 1 if earlier else 0}"
        for inner in [path for path in folder.rglob("*") if path.is_dir()]:
            flush_folder(inner)
        flush_folder(folder)
        if place.exists():
            raise FileError(f"{root}: {parent}/{name} was written by another process just now")
        folder.rename(place)  # onto a folder with something in it this fails, so one of two processes wins
        flush_folder(place.parent)
        for version in earlier:
            _remove(root, place.with_name(f"{name}.{version}"))


def versions(root: Path, parent: str) -> dict[str, list[int]]:
    """Names in root / parent and their versions, ascending."""
    found: dict[str, list[int]] = {}
    try:
        names = os.listdir(root / parent)
    except OSError as error:
        raise FileError(f"{root}: {parent} cannot be read: {error.strerror}") from error
    for entry in names:
        parts = _NAME.fullmatch(entry)
        if parts and str(int(parts["version"])) == parts["version"]:
            found.setdefault(parts["name"], []).append(int(parts["version"]))
    return {name: sorted(numbers) for name, numbers in found.items()}


def replace_document(root: Path, name: str, content: bytes) -> None:
    """Replace the file root / name whole or not at all."""
    with refusing(root, name), _aside(root) as folder:
        nodes.write_file(folder / "document", content)
        os.replace(folder / "document", root / name)
        flush_folder((root / name).parent)


def remove(root: Path, name: str) -> None:
    """Remove the folder root / name; it is gone at once, its files a little later."""
    with refusing(root, name):
        _remove(root, root / name)


def tidy(root: Path) -> int:
    """Remove what processes that are no more have left; the number of folders removed."""
    removed = 0
    with _locked(root / FOLDER):
        for folder in (root / FOLDER).iterdir():
            if fcntl is None or folder.is_symlink() or not folder.is_dir():
                continue
            handle = try_lock(folder)
            if handle is None:  # somebody is at work there
                continue
            shutil.rmtree(folder, ignore_errors=True)
            os.close(handle)
            removed += 1
    return removed


@contextlib.contextmanager
def locked(root: Path) -> Iterator[None]:
    """One process at a time, for what is read, changed and written again."""
    with refusing(root, "zarr.json"), _locked(root / FOLDER / "zarr.json"):
        yield


@contextlib.contextmanager
def refusing(root: Path, name: str) -> Iterator[None]:
    """Turn an OSError of the block into one line about `name`."""
    try:
        yield
    except LtclError:
        raise
    except OSError as error:
        raise FileError(f"{root}: {name} cannot be written: {error.strerror or error}") from error


@contextlib.contextmanager
def _aside(root: Path) -> Iterator[Path]:
    folder = root / FOLDER / secrets.token_hex(8)
    handle = -1
    try:
        with _locked(root / FOLDER):
            folder.mkdir()
            handle = _lock(folder)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if handle >= 0:
            os.close(handle)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    handle = _lock(path)
    try:
        yield
    finally:
        if handle >= 0:
            os.close(handle)


def _lock(path: Path) -> int:
    if fcntl is None:
        return -1
    handle = os.open(path, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    return handle


def try_lock(path: Path) -> int | None:
    """A handle that locks a folder until it is closed; None where another process has it."""
    if fcntl is None:
        return -1
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        return None
    return handle


def _remove(root: Path, place: Path) -> None:
    with _aside(root) as folder, contextlib.suppress(FileNotFoundError):
        place.rename(folder / "old")


def flush_folder(path: Path) -> None:
    """Make the names in a folder survive a power cut; Windows cannot, and need not, open a folder."""
    if os.name == "nt":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
