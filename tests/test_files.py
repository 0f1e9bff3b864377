# SPDX-License-Identifier: BSD-3-Clause
"""Output is there whole or not at all."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

import ltcl
from ltcl.errors import FileError, InputTypeError
from ltcl.files import fill_folder, input_file, replace_file

ENDINGS = [ValueError, KeyboardInterrupt, SystemExit]


def everything(folder: Path) -> dict[str, bytes | None]:
    """Names below `folder`, hidden ones too, with the content of files."""
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))
    }


def fill(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)


def fail_halfway(path: Path, ending: type[BaseException]) -> None:
    path.write_bytes(b"half")
    raise ending


def one_line(error: pytest.ExceptionInfo[BaseException], path: Path) -> str:
    text = str(error.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    return text


def test_replace_file_writes_a_new_file_with_the_usual_permissions(tmp_path):
    (tmp_path / "usual").touch()
    with replace_file(tmp_path / "a" / "b" / "out.npz") as temporary:
        assert temporary.parent == tmp_path / "a" / "b"
        assert temporary.suffix == ".npz"
        temporary.write_bytes(b"new")
    assert everything(tmp_path) == {"usual": b"", "a": None, "a/b": None, "a/b/out.npz": b"new"}
    assert (tmp_path / "a/b/out.npz").stat().st_mode == (tmp_path / "usual").stat().st_mode


@pytest.mark.parametrize("ending", ENDINGS)
def test_replace_file_leaves_the_earlier_file_when_the_block_fails(tmp_path, ending):
    path = tmp_path / "out.png"
    path.write_bytes(b"old")
    with pytest.raises(ending), replace_file(path) as temporary:
        fail_halfway(temporary, ending)
    assert everything(tmp_path) == {"out.png": b"old"}


def test_replace_file_removes_the_folders_it_made_when_the_block_fails(tmp_path):
    with pytest.raises(ValueError, match="stop"), replace_file(tmp_path / "a" / "b" / "out.png"):
        raise ValueError("stop")
    assert everything(tmp_path) == {}


def test_replace_file_keeps_permissions_and_links(tmp_path):
    real, link = tmp_path / "real.txt", tmp_path / "link.txt"
    real.write_text("old")
    real.chmod(0o640)
    link.symlink_to(real)
    with replace_file(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink()
    assert real.read_text() == "new"
    assert real.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("name", ["folder", "file/below.png", "file/deeper/below.png", "x" * 300 + ".png"])
def test_replace_file_refuses_places_that_cannot_hold_a_file(tmp_path, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"old")
    before = everything(tmp_path)
    with pytest.raises(FileError) as error, replace_file(tmp_path / name) as temporary:
        temporary.write_bytes(b"new")
    one_line(error, tmp_path / name)
    assert everything(tmp_path) == before


@pytest.mark.skipif(not os.path.exists("/dev/null"), reason="no device files")
def test_replace_file_never_replaces_a_device():
    with pytest.raises(FileError, match="no regular file"), replace_file("/dev/null"):
        pass


def test_replace_file_turns_a_full_disk_into_one_line(tmp_path):
    path = tmp_path / "out.png"
    with pytest.raises(FileError) as error, replace_file(path):
        raise OSError(28, "No space left on device")
    assert "No space left on device" in one_line(error, path)


def test_replace_file_passes_on_errors_about_other_files(tmp_path):
    with pytest.raises(FileNotFoundError), replace_file(tmp_path / "out" / "a.png"):
        (tmp_path / "elsewhere.txt").read_text()


@pytest.mark.parametrize("manager", [replace_file, fill_folder])
def test_a_read_only_folder_is_one_line(tmp_path, manager, monkeypatch):
    def refuse(folder, *_, **__):  # root may write anywhere, so the refusal is played
        raise PermissionError(errno.EACCES, "Permission denied", str(folder))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(FileError, match="Permission denied"), manager(tmp_path / "deep" / "out"):
        pass


def test_fill_folder_appears_whole(tmp_path):
    path = tmp_path / "a" / "report"
    with fill_folder(path) as temporary:
        (temporary / "one.txt").write_text("1")
        (temporary / "sub").mkdir()
        (temporary / "sub" / "two.txt").write_text("2")
        assert not path.exists()
    assert everything(path) == {"one.txt": b"1", "sub": None, "sub/two.txt": b"2"}
    assert everything(tmp_path).keys() == {"a", "a/report"} | {f"a/report/{k}" for k in everything(path)}


def test_fill_folder_joins_an_existing_folder(tmp_path):
    path = tmp_path / "report"
    (path / "sub").mkdir(parents=True)
    (path / "mine.txt").write_text("stays")
    (path / "one.txt").write_text("old")
    with fill_folder(path) as temporary:
        assert list(temporary.iterdir()) == []
        (temporary / "one.txt").write_text("new")
        (temporary / "sub").mkdir()
        (temporary / "sub" / "two.txt").write_text("2")
    assert everything(path) == {"mine.txt": b"stays", "one.txt": b"new", "sub": None, "sub/two.txt": b"2"}


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("ending", ENDINGS)
def test_fill_folder_changes_nothing_when_the_block_fails(tmp_path, ending, existing):
    path = tmp_path / "deep" / "report"
    if existing:
        path.mkdir(parents=True)
        (path / "one.txt").write_text("old")
    before = everything(tmp_path)
    with pytest.raises(ending), fill_folder(path) as temporary:
        fail_halfway(temporary / "one.txt", ending)
    assert everything(tmp_path) == before


@pytest.mark.parametrize("name", ["file/below.txt", "folder"])
def test_fill_folder_moves_nothing_when_a_name_is_taken(tmp_path, name):
    path = tmp_path / "report"
    (path / "folder").mkdir(parents=True)
    (path / "a.txt").write_text("old")
    (path / "file").write_text("old")
    before = everything(tmp_path)
    with pytest.raises(FileError) as error, fill_folder(path) as temporary:
        fill(temporary, {"a.txt": "new", name: "new"})
    one_line(error, path)
    assert everything(tmp_path) == before


def test_fill_folder_refuses_a_file(tmp_path):
    path = tmp_path / "report"
    path.write_text("old")
    with pytest.raises(FileError, match="is a file"), fill_folder(path):
        pass
    assert path.read_text() == "old"


def test_input_file_refuses_what_cannot_be_read(tmp_path):
    (tmp_path / "empty").touch()
    (tmp_path / "full").write_bytes(b"x")
    assert input_file(str(tmp_path / "full")) == tmp_path / "full"
    wanted = {"empty": "empty", "none": "no such file", "": "folder", "full/x": "cannot", "\0": "cannot"}
    for name, text in wanted.items():
        with pytest.raises(FileError, match=text) as error:
            input_file(tmp_path / name)
        one_line(error, tmp_path / name)
    with pytest.raises(InputTypeError, match="path"):
        input_file(3)


@pytest.mark.parametrize("name", ["T.npz", "T.npy"])
@pytest.mark.parametrize("appended", [b"\0", b"half of another file"])
def test_bytes_behind_an_array_file_are_refused(tmp_path, name, appended):
    path = tmp_path / name
    ltcl.save(path, ltcl.Transport(np.eye(4), (2, 2)))
    assert ltcl.load(path, grid=(2, 2)).shape == (4, 4)
    with path.open("ab") as file:
        file.write(appended)
    with pytest.raises(FileError, match=name):
        ltcl.load(path, grid=(2, 2))
