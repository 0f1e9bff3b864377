# SPDX-License-Identifier: BSD-3-Clause
"""The house: imports point down only, pyopencl stays inside `ltcl.device`, sizes and ways keep their budgets.

The syntax tree of every file is walked, so imports inside functions count as well; those under
`if TYPE_CHECKING:` never run and do not count. A unit is what stands directly in `ltcl/`.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests import house

PACKAGE = Path(__file__).resolve().parents[1] / "ltcl"

# Low to high; a new unit of ltcl must be placed here.
LAYERS: list[set[str]] = [
    {"errors"},
    {"checks", "linker"},
    {"files"},
    {"images", "device"},
    {"operators", "layout", "cluster"},
    {"theory"},
    {"solvers"},
    {"diagnostics", "first_bounce", "noise"},
    {"transport"},
    {"uncertainty"},
    {"verdict"},
    {"compensation", "compression", "separation", "relighting", "analysis", "denoising"}
    | {"scenes", "store", "acquisition", "report"},
    {"plots"},
    {"batch", "demo", "viewer"},
    {"cli"},
    {"__init__", "__main__"},
]
RANK = {unit: rank for rank, units in enumerate(LAYERS) for unit in units}
SIDEWAYS = {("analysis", "report"), ("acquisition", "store")}  # the imports allowed within one layer
NEVER = {(a, b) for a in ("acquisition", "images", "store") for b in ("device", "operators")}


def imported(tree: ast.AST, modules: set[str]) -> Iterator[tuple[int, str]]:
    """Line and dotted name of what a module imports when it runs."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            continue
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            names = {f"{base}.{alias.name}" for alias in node.names} - {"ltcl.__version__"}  # a constant
            yield from ((node.lineno, name if name in modules else base) for name in names)
        yield from imported(node, modules)


def dotted(path: str) -> str:
    """`device/kernel.py` -> `ltcl.device.kernel`; `device/__init__.py` -> `ltcl.device`."""
    parts = ["ltcl", *path.removesuffix(".py").split("/")]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def forbidden(importer: str, target: str) -> str | None:
    """Why unit `importer` must not import the dotted name `target`, if so."""
    top, *rest = target.split(".")
    if not top:
        return "imports are by full names"
    if top == "pyopencl" and importer != "device":
        return "only ltcl/device imports pyopencl"
    unit = rest[0] if rest else "__init__"  # which stands above all its parts
    if top != "ltcl" or unit == importer:
        return None
    if (importer, unit) in NEVER:
        return f"{importer} stays free of {unit}"
    if RANK[unit] >= RANK[importer] and (importer, unit) not in SIDEWAYS:
        return f"{unit} (layer {RANK[unit]}) is not below {importer} (layer {RANK[importer]})"
    return None


def test_imports_of_ltcl_point_down() -> None:
    files = {dotted(path.relative_to(PACKAGE).as_posix()): path for path in PACKAGE.rglob("*.py")}
    lines, graph = [], {}
    for name, path in files.items():
        for line, target in imported(ast.parse(path.read_text(encoding="utf-8")), set(files)):
            if reason := forbidden([*name.split("."), "__init__"][1], target):
                lines.append(f"{path}:{line} imports {target}: {reason}")
            graph.setdefault(name, set()).add(target)
    assert lines == []
    TopologicalSorter(graph).prepare()  # raises for a circle


def test_import_of_ltcl_is_light() -> None:
    code = "import sys, ltcl; print(*{'pyopencl', 'matplotlib', 'cv2'}.intersection(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == []


@pytest.mark.parametrize("count", [house.sizes, house.ways])
def test_parts_and_ways_do_not_grow_beyond_their_budgets_or_what_they_reached(count) -> None:
    for name, (size, budget, *files) in count().items():
        assert size <= budget, (name, files)
