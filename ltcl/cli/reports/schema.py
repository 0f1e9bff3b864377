# SPDX-License-Identifier: BSD-3-Clause
"""`schema`: the JSON Schema (2020-12) of all reports, made of their classes.

A class in `PARTS` is a definition of its own, to which others refer; all others are written where
they are used.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from ltcl.cli.reports import acquisition, export, parts, pictures, program, report, transports
from ltcl.cli.reports.report import Report

DESCRIPTION = (
    "Validate the output of a command against `#/$defs/` and its name "
    "(`acquire-run` for `ltcl acquire run`), or against `#/$defs/error` if it "
    "failed. A number that is not finite is null."
)
# The output of each command; words of the command line are joined by hyphens.
COMMANDS: dict[str, Any] = {
    "devices": Annotated[list[program.ListedDevice], "`ltcl devices`: the best device first."],
    "doctor": program.DoctorReport,
    "demo": program.DemoReport,
    "simulate": acquisition.SimulateReport,
    "info": Annotated[
        list[transports.GoodFile | transports.BadFile],
        "`ltcl info`: one entry for each file. Good files are shown also if "
        "others are bad; the exit code is then 1.",
    ],
    "analyze": Annotated[list[transports.AnalyzedFile], "`ltcl analyze`: one entry for each file."],
    "convert": transports.ConvertReport,
    "align": transports.AlignReport,
    "combine": transports.CombineReport,
    "compress": transports.CompressReport,
    "invert": transports.InvertReport,
    "denoise": transports.DenoiseReport,
    "compensate": Annotated[
        pictures.CompensateReport | pictures.ScenesReport,
        "`ltcl compensate`: pictures with one transport, or with many.",
    ],
    "film": pictures.FilmReport,
    "separate": pictures.SeparateReport,
    "relight": pictures.RelightReport,
    "view": program.ViewReport,
    "play": program.PlayReport,
    "show": program.ShowReport,
    "export": export.ExportReport,
    "acquire-plan": Annotated[
        acquisition.PlanReport | acquisition.PlansReport,
        "`ltcl acquire plan`: of one projector, or of several by their names.",
    ],
    "acquire-run": Annotated[
        acquisition.ScanReport | acquisition.ProjectorsReport | acquisition.PhotographMissing,
        "`ltcl acquire run`: the report of the finished scan, or of the scans of several "
        "projectors, or the next photograph.",
    ],
    "acquire-aim": acquisition.AimReport,
    "acquire-fit": acquisition.FitReport,
    "acquire-import": acquisition.ImportReport,
    "acquire-update": Annotated[
        acquisition.UpdateReport | acquisition.PhotographMissing,
        "`ltcl acquire update`: the new transport and its error, or the next photograph.",
    ],
    "acquire-report": Annotated[
        acquisition.ScanReport | acquisition.ScansReport,
        "`ltcl acquire report`: of one projector, or of several by their names.",
    ],
}
PARTS: dict[str, type[Report]] = {
    "error": report.ErrorReport,
    "versions": parts.Versions,
    "device": parts.Device,
    "transport": parts.TransportFacts,
    "solve": parts.Solve,
    "picture": parts.PictureFiles,
    "picture_with_std": parts.PictureWithStd,
    "verdict": parts.VerdictReport,
    "compensate-pictures": pictures.CompensateReport,
    "compensate-scenes": pictures.ScenesReport,
    "frame": pictures.FrameReport,
    "good_file": transports.GoodFile,
    "bad_file": transports.BadFile,
    "analysis": transports.AnalysisReport,
    "channel_analysis": transports.ChannelAnalysisReport,
    "photograph_missing": acquisition.PhotographMissing,
    "plan": acquisition.PlanReport,
    "scan": acquisition.ScanReport,
}
JSON_TYPES = {
    str: "string",
    Path: "string",
    bool: "boolean",
    int: "integer",
    types.NoneType: "null",
}


def schema() -> dict[str, Any]:
    """Describe the output of all commands."""
    definitions: dict[str, Any] = {}
    for name, kind in COMMANDS.items():
        if get_origin(kind) is Annotated:
            definitions[name] = _describe(kind)
        else:
            definitions[name] = _describe_report(kind)
    for name, part in PARTS.items():
        definitions[name] = _describe_report(part)
    outputs = [*COMMANDS, "error"]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Output of `ltcl COMMAND --json`",
        "description": DESCRIPTION,
        "anyOf": [_reference(name) for name in outputs],
        "$defs": definitions,
    }


def _describe_report(report: type[Report]) -> dict[str, Any]:
    """Describe an object with all its fields."""
    hints = get_type_hints(report, include_extras=True)
    properties = {}
    required = []
    for field in dataclasses.fields(report):
        properties[field.name] = _describe(hints[field.name])
        if field.default is not None:
            required.append(field.name)
    text = inspect.getdoc(report) or ""
    return {
        "description": re.sub(r"\s+", " ", text),
        "type": "object",
        "properties": properties,
        "required": required,
        "additionalProperties": False,
    }


def _describe(kind: Any) -> dict[str, Any]:
    """Describe values of a type of Python."""
    origin = get_origin(kind)
    arguments = get_args(kind)
    if origin is Annotated:
        return {**_describe(arguments[0]), "description": arguments[1]}
    if origin is Literal:
        return {"type": JSON_TYPES[type(arguments[0])], "enum": [*arguments]}
    if origin is list:
        return {"type": "array", "items": _describe(arguments[0])}
    if origin is tuple:
        size = len(arguments)
        items = _describe(arguments[0])
        return {"type": "array", "items": items, "minItems": size, "maxItems": size}
    if origin is dict:
        return _describe_dictionary(arguments[1])
    if origin in (Union, types.UnionType):
        return _describe_union(arguments)
    if kind is float:
        # A number that is not finite is written as null.
        return {"type": ["number", "null"]}
    if kind in JSON_TYPES:
        return {"type": JSON_TYPES[kind]}
    return _describe_part(kind)


def _describe_dictionary(kind: Any) -> dict[str, Any]:
    if kind is Any:
        return {"type": "object"}
    return {"type": "object", "additionalProperties": _describe(kind)}


def _describe_union(kinds: tuple[Any, ...]) -> dict[str, Any]:
    """Describe one of several types: by a list of types if all are simple."""
    choices = [_describe(kind) for kind in kinds]
    # Names of simple types, in their order.
    names: dict[str, None] = {}
    for choice in choices:
        if choice.keys() != {"type"}:
            return {"anyOf": choices}
        name = choice["type"]
        own_names = name
        if isinstance(name, str):
            own_names = [name]
        names |= dict.fromkeys(own_names)
    return {"type": [*names]}


def _describe_part(report: type[Report]) -> dict[str, Any]:
    """Refer to a report, or describe it here."""
    for name, kind in [*PARTS.items(), *COMMANDS.items()]:
        if kind is report:
            return _reference(name)
    return _describe_report(report)


def _reference(name: str) -> dict[str, str]:
    return {"$ref": f"#/$defs/{name}"}
