# SPDX-License-Identifier: BSD-3-Clause
"""Every example in a docstring runs and prints what it says."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

import ltcl

NAMES = [module.name for module in pkgutil.walk_packages(ltcl.__path__, "ltcl.")]
# That runs the program.
MODULES = [
    "ltcl",
    *sorted(name for name in NAMES if not name.endswith(".__main__")),
]


@pytest.mark.parametrize("name", MODULES)
@pytest.mark.usefixtures("device")
def test_the_examples_of(name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # for examples that write a file
    failed, _ = doctest.testmod(importlib.import_module(name))
    assert failed == 0, "see the report above"


@pytest.mark.parametrize(
    "name",
    ["Transport", "acquire", "analyze", "compensate", "invert", "relight", "separate", "solve"],
)
def test_the_public_tasks_have_an_example(name):
    examples = doctest.DocTestFinder(recurse=False).find(getattr(ltcl, name))
    assert sum(len(found.examples) for found in examples) > 0
