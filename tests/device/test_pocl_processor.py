# SPDX-License-Identifier: BSD-3-Clause
"""Processors that PoCL's compiler does not know get the name of an older one."""

import ctypes
from types import SimpleNamespace

import pytest

from ltcl.device import pocl_processor

pytestmark = pytest.mark.skipif(
    not pocl_processor.MEMORY.exists(), reason="no /proc: PoCL's wheel is for Linux"
)
WORDS = 600


class Description:
    """A driver's description of a device: a struct of pointers, some of them to text."""

    def __init__(self, **texts: bytes) -> None:
        self.texts = {place: ctypes.create_string_buffer(text) for place, text in texts.items()}
        self.words = (ctypes.c_void_p * WORDS)()
        self.words[0] = 12  # no address
        self.words[1] = 2**64 - 8
        for place, text in self.texts.items():
            self.words[int(place.removeprefix("at_"))] = ctypes.addressof(text)

    @property
    def address(self) -> int:
        return ctypes.addressof(self.words)

    def text(self, place: int) -> bytes:
        return ctypes.string_at(self.words[place])


def test_an_unnamed_processor_gets_the_name() -> None:
    description = Description(at_68=b"pthread", at_79=b"x86_64-linux", at_80=b"generic")
    assert pocl_processor.name_unnamed(description.address, "haswell")
    assert description.text(80) == b"haswell"
    assert not pocl_processor.name_unnamed(description.address, "haswell")


@pytest.mark.parametrize(
    "texts",
    [
        {"at_79": b"x86_64-linux", "at_80": b"znver3"},
        {"at_79": b"x86_64-linux", "at_80": b"generic-x"},
        {"at_79": b"x86_64-linux", "at_81": b"generic"},
        {"at_80": b"generic"},
        {"at_598": b"x86_64-linux", "at_599": b"generic"},
        {},
    ],
    ids=["named", "longer", "apart", "no target", "beyond", "empty"],
)
def test_other_descriptions_stay(texts: dict[str, bytes]) -> None:
    description = Description(**texts)
    before = list(description.words)
    assert not pocl_processor.name_unnamed(description.address, "haswell")
    assert list(description.words) == before


def test_memory_that_is_not_there_is_not_read() -> None:
    assert not pocl_processor.name_unnamed(8, "haswell")


def test_the_newest_name_whose_instructions_are_there() -> None:
    (best, of_best), (older, of_older), (oldest, _) = pocl_processor.NAMES
    assert pocl_processor.known_name(of_best | of_older) == best
    assert pocl_processor.known_name(of_older | of_best - {"avx512vl"}) == older
    assert pocl_processor.known_name(set()) == oldest


@pytest.mark.parametrize(
    ("driver", "count"), [("NVIDIA CUDA 550", 0), ("Portable Computing Language 3.0", 1)]
)
def test_only_descriptions_of_pocl_are_searched(
    monkeypatch: pytest.MonkeyPatch, driver: str, count: int
) -> None:
    searched: list[int] = []
    monkeypatch.setattr(pocl_processor.sys, "platform", "linux")
    monkeypatch.setattr(pocl_processor.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(
        pocl_processor, "name_unnamed", lambda description, name: searched.append(description)
    )
    pocl_processor.provide(driver, SimpleNamespace(int_ptr=64))
    assert searched == [64] * count
