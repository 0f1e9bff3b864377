# SPDX-License-Identifier: BSD-3-Clause
"""Imports point down only, pyopencl stays inside `ltcl.device`, and the ways of data stay short.

The syntax tree of every file is walked, so imports inside functions count as well; those under
`if TYPE_CHECKING:` never run and do not count. The layers are in `tests/house.py`.
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

RANK = {unit: rank for rank, units in enumerate(house.LAYERS) for unit in units}
FLOORS = {
    "acquisition",
    "batch",
    "cli",
    "demo",
    "device",
    "images",
    "interop",
    "operators",
    "plots",
    "scenes",
    "show",
    "solvers",
    "store",
    "tasks",
    "theory",
    "transport",
    "viewer",
}
FILES = {"__init__.py", "__main__.py", "checks.py", "errors.py", "files.py"}


def imported_names(tree: ast.AST, modules: set[str]) -> Iterator[tuple[int, str]]:
    """Line and dotted name of each module that a file imports when it runs."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            continue
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            for alias in node.names:
                name = f"{base}.{alias.name}"
                if name == "ltcl.__version__":  # a constant
                    continue
                yield node.lineno, name if name in modules else base
        yield from imported_names(node, modules)


def module_name(path: Path) -> str:
    """`ltcl/device/kernels.py` -> `ltcl.device.kernels`; `.../__init__.py` is its folder."""
    parts = ["ltcl", *path.relative_to(house.PACKAGE).with_suffix("").parts]
    if parts[-1] == "__init__":
        parts.pop()
    return ".".join(parts)


def unit_of(module: str) -> str:
    """The unit of ltcl that a module belongs to."""
    parts = module.split(".")[1:]
    if not parts:
        return "__init__"
    first_two = ".".join(parts[:2])
    return first_two if first_two in RANK else parts[0]


def reason_against(importer: str, target: str) -> str | None:
    """Why a module must not import `target`, if there is a reason."""
    top = target.split(".")[0]
    unit = unit_of(importer)
    if not top:
        return "imports are by full names"
    if top == "pyopencl" and unit != "device":
        return "only ltcl/device imports pyopencl"
    if top != "ltcl":
        return None
    other = unit_of(target)
    if other == unit:
        return None
    is_free = unit in house.WITHOUT_DEVICE and (importer, target) not in house.OPENS_DEVICE
    if is_free and other in house.DEVICE_UNITS:
        return f"{unit} stays free of {other}"
    if RANK[other] >= RANK[unit] and (unit, other) not in house.SIDEWAYS:
        return f"{other} (layer {RANK[other]}) is not below {unit} (layer {RANK[unit]})"
    return None


def test_ltcl_holds_its_files_and_floors_alone() -> None:
    entries = {path.name for path in house.PACKAGE.iterdir() if path.name != "__pycache__"}
    assert entries - FLOORS == FILES | {"py.typed"}


def test_imports_of_ltcl_point_down() -> None:
    files = {module_name(path): path for path in house.PACKAGE.rglob("*.py")}
    violations = []
    graph: dict[str, set[str]] = {}
    for name, path in files.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for line, target in imported_names(tree, set(files)):
            reason = reason_against(name, target)
            if reason is not None:
                violations.append(f"{path}:{line} imports {target}: {reason}")
            graph.setdefault(name, set()).add(target)
    assert violations == []
    TopologicalSorter(graph).prepare()  # raises for a circle


@pytest.mark.slow
def test_import_of_ltcl_is_light() -> None:
    code = "import sys, ltcl; print(*{'pyopencl', 'matplotlib', 'cv2'}.intersection(sys.modules))"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=house.PACKAGE.parent
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == []


@pytest.mark.rare
def test_ways_of_data_stay_short() -> None:
    for name, way in house.ways().items():
        assert way.length <= way.limit, (
            f"{name}: {way.length} files, at most {way.limit}: {way.files}"
        )
