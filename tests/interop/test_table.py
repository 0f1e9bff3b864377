# SPDX-License-Identifier: BSD-3-Clause
"""Each row of the table of the guide is a test."""

from __future__ import annotations

import doctest
from pathlib import Path

from tests.interop.calls import TABLE

PAGE = Path(__file__).resolve().parents[2] / "docs/guide/arrays.md"


def rows() -> list[str]:
    """The kinds of arrays in the first table, without NumPy's."""
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    begin = lines.index("|---|---|---|") + 1
    end = lines.index("", begin)
    return [line.split("|")[1].strip() for line in lines[begin:end]][1:]


def test_each_row_is_covered_by_a_file_of_tests() -> None:
    for file in TABLE:
        assert (Path(__file__).parent / file).is_file()
    assert sorted(rows()) == sorted(kind for kinds in TABLE.values() for kind in kinds)


def test_the_examples_of_the_page_run(device) -> None:
    examples = doctest.DocTestParser().get_doctest(
        PAGE.read_text(encoding="utf-8"), {}, PAGE.name, str(PAGE), 0
    )
    assert len(examples.examples) > 5
    report: list[str] = []
    assert doctest.DocTestRunner().run(examples, out=report.append).failed == 0, "".join(report)
