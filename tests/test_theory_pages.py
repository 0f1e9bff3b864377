# SPDX-License-Identifier: BSD-3-Clause
"""Pages of theory: symbols exist, equations hold in code, bold figures are those of records."""

from __future__ import annotations

import importlib
import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import ltcl
from ltcl.solvers import METHODS

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
DUALITY, BEYOND, ONE_CAMERA = (
    (DOCS / "theory" / f"{name}.md").read_text(encoding="utf-8")
    for name in ("duality", "beyond", "one_camera")
)


def exists(name: str) -> bool:
    """True if ltcl has this dotted name of a module, a class, or an attribute of instances."""
    value: Any = ltcl
    for part in name.split("."):
        if inspect.isclass(value) and not hasattr(value, part):
            annotated = any(part in vars(kind).get("__annotations__", {}) for kind in value.__mro__)
            assigned = rf"self\.{part}(, self\.\w+)*(: [^=\n]+)? = "
            return annotated or re.search(assigned, inspect.getsource(value)) is not None
        if inspect.ismodule(value) and not hasattr(value, part):
            try:
                value = importlib.import_module(f"{value.__name__}.{part}")
            except ImportError:
                return False
        else:
            value = getattr(value, part)
    return True


def test_every_name_of_the_table_of_symbols_exists() -> None:
    table = DUALITY.partition("## Symbols")[2].partition("\n## ")[0]
    rows = [
        line.split(" | ") for line in table.splitlines() if line.startswith("| $") or "(15)" in line
    ]
    names = [name for row in rows for name in re.findall(r"`([\w.]+)`", row[2])]
    assert len(rows) > 20
    assert all(re.findall(r"`", row[2]) for row in rows)
    assert [name for name in names if not exists(name)] == []
    assert not exists("Transport.nothing")
    assert not exists("theory.nothing")


@pytest.mark.parametrize("page", [DUALITY, ONE_CAMERA], ids=["duality", "one camera"])
@pytest.mark.usefixtures("device")
def test_the_equations_of_a_page_hold(page: str) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert code.count("assert") > 2
    exec(code, {})  # noqa: S102 - our own page


class Record:
    """A file of bench/results, whose name begins so."""

    def __init__(self, name: str) -> None:
        found = [*(ROOT / "bench" / "results").glob(f"{name}*.json")]
        assert len(found) == 1, f"records of {name}: {found}; a page quotes one, by its whole name"
        (path,) = found
        self.content = json.loads(path.read_text(encoding="utf-8"))
        self.facts = self.content["facts"]

    def claim(self, text: str, pattern: str) -> Iterator[str]:
        """Numbers that a pattern finds in the outcome of the claim that begins so."""
        (claim,) = (c for c in self.content["claims"] if c["text"].startswith(text))
        found = re.search(pattern, claim["measured"])
        assert found is not None
        yield from found.groups()

    def row(self, **facts: Any) -> dict[str, Any]:
        """The first row that has these."""
        return next(row for row in self.content["rows"] if facts.items() <= row.items())


def percent(value: float, digits: int = 0) -> str:
    return f"{100 * value:.{digits}f}%"


