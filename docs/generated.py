# SPDX-License-Identifier: BSD-3-Clause
"""Ends of reference pages, as MyST: the commands, from the program; fields of their JSON, from its schema."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer

from ltcl.cli.main import app

SCHEMA = Path(__file__).parent / "reference" / "json-schema.json"


def commands() -> str:
    """A section for each command, with what its --help prints."""
    return "\n".join(_command(typer.main.get_command(app), "ltcl"))


def _command(command: Any, name: str) -> Iterator[str]:
    context = command.context_class(command, info_name=name)
    if name != "ltcl":
        yield f"\n({_label(name)})=\n## {name}\n"
        yield _prose(command.help)
    if not hasattr(command, "commands"):
        usage = command.get_usage(context).removeprefix("Usage: ").replace("{", "").replace("}", "")
        yield f"\n```text\n{' '.join(usage.split())}\n```\n\n| option | what it does |\n|---|---|"
        for parameter in command.params:
            if not parameter.hidden:
                names, text = parameter.get_help_record(context)
                yield f"| {_code(names)} | {_prose(text)} |"
    for part, inner in getattr(command, "commands", {}).items():
        if not inner.hidden:
            yield from _command(inner, f"{name} {part}")


def _label(name: str) -> str:
    return name.replace(" ", "-")


def _code(text: str) -> str:
    return f"`{text}`".replace("|", r"\|")


def _prose(text: str) -> str:
    """Words of a help text, in which stars, brackets and bars are themselves."""
    for sign in "\\`*_|<>[]{}":
        text = text.replace(sign, f"\\{sign}")
    return text.replace("--", r"-\-")


def fields() -> str:
    """A section for each command, then one for each part that several have: fields, types, meanings."""
    parts = json.loads(SCHEMA.read_text(encoding="utf-8"))["$defs"]
    program: Any = typer.main.get_command(app)
    named = {
        label: words
        for name, each in program.commands.items()
        for label, words in _names(name, each)
    }
    lines = []
    for name, schema in sorted(parts.items(), key=lambda part: [*named, part[0]].index(part[0])):
        title = f"ltcl {named[name]}" if name in named else _words(name)
        lines += [f"\n(json-{name})=\n## {title}\n", schema["description"], ""]
        rows, choices = [*_rows(schema, "", parts)], schema.get("items", schema).get("anyOf", ())
        lines += [f"Each is a {' or a '.join(map(_type, choices))}."] * bool(choices)
        lines += ["| field | type | meaning |", "|---|---|---|", *rows] if rows else []
    return "\n".join(lines)


def _names(name: str, command: Any) -> list[tuple[str, str]]:
    """Parts of the schema, and words of the command line, of a command and those below it."""
    inner = getattr(command, "commands", {}).items()
    return [(f"{name}-{part}", f"{name} {part}") for part, each in inner if not each.hidden] or [
        (name, name)
    ]


def _rows(schema: dict[str, Any], path: str, parts: dict[str, Any]) -> Iterator[str]:
    """Of a table: the fields of an object by their paths, `[]` for each entry of a list."""
    required = schema.get("required", ())
    if (entries := schema.get("items")) and "properties" in entries:
        yield from _rows(entries, f"{path}[]", parts)
    if isinstance(more := schema.get("additionalProperties"), dict) and "properties" in more:
        yield from _rows(more, f"{path}.NAME", parts)
    for each in schema.get("anyOf", ()) if path else ():
        yield from _rows(each, path, parts)
    for name, field in schema.get("properties", {}).items():
        place = f"{path}.{name}".removeprefix(".")
        maybe = "" if name in required else ", not always there"
        text = (
            field.get("description")
            or parts[field["$ref"].split("/")[-1]]["description"].split(". ")[0]
        )
        values = ", ".join(
            f"`{value}`" for value in field.get("enum", ()) if isinstance(value, str)
        )
        text += f" One of {values}." * bool(values)
        yield f"| `{place}` | {_type(field)}{maybe} | {text} |"
        yield from _rows(field, place, parts)


def _words(name: str) -> str:
    return name.replace("_", " ").replace("-", ", ")


def _type(schema: dict[str, Any]) -> str:
    """In words, with links to the parts that several have."""
    if "$ref" in schema:
        name = schema["$ref"].split("/")[-1]
        return f"[{_words(name)}](#json-{name})"
    if "anyOf" in schema:
        return " or ".join(_type(each) for each in schema["anyOf"])
    kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    if kinds == ["number", "null"]:
        return "number"  # the page says that any may be null
    items = f"list of {_type(schema['items'])}" if "items" in schema else "list"
    return " or ".join(items if kind == "array" else kind for kind in kinds)


PAGES: dict[str, Callable[[], str]] = {"reference/command-line": commands, "reference/json": fields}
