# SPDX-License-Identifier: BSD-3-Clause
"""What is remembered between runs is private, and can be lost or spoilt at any time."""

from __future__ import annotations

import json
import os
import stat

import pytest

from ltcl.device import cache


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path / "a" / "cache"))
    return tmp_path / "a" / "cache"


def test_what_was_remembered_is_recalled(folder):
    assert cache.recall("x.json", "key") is None
    cache.remember("x.json", "key", ["a", 1])
    cache.remember("x.json", "other", None)
    cache.remember("x.json", "key", ["b"])
    assert cache.recall("x.json", "key") == ["b"]
    assert json.loads((folder / "x.json").read_text()) == {"key": ["b"], "other": None}
    assert [file.name for file in folder.iterdir()] == ["x.json"]  # nothing is left aside, no pickles


@pytest.mark.skipif(os.name != "posix", reason="modes are POSIX's")
def test_folders_are_private(folder):
    cache.remember("x.json", "key", 1)
    for path in (folder, cache.make_folder("inner")):
        assert stat.S_IMODE(path.stat().st_mode) == 0o700
    assert stat.S_IMODE((folder / "x.json").stat().st_mode) == 0o600


def test_a_folder_that_is_there_keeps_its_mode(folder):
    folder.mkdir(parents=True)
    folder.chmod(0o755)
    cache.remember("x.json", "key", 1)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o755


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b'"key"', b"\xff\xfe\0", b"null"])
def test_spoilt_files_are_as_good_as_none(folder, content):
    folder.mkdir(parents=True)
    (folder / "x.json").write_bytes(content)
    assert cache.recall("x.json", "key") is None
    cache.remember("x.json", "key", 2)
    assert cache.recall("x.json", "key") == 2


def test_an_unwritable_place_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path / "file" / "cache"))
    cache.remember("x.json", "key", 1)
    assert cache.recall("x.json", "key") is None


def test_without_a_name_the_users_cache_is_taken(monkeypatch):
    monkeypatch.delenv("LTCL_CACHE")
    assert "ltcl" in cache.folder().parts[-1]
