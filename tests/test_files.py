# SPDX-License-Identifier: BSD-3-Clause
"""Output is there whole or not at all."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ltcl import files
from ltcl.errors import FileError, InputTypeError
from ltcl.files import PinnedFolder, fill_folder, input_file, replace_file, sweep

MANAGERS = [replace_file, fill_folder]
FULL = OSError(errno.ENOSPC, "No space left on device")
ELSEWHERE = FileNotFoundError(errno.ENOENT, "No such file", "/elsewhere.txt")
ENDINGS = [ValueError(), KeyboardInterrupt(), SystemExit(), FULL, ELSEWHERE]


def everything(folder: Path) -> dict[str, bytes | None]:
    """Names below `folder`, hidden ones too, with the content of files."""
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None
        for p in sorted(folder.rglob("*"))
    }


def refused(path: Path, block: Callable[[], object], *says: str) -> None:
    """Refused in one line that begins with the path."""
    with pytest.raises(FileError) as error:
        block()
    text = str(error.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    assert all(word in text for word in says)


def write(
    manager: Any, path: Path, files: dict[str, str], ending: BaseException | None = None
) -> None:
    """Write the one file, or `files` into the folder, and then raise `ending`."""
    with manager(path) as temporary:
        for name, text in files.items():
            place = temporary if manager is replace_file else temporary / name
            place.parent.mkdir(exist_ok=True)
            place.write_text(text)
        if ending is not None:
            raise ending


def test_a_new_file_has_the_usual_permissions_and_an_old_one_keeps_its_own(tmp_path):
    path = tmp_path / "a" / "b" / "out.npz"
    usual = tmp_path / "usual"
    link = tmp_path / "link"
    usual.touch()
    with replace_file(path) as temporary:
        assert (temporary.parent, temporary.suffix) == (path.parent, ".npz")
        temporary.write_bytes(b"new")
    assert everything(tmp_path) == {"usual": b"", "a": None, "a/b": None, "a/b/out.npz": b"new"}
    assert path.stat().st_mode == usual.stat().st_mode
    path.chmod(0o640)
    link.symlink_to(path)
    write(replace_file, link, {"": "newer"})
    assert link.is_symlink()
    assert path.read_text() == "newer"
    assert path.stat().st_mode & 0o777 == 0o640


def test_a_new_folder_appears_whole_and_joins_an_earlier_one(tmp_path):
    path = tmp_path / "a" / "report"
    with fill_folder(path) as temporary:
        (temporary / "one.txt").write_text("old")
        (temporary / "mine.txt").write_text("stays")
        assert not path.exists()
    assert everything(tmp_path).keys() == {"a", "a/report", "a/report/one.txt", "a/report/mine.txt"}
    write(fill_folder, path, {"one.txt": "new", "sub/two.txt": "2"})
    assert everything(path) == {
        "mine.txt": b"stays",
        "one.txt": b"new",
        "sub": None,
        "sub/two.txt": b"2",
    }


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("manager", MANAGERS)
def test_nothing_changes_when_the_block_fails(tmp_path, manager, ending, existing):
    path = tmp_path / "deep" / "er" / "out"
    if existing:
        write(manager, path, {"one.txt": "old"})
    before = everything(tmp_path)
    if ending is FULL:
        refused(
            path,
            lambda: write(manager, path, {"one.txt": "half"}, ending),
            "No space left on device",
        )
    else:
        with pytest.raises(type(ending)):
            write(manager, path, {"one.txt": "half"}, ending)
    assert everything(tmp_path) == before


@pytest.mark.parametrize(
    ("manager", "name"),
    [
        (replace_file, name)
        for name in ("folder", "file/below.png", "file/a/b.png", "x" * 300 + ".png", "\0")
    ]
    + [(fill_folder, name) for name in ("file", "file/below", "x" * 300, "\0")],
)
def test_places_that_cannot_hold_it_are_refused(tmp_path, manager, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"old")
    before = everything(tmp_path)
    refused(tmp_path / name, lambda: write(manager, tmp_path / name, {"a": "new"}))
    assert everything(tmp_path) == before


@pytest.mark.parametrize("name", ["file/below.txt", "folder"])
def test_nothing_moves_when_a_name_is_taken(tmp_path, name):
    path = tmp_path / "report"
    write(fill_folder, path, {"folder/b": "old", "a.txt": "old", "file": "old"})
    before = everything(tmp_path)
    refused(path, lambda: write(fill_folder, path, {"a.txt": "new", name: "new"}))
    assert everything(tmp_path) == before


def test_what_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "empty").touch()
    (tmp_path / "full").write_bytes(b"x")
    assert input_file(str(tmp_path / "full")) == tmp_path / "full"
    for name in ("empty", "none", "", "full/x", "\0"):
        refused(tmp_path / name, lambda name=name: input_file(tmp_path / name))
    with pytest.raises(InputTypeError, match=r"path .*3"):
        input_file(3)


def in_child(work: Callable[[], object]) -> None:
    """Do `work` in another process."""
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        return
    work()
    os._exit(0)


@pytest.mark.parametrize("manager", MANAGERS)
def test_the_temporary_of_a_writer_stays_while_it_lives(tmp_path, manager):
    def write_and_die() -> None:
        with manager(tmp_path / "b"):
            os.kill(os.getpid(), signal.SIGKILL)

    with manager(tmp_path / "a") as temporary:
        place = temporary if manager is replace_file else temporary / "one.txt"
        place.write_text("an hour of work")
        # Another writer sweeps, whatever it thinks of the number of this process.
        in_child(lambda: write(manager, tmp_path / "b", {"one.txt": "1"}))
        sweep(tmp_path)
        in_child(write_and_die)
        assert len(list(tmp_path.rglob(".*"))) == 2
    # The next writers in these places remove what the killed one has left.
    write(manager, tmp_path / "b", {"one.txt": "2"})
    assert not list(tmp_path.rglob(".*"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
    assert "an hour of work" in {path.read_text() for path in tmp_path.rglob("*") if path.is_file()}


@pytest.mark.parametrize("can_exchange", [True, False])
def test_a_folder_that_is_read_stays_until_its_last_reader_has_gone(
    tmp_path, monkeypatch, can_exchange
):
    if not can_exchange:
        monkeypatch.setattr("ltcl.files.exchange", lambda one, two: False)
    path = tmp_path / "folder"
    with fill_folder(path, replace=True) as temporary:
        (temporary / "file").write_text("old")
    readers = [PinnedFolder(path, "file"), PinnedFolder(path, "file")]
    for text in ("new", "newer"):
        with fill_folder(path, replace=True) as temporary:
            (temporary / "file").write_text(text)
    readers.append(PinnedFolder(path, "file"))
    sweep(tmp_path)
    assert [(reader.root / "file").read_text() for reader in readers] == ["old", "old", "newer"]
    del readers[0]
    sweep(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    readers.clear()
    assert everything(tmp_path) == {"folder": None, "folder/file": b"newer"}


def test_a_name_that_passes_to_a_folder_in_use_is_not_removed(tmp_path, monkeypatch):
    """A sweep looks at a new folder; its writer exchanges it with one that somebody reads."""
    path = tmp_path / "folder"
    with fill_folder(path) as folder:
        (folder / "file").write_text("read")
    reader = PinnedFolder(path, "file")
    locking = files._exclusive
    with fill_folder(tmp_path / "other") as folder:
        temporary = folder
    temporary.mkdir()

    def lock_late(place: Path) -> Any:
        if place == temporary and not (place / "file").exists():
            files.exchange(temporary, path)
        return locking(place)

    monkeypatch.setattr(files, "_exclusive", lock_late)
    sweep(tmp_path)
    assert (reader.root / "file").read_text() == "read"


def test_a_folder_that_is_replaced_in_two_steps_is_opened(tmp_path, monkeypatch):
    path = tmp_path / "folder"
    path.mkdir()
    (path / "file").write_text("read")
    path.rename(files._earlier(path))
    restoring = files.restore

    def put_back(place: Path) -> None:
        # Another writer takes it away once more before it is opened.
        restoring(place)
        monkeypatch.setattr(files, "restore", restoring)
        path.rename(files._earlier(path))

    monkeypatch.setattr(files, "restore", put_back)
    assert (PinnedFolder(path, "file").root / "file").read_text() == "read"