def of_beyond() -> Iterator[str]:
    """Figures of the page, in its order."""
    yield from Record("fig5").claim("ours: Chebyshev", r"at most (\d+) products")
    products = Record("methods").content["products"]
    launches = Record("launches")
    relax = [
        Record("relax").row(question=question, competitor="one product")["ratio"]
        for question in (
            "runs of 16, strips of 63",
            "random, strips of 63",
            "dense 4096, strips of 8",
        )
    ]
    yield from map(str, (*steps(launches, "chebyshev"), *steps(launches, "gmres")))
    yield from (str(steps(launches, method)[0]) for method in ("cg", "bicgstab"))
    yield from (f"{end(relax):.2f}" for end in (min, max))
    yield str(steps(launches, "richardson")[0])
    assert products["jacobi"] == products["neumann"]
    assert products["gauss_seidel"] == products["sor"]
    order = (
        "chebyshev gmres cg bicgstab gauss_seidel block_gauss_seidel southwell richardson jacobi"
    )
    for method in order.split():
        yield from (str(count) for count in products[method].values() if count != "diverged")
    yield f"{Record('walk').facts['steps, M/s']:.1f}"
    gather = Record("fig8").claim(
        "30 samples a pixel suffice", r"error ([\d.]+%), without ([\d.]+%)"
    )
    yield from reversed([*gather])
    kept_lu = Record("dense4k").row(competitor="LU kept, float32 (ours: an inverse kept)")
    yield f"{kept_lu['ratio']:.1f}"
    large = Record("resolution131k-xeon")
    yield from large.claim("pattern of 131072 pixels", r"error ([\d.]+%)")
    stored = large.facts["bytes of T, for bounces and for patterns"].partition(",")[2]
    yield f"{int(stored) / 1e6:.1f}"
    yield from Record("fig7").claim("series, eq. 10: slope", r"([\d.]+),")
    traced = Record("traced").facts
    corner, box = (traced[f"{scene}: bounces of one view, off"] for scene in ("corner", "box"))
    yield from (percent(corner["diagonal"], 2), percent(corner["exact"], 2))
    yield from (percent(box["diagonal"], 1), percent(box["exact"], 1))
    smooth = Record("products").facts
    for kind, digits in (("sparse rows of R", 0), ("its rows in db2", 1), ("both sides in db2", 1)):
        (fact,) = (smooth[name] for name in smooth if re.match(rf"{kind}, error 0\.9\d%", name))
        yield f"{float(fact.split(' a row')[0]):.{digits}f}"
    (worst,) = Record("compression").claim("held pictures", r"([\d.]+)")
    yield f"{float(worst):.2f}"
    yield from map(str, steps(launches, "bounded"))
    within = [
        re.findall(r"([\d.]+)% ([\d.]+)%", str(fact))
        for fact in Record("uncertainty").facts.values()
    ]
    for deviations in zip(*(pair for fact in within for pair in fact), strict=True):
        yield from (f"{end(map(float, deviations)):.1f}%" for end in (min, max))


def steps(launches: Record, method: str) -> tuple[int, int]:
    """Launches and waits of a step."""
    row = launches.row(operator="csr", method=method, k=1)
    return row["launches a step"], row["waits a step"]


def of_one_camera() -> Iterator[str]:
    """Figures of the page, in its order."""
    traced = Record("traced").facts
    yield percent(traced["corner: bounces of one view, off"]["exact"], 2)
    yield from (
        percent(traced[f"{scene}: bounces of one view, off"]["exact"], 1)
        for scene in ("box", "blocks")
    )
    gloss = Record("gloss")
    off = {share: [*of_share(gloss, share)] for share in (0.1, 0.2, 0.4)}
    yield from gloss.claim("without gloss all bounces are exact", r"(.*)")
    for bounces in off[0.1], off[0.2]:
        yield from (percent(end(bounce)) for bounce in bounces for end in (min, max))
        if bounces is off[0.2]:
            yield from gloss.claim("compensation is exact of any gloss", r"(.*)")
    yield from (percent(min(off[0.4][0])), percent(max(off[0.4][0])), percent(min(off[0.4][1])))
    yield from gloss.claim("later bounces are no worse", r"in (\d+ of \d+) scenes")
    yield from reversed(
        [*Record("fig6").claim("one camera's", r"= ([\d.]+), of the light field ([\d.]+)")]
    )
    yield from gloss.claim("negative light in bounce 1", r"is ([\d.]+) to ([\d.]+) times")
    yield from gloss.claim("the warning of section 8.4", r"in (\d+ of \d+) scenes")
    yield from gloss.claim("and not without gloss", r"in (\d+ of \d+) scenes")


def of_share(gloss: Record, share: float) -> Iterator[tuple[float, ...]]:
    """Relative errors of bounces 1 and 2 over all scenes of a share of gloss."""
    cases = [case["off"] for case in gloss.facts.values() if case["gloss"] == share]
    return zip(*(off[1:3] for off in cases), strict=True)


@pytest.mark.parametrize(
    ("page", "figures"),
    [(BEYOND, of_beyond), (ONE_CAMERA, of_one_camera)],
    ids=["beyond", "one camera"],
)
def test_figures_in_bold_are_those_of_the_records(page: str, figures: Any) -> None:
    quoted = re.findall(r"\*\*(.+?)\*\*", page)
    assert quoted == [*figures()]
    records = [path.name for path in (ROOT / "bench" / "results").glob("*.json")]
    named = re.findall(r"\(`([\w]+)(?:\.json)?`[,;)]", page)
    assert len(named) > 4
    assert [name for name in named if not any(record.startswith(name) for record in records)] == []


def test_every_method_is_on_the_page_of_solving() -> None:
    page = (DOCS / "guide" / "solving.md").read_text(encoding="utf-8")
    assert [method for method in METHODS if f"`{method}`" not in page] == []
