# SPDX-License-Identifier: BSD-3-Clause
"""Parts of the reference that are made of the program: its commands, and the fields of their JSON.

Pages get their ends, in MyST; the JSON Schema is a file to download.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer

from ltcl.cli.main import build_program
from ltcl.cli.reports.schema import schema

# Written when the site is built; the page on JSON links to it.
SCHEMA_FILE = Path(__file__).parent / "reference" / "generated" / "json-schema.json"
OPTIONS_TABLE = "| option | what it does |\n|---|---|"
FIELDS_TABLE = "| field | type | meaning |\n|---|---|---|"


def write_schema() -> None:
    """Write the JSON Schema of all reports."""
    SCHEMA_FILE.parent.mkdir(parents=True, exist_ok=True)
    SCHEMA_FILE.write_text(json.dumps(schema(), indent=1) + "\n", encoding="utf-8")


def commands() -> str:
    """Return a section for each command, with its --help."""
    return "\n".join(_command_lines(typer.main.get_command(build_program()), "ltcl"))


def _command_lines(command: Any, name: str) -> Iterator[str]:
    context = command.context_class(command, info_name=name)
    if name != "ltcl":
        yield f"\n({_label(name)})=\n## {name}\n"
        yield _prose(command.help)
    if not hasattr(command, "commands"):
        yield from _option_lines(command, context)
        return
    for part, inner in command.commands.items():
        yield from _command_lines(inner, f"{name} {part}")


def _option_lines(command: Any, context: Any) -> Iterator[str]:
    """Yield the usage of a command, and a table of its options, under the headings of --help."""
    usage = command.get_usage(context).removeprefix("Usage: ")
    usage = usage.replace("{", "").replace("}", "")
    yield f"\n```text\n{' '.join(usage.split())}\n```"
    for panel, parameters in _panels(command).items():
        if panel:
            yield f"\n**{panel}**"
        yield f"\n{OPTIONS_TABLE}"
        for parameter in parameters:
            names, text = parameter.get_help_record(context)
            yield f"| {_code(names)} | {_prose(text)} |"


def _panels(command: Any) -> dict[str, list[Any]]:
    """Return arguments and options by their headings."""
    panels: dict[str, list[Any]] = {}
    for parameter in command.params:
        panel = parameter.rich_help_panel or ""
        panels.setdefault(panel, []).append(parameter)
    return panels


def _label(name: str) -> str:
    return name.replace(" ", "-")


def _code(text: str) -> str:
    return f"`{text}`".replace("|", r"\|")


def _prose(text: str) -> str:
    """Escape a help text, in which stars, brackets and bars stand for themselves."""
    for sign in "\\`*_|<>[]{}":
        text = text.replace(sign, f"\\{sign}")
    return text.replace("--", r"-\-")


def fields() -> str:
    """Return a section for each command, then one for each shared part, with its fields."""
    parts = schema()["$defs"]
    titles = _titles_of_commands()
    others = sorted(name for name in parts if name not in titles)
    lines = []
    for name in [*titles, *others]:
        lines += _part_lines(name, titles.get(name, _words(name)), parts)
    return "\n".join(lines)


def _titles_of_commands() -> dict[str, str]:
    """Return titles by definitions of the schema."""
    program: Any = typer.main.get_command(build_program())
    titles = {}
    for name, command in program.commands.items():
        inner = getattr(command, "commands", None)
        if inner is None:
            titles[name] = f"ltcl {name}"
            continue
        for part in inner:
            titles[f"{name}-{part}"] = f"ltcl {name} {part}"
    return titles


def _part_lines(name: str, title: str, parts: dict[str, Any]) -> list[str]:
    part = parts[name]
    lines = [f"\n(json-{name})=\n## {title}\n", part["description"], ""]
    choices = part.get("items", part).get("anyOf", ())
    if choices:
        types = " or a ".join(_type(choice) for choice in choices)
        lines.append(f"Each is a {types}.")
    rows = [*_rows(part, "", parts)]
    if rows:
        lines += [FIELDS_TABLE, *rows]
    return lines


def _rows(part: dict[str, Any], path: str, parts: dict[str, Any]) -> Iterator[str]:
    """Yield rows for the fields of an object by their paths; `[]` is each entry of a list."""
    items = part.get("items", {})
    if "properties" in items:
        yield from _rows(items, f"{path}[]", parts)
    others = part.get("additionalProperties")
    if isinstance(others, dict) and "properties" in others:
        yield from _rows(others, f"{path}.NAME", parts)
    if path:
        for choice in part.get("anyOf", ()):
            yield from _rows(choice, path, parts)
    for name, field in part.get("properties", {}).items():
        place = f"{path}.{name}".removeprefix(".")
        presence = "" if name in part["required"] else ", not always there"
        yield f"| `{place}` | {_type(field)}{presence} | {_meaning(field, parts)} |"
        yield from _rows(field, place, parts)


def _meaning(field: dict[str, Any], parts: dict[str, Any]) -> str:
    """Return the description of a field, or the first sentence on the part to which it refers."""
    if "description" in field:
        text = field["description"]
    else:
        text = parts[_target(field)]["description"].split(". ")[0].removesuffix(".") + "."
    values = [f"`{value}`" for value in field.get("enum", ()) if isinstance(value, str)]
    if values:
        text += f" One of {', '.join(values)}."
    return text


def _target(field: dict[str, Any]) -> str:
    return field["$ref"].rpartition("/")[2]


def _words(name: str) -> str:
    return name.replace("_", " ").replace("-", ", ")


def _type(field: dict[str, Any]) -> str:
    """Return a type in words, with links to shared parts."""
    if "$ref" in field:
        name = _target(field)
        return f"[{_words(name)}](#json-{name})"
    if "anyOf" in field:
        return " or ".join(_type(choice) for choice in field["anyOf"])
    kinds = field["type"]
    if isinstance(kinds, str):
        kinds = [kinds]
    if kinds == ["number", "null"]:
        # The page tells that any number may be null.
        return "number"
    words = []
    for kind in kinds:
        if kind == "array":
            words.append(f"list of {_type(field['items'])}")
        else:
            words.append(kind)
    return " or ".join(words)


PAGES: dict[str, Callable[[], str]] = {"reference/command-line": commands, "reference/json": fields}
