# SPDX-License-Identifier: BSD-3-Clause
"""Imports point down only, pyopencl stays inside `ltcl.device`, and no two modules import each other.

The syntax tree of every file is walked, so imports inside functions count as well; those under
`if TYPE_CHECKING:` never run and do not count. A unit is what stands directly in `ltcl/`: a module or a
package. It may import units of lower rank and itself. Imports whose name is computed at run time are
not seen.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "ltcl"

# Low to high; a new unit of ltcl must be placed here.
LAYERS: list[set[str]] = [
    {"errors", "interrupts"},
    {"checks"},
    {"files"},
    {"images", "device"},
    {"operators", "layout", "channels", "first_bounces", "reciprocity"},
    {"theory", "inverse_diagonal", "transport"},
    {"solvers", "exact", "parts"},
    {
        "compensation",
        "compression",
        "single_view",
        "separation",
        "relighting",
        "analysis",
        "energy",
        "scenes",
        "store",
        "acquisition",
        "report",
    },
    {"plots"},
    {"batch", "demo"},
    {"cli"},
    {"__init__", "__main__"},
]
RANK = {unit: rank for rank, units in enumerate(LAYERS) for unit in units}
SIDEWAYS = {
    ("transport", "theory"),
    ("transport", "inverse_diagonal"),
    ("inverse_diagonal", "theory"),
    ("analysis", "energy"),
    ("separation", "single_view"),
    ("analysis", "single_view"),
    ("acquisition", "store"),
}  # the imports allowed within one layer
NEVER = {(a, b) for a in ("acquisition", "images", "store") for b in ("device", "operators")}
OPENCL = ("device", "pyopencl")  # the one unit that imports it

House = dict[str, str]  # a file's path below ltcl/ -> its source


class Import(NamedTuple):
    line: int
    target: str  # dotted name, of a module as far as the house knows one


class _Finder(ast.NodeVisitor):
    """Collects what a module imports; `package` is the dotted package it lives in."""

    def __init__(self, package: str, modules: set[str]) -> None:
        self.package, self.modules = package, modules
        self.found: list[Import] = []

    def visit_If(self, node: ast.If) -> None:
        if ast.unparse(node.test) not in {"TYPE_CHECKING", "typing.TYPE_CHECKING"}:
            self.generic_visit(node)
            return
        for other in node.orelse:
            self.visit(other)

    def visit_Import(self, node: ast.Import) -> None:
        self.found += [Import(node.lineno, alias.name) for alias in node.names]

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        above = self.package.split(".")[: len(self.package.split(".")) - node.level + 1] if node.level else []
        base = ".".join([*above, *([node.module] if node.module else [])])
        for alias in node.names:
            if (base, alias.name) == ("ltcl", "__version__"):
                continue  # a constant, set before ltcl/__init__.py imports anything
            name = f"{base}.{alias.name}"
            self.found.append(Import(node.lineno, name if name in self.modules else base))

    def visit_Call(self, node: ast.Call) -> None:
        if ast.unparse(node.func) in {"import_module", "importlib.import_module", "__import__"}:
            match node.args:
                case [ast.Constant(value=str(name)), *_] if not name.startswith("."):
                    self.found.append(Import(node.lineno, name))
        self.generic_visit(node)


def dotted(path: str) -> str:
    """`device/kernel.py` -> `ltcl.device.kernel`; `device/__init__.py` -> `ltcl.device`."""
    parts = ["ltcl", *path.removesuffix(".py").split("/")]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def unit(module: str) -> str:
    """The unit of a module of ltcl: `ltcl.device.kernel` -> `device`, `ltcl` -> `__init__`."""
    return [*module.split("."), "__init__"][1]


def imports(house: House) -> Iterator[tuple[str, str, Import]]:
    """Path of the importing file, its dotted name, and one import of it."""
    modules = {dotted(path) for path in house}
    for path, source in house.items():
        name = dotted(path)
        package = name if path.endswith("__init__.py") else name.rpartition(".")[0]
        finder = _Finder(package, modules)
        finder.visit(ast.parse(source, path))
        for found in finder.found:
            yield path, name, found


def forbidden(importer: str, target: str) -> str | None:
    """Why unit `importer` must not import the dotted name `target`, if so."""
    top = target.split(".")[0]
    if top == OPENCL[1] and importer != OPENCL[0]:
        return f"only ltcl/{OPENCL[0]} imports {OPENCL[1]}"
    if top != "ltcl" or unit(target) == importer:
        return None
    imported = unit(target)
    if imported == "__init__":
        return "`ltcl` itself stands above all its parts: import from the module that defines the name"
    if imported not in RANK or importer not in RANK:
        return None  # said once, by `violations`
    if (importer, imported) in NEVER:
        return f"{importer} stays free of {imported}"
    if RANK[imported] >= RANK[importer] and (importer, imported) not in SIDEWAYS:
        return f"{imported} (layer {RANK[imported]}) is not below {importer} (layer {RANK[importer]})"
    return None


def violations(house: House) -> list[str]:
    """One line for each broken rule."""
    found = [
        f"ltcl/{path}: unit {unit(dotted(path))!r} has no layer; place it in tests/test_layers.py"
        for path in house
        if unit(dotted(path)) not in RANK
    ]
    graph: dict[str, set[str]] = {}
    for path, name, (line, target) in imports(house):
        reason = forbidden(unit(name), target)
        if reason:
            found.append(f"ltcl/{path}:{line} imports {target}: {reason}")
        graph.setdefault(name, set()).add(target)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        found.append(f"circle: {' <- '.join(error.args[1])}")
    return found


def real_house() -> House:
    return {p.relative_to(PACKAGE).as_posix(): p.read_text(encoding="utf-8") for p in PACKAGE.rglob("*.py")}


def test_imports_of_ltcl_point_down() -> None:
    house = real_house()
    assert "__init__.py" in house
    found = violations(house)
    assert not found, "\n".join(found)


SOUND: House = {
    "__init__.py": "from ltcl.cli.main import main",
    "errors.py": "import os",
    "device/__init__.py": "from ltcl.device.queue import Queue",
    "device/queue.py": "import pyopencl.array\nfrom .. import errors\nfrom ..errors import LtclError",
    "theory.py": "def f():\n    from ltcl import errors",
    "transport.py": "import ltcl.theory",
    "solvers/__init__.py": "from . import cg",
    "solvers/cg.py": "from ltcl.device import open_device",
    "cli/main.py": "from ltcl import __version__, transport",
}


def test_sound_imports_pass() -> None:
    assert violations(SOUND) == []


@pytest.mark.parametrize(
    ("path", "source", "part"),
    [
        ("errors.py", "from ltcl.solvers.cg import CG", "ltcl/errors.py:1 imports ltcl.solvers.cg"),
        ("errors.py", "import ltcl.transport", "transport (layer 5) is not below errors (layer 0)"),
        ("errors.py", "from ltcl import theory", "imports ltcl.theory"),
        ("errors.py", "def f():\n    import ltcl.solvers", "ltcl/errors.py:2 imports ltcl.solvers"),
        ("errors.py", "class C:\n    def f(self):\n        if x: import ltcl.cli", "errors.py:3"),
        ("device/queue.py", "from ..solvers import cg", "imports ltcl.solvers.cg"),
        ("device/queue.py", "from .. import solvers", "imports ltcl.solvers"),
        ("device/__init__.py", "from ..transport import Transport", "imports ltcl.transport"),
        ("errors.py", "import importlib\nimportlib.import_module('ltcl.cli.main')", "imports ltcl.cli.main"),
        ("theory.py", "from ltcl.transport import Transport", "transport (layer 5) is not below theory"),
        ("errors.py", "import ltcl", "`ltcl` itself"),
        ("transport.py", "from ltcl import solve", "`ltcl` itself"),
        ("solvers/cg.py", "import pyopencl as cl", "only ltcl/device imports pyopencl"),
        ("solvers/cg.py", "def f():\n    from pyopencl.array import Array", "cg.py:2 imports pyopencl.array"),
        ("store/rows.py", "from ltcl.device import open_device", "store stays free of device"),
        ("acquisition/hdr.py", "from ltcl.operators import csr", "acquisition stays free of operators"),
        ("images.py", "import ltcl.device", "images stays free of device"),
        ("novelty.py", "", "'novelty' has no layer"),
        ("solvers/cg.py", "from ltcl.solvers import solve", "circle: "),
        ("device/queue.py", "def f():\n    from . import event", "circle: "),
        ("if_else.py", "if TYPE_CHECKING:\n    pass\nelse:\n    import pyopencl", "only ltcl/device"),
    ],
)
def test_planted_violations_are_found(path: str, source: str, part: str) -> None:
    event = {"device/event.py": "from ltcl.device.queue import Queue"}
    found = violations({**SOUND, **event, path: source})
    assert any(part in line for line in found), found


@pytest.mark.parametrize("condition", ["TYPE_CHECKING", "typing.TYPE_CHECKING"])
def test_imports_for_the_type_checker_alone_are_exempt(condition: str) -> None:
    source = f"if {condition}:\n    import pyopencl\n    from ltcl import solve\n    from .solvers import cg"
    assert violations({**SOUND, "errors.py": source}) == []


def test_import_of_ltcl_is_light() -> None:
    code = "import sys, ltcl; print(*{'pyopencl', 'matplotlib', 'cv2'}.intersection(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == []
