# SPDX-License-Identifier: BSD-3-Clause
"""The pages of the reference name all there is, and nothing that is not."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import json
import re
import types
from pathlib import Path

import pytest

import ltcl
from tests.json_schema import PAGES, SCHEMA

pytestmark = pytest.mark.slow

PACKAGE = Path(ltcl.__file__).parent
FILES = [path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))]
PYTHON, ERRORS, ENVIRONMENT = (
    (PAGES / f"{name}.md").read_text("utf-8") for name in ("python", "errors", "environment")
)
PUBLIC = [
    "ltcl",
    *(f"ltcl.{name}" for name in ltcl.__all__ if inspect.ismodule(getattr(ltcl, name))),
]
PUBLIC += [
    f"ltcl.{name}" for name in ("compensation", "compression", "demo", "device", "noise", "store")
]
PUBLIC += [f"ltcl.acquisition.{name}" for name in ("geometry", "radiometry", "rigs", "scanning")]


def public(module: types.ModuleType) -> list[str]:
    """Public names of a module; its classes where it has no list of names."""
    own = [
        name
        for name, value in vars(module).items()
        if getattr(value, "__module__", "") == module.__name__
    ]
    return getattr(module, "__all__", own)


def resolve(name: str) -> object:
    """The object of a dotted name."""
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def test_every_public_name_is_on_the_page_of_python() -> None:
    listed = re.findall(r"^   (ltcl\.[\w.]+)$", PYTHON, re.MULTILINE)
    assert len(listed) == len(set(listed))
    objects = {id(resolve(name)) for name in listed}
    for place in PUBLIC:
        module = importlib.import_module(place)
        for name in public(module):
            value = getattr(module, name)
            is_there = id(value) in objects or f"`{place}.{name}`" in PYTHON
            assert is_there or inspect.ismodule(value), f"{place}.{name}"


EXAMPLES = "\n".join(re.findall(r"```pycon\n(.*?)```", PYTHON, re.DOTALL))


def test_every_public_name_has_an_example() -> None:
    """An example is in the docstring, a method's, or on the page; an error's message is one."""
    without = []
    for name in re.findall(r"^   (ltcl\.[\w.]+)$", PYTHON, re.MULTILINE):
        own = resolve(name)
        inner = vars(own).values() if inspect.isclass(own) else ()
        documents = [
            inspect.getdoc(each) or "" for each in (own, *inner) if hasattr(each, "__doc__")
        ]
        shown = re.search(rf"\b{name.rpartition('.')[2]}\b", EXAMPLES)
        if not (
            shown or name.startswith("ltcl.errors.") or any(">>>" in text for text in documents)
        ):
            without.append(name)
    assert without == []


@pytest.mark.slow
@pytest.mark.usefixtures("device")
def test_the_examples_on_the_page_run() -> None:
    examples = doctest.DocTestParser().get_doctest(EXAMPLES, {}, "python.md", "python.md", 0)
    assert doctest.DocTestRunner().run(examples).failed == 0, "see the report above"


def texts() -> str:
    """All texts of the package, each on a line, with … in the place of what is put in."""
    found = []
    for tree in map(ast.parse, FILES):
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                parts = (str(p.value) if isinstance(p, ast.Constant) else "…" for p in node.values)
                found.append("".join(parts))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return "\n".join(found)


def test_messages_on_the_page_of_errors_are_those_of_the_package() -> None:
    known = texts()
    sections = ERRORS.partition("## Files")[2]
    messages = re.findall(r"^\| `(.*?)` \|", sections, re.MULTILINE)
    assert len(messages) > 50
    parts = [(message, part) for message in messages for part in re.split(" ?… ?", message) if part]
    assert [message for message, part in parts if part not in known] == []


def test_every_class_of_errors_is_on_its_page() -> None:
    classes = re.findall(r"^\| `(\w+)` \|", ERRORS.partition("## Files")[0], re.MULTILINE)
    assert {*classes, "LtclError"} == {*public(ltcl.errors)} - {"annotations"}


def test_every_variable_that_is_read_is_on_the_page() -> None:
    read = {name for text in FILES for name in re.findall(r'environ(?:\.get\(|\[)"(\w+)"', text)}
    read |= {name for text in FILES for name in re.findall(r"\bLTCL_[A-Z]+\b", text)}
    first, _, others = ENVIRONMENT.partition("Drivers and libraries")
    own = set(re.findall(r"^\| `(\w+)` \|", first, re.MULTILINE))
    assert own == {name for name in read if name.startswith("LTCL_")}
    assert [name for name in read - own if f"`{name}`" not in others] == []


def test_the_schema_describes_every_field() -> None:
    def walk(schema: dict, path: str) -> None:
        for name, field in schema.get("properties", {}).items():
            assert field.get("description") or "$ref" in field, f"{path}.{name}"
            walk(field, f"{path}.{name}")
        for each in (
            schema.get("items"),
            schema.get("additionalProperties"),
            *schema.get("anyOf", ()),
        ):
            if isinstance(each, dict):
                walk(each, path)
        assert "properties" not in schema or schema["additionalProperties"] is False, path

    for name, schema in SCHEMA["$defs"].items():
        assert schema["description"], name
        walk(schema, name)
    targets = re.findall(r'"#/\$defs/([\w-]+)"', json.dumps(SCHEMA))
    assert {*targets} <= {*SCHEMA["$defs"]}


@pytest.mark.parametrize("page", ["command-line", "json"])
def test_generated_pages_have_all_commands(page, monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(PAGES.parent))
    text = importlib.import_module("generated").PAGES[f"reference/{page}"]()
    commands = [
        name for name in SCHEMA["$defs"] if f"`ltcl {name.replace('-', ' ')}`" in json.dumps(SCHEMA)
    ]
    assert len(commands) > 15
    assert [name for name in commands if f"\n## ltcl {name.replace('-', ' ')}\n" not in text] == []
