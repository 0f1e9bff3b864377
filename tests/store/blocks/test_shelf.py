# SPDX-License-Identifier: BSD-3-Clause
"""Shelves: what is put there is whole, of one process at a time, and what is damaged is not there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ltcl.errors import FileError
from ltcl.store.blocks import shelf
from ltcl.store.blocks.shelf import Shelf

ARRAYS = {
    "grey": np.arange(12, dtype=np.uint8).reshape(3, 4),
    "deep": np.arange(24, dtype=np.uint16).reshape(2, 4, 3),
    "float": np.linspace(0, 1, 5),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a shelf"


def test_arrays_come_back_as_they_were(path: Path) -> None:
    with Shelf(path, {"made": "here"}) as made:
        for name, array in ARRAYS.items():
            made.put(name, array)
    with Shelf(path, {"made": "elsewhere"}) as again:
        assert again.about == {"made": "here"}
        assert again.names == sorted(ARRAYS)
        for name, array in ARRAYS.items():
            found = again.get(name)
            assert found is not None
            assert (found.dtype, found.flags.writeable) == (array.dtype, True)
            np.testing.assert_array_equal(found, array)
        assert again.get("none") is None


def test_another_process_waits_its_turn(path: Path) -> None:
    code = (
        "import sys\nfrom pathlib import Path\nfrom ltcl.store.blocks.shelf import Shelf\n"
        "try:\n    Shelf(Path(sys.argv[1]), {})\nexcept Exception as error:\n    print(error)\n"
    )
    command = [sys.executable, "-c", code, str(path)]
    with Shelf(path, {}):
        told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert told == f"{path}: another process is at work there; one must end first\n"
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == ""


@pytest.mark.parametrize("name", ["zarr.json", "array/zarr.json", "array/c/0/0"])
@pytest.mark.parametrize("harm", ["flip", "cut", "gone"])
def test_what_is_damaged_is_not_there(path: Path, name: str, harm: str) -> None:
    with Shelf(path, {}) as made:
        made.put("grey", ARRAYS["grey"])
        file = path / "extra" / "grey.0" / name
        raw = bytearray(file.read_bytes())
        raw[len(raw) // 2] ^= 1
        if harm == "gone":
            file.unlink()
        else:
            file.write_bytes(raw if harm == "flip" else raw[:-1])
        assert made.get("grey") is None
        made.put("grey", ARRAYS["grey"])
        np.testing.assert_array_equal(made.get("grey"), ARRAYS["grey"])


def test_one_that_is_removed_is_gone(path: Path) -> None:
    with Shelf(path, {}) as made:
        made.put("grey", ARRAYS["grey"])
        made.remove()
    assert not list(path.parent.iterdir())
    shelf.remove(path)  # of none


def test_what_is_no_shelf_is_left_alone(path: Path) -> None:
    path.mkdir()
    (path / "mine.txt").write_text("stays")
    with pytest.raises(FileError, match="was not made by ltcl"):
        Shelf(path, {})
    shelf.remove(path)
    assert (path / "mine.txt").read_text() == "stays"


def test_a_damaged_document_is_named(path: Path) -> None:
    Shelf(path, {"made": "here"}).close()
    file = path / "zarr.json"
    file.write_bytes(file.read_bytes().replace(b"here", b"away"))
    with pytest.raises(FileError, match=r"a shelf: zarr.json is damaged"):
        Shelf(path, {})
