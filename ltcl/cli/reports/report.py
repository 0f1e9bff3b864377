# SPDX-License-Identifier: BSD-3-Clause
"""`Report`: the base of all JSON documents that ltcl prints or writes.

A field is annotated with its type and one line about it, ``Annotated[int, "Number of pixels."]``.
The JSON Schema and the page of the reference are made of these. A field whose default is None is
left out of the document while it is None; any other field that is None is written as null.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Self


@dataclass(kw_only=True)
class Report:
    """A JSON object."""

    @classmethod
    def from_attributes(cls, source: Any, /, **others: Any) -> Self:
        """Read each field from the attribute of its name, except for those in `others`."""
        values = dict(others)
        for field in dataclasses.fields(cls):
            if field.name not in others:
                values[field.name] = getattr(source, field.name)
        return cls(**values)

    def document(self) -> dict[str, Any]:
        """Fields by name, reports within it included."""
        result = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            is_absent = value is None and field.default is None
            if not is_absent:
                result[field.name] = document(value)
        return result


def document(value: Any) -> Any:
    """Replace all reports in lists and dictionaries by their documents."""
    if isinstance(value, Report):
        return value.document()
    if isinstance(value, list):
        return [document(entry) for entry in value]
    if isinstance(value, dict):
        return {name: document(entry) for name, entry in value.items()}
    return value


@dataclass(kw_only=True)
class ErrorReport(Report):
    """A command that failed; the exit code is not 0."""

    error: Annotated[str, "The problem in one line, as on stderr."]
    type: Annotated[str, "A class in `ltcl.errors`, `UsageError`, or another exception."]
    exit_code: Annotated[int, "Exit code; the page on exit codes lists all."]
