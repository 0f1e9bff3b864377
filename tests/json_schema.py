# SPDX-License-Identifier: BSD-3-Clause
"""The schema of what commands print with --json, and the check of documents against it."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator

from ltcl.cli.reports.schema import schema

PAGES = Path(__file__).resolve().parents[1] / "docs" / "reference"
SCHEMA = schema()


@functools.cache
def _validator(name: str) -> Draft202012Validator:
    return Draft202012Validator({"$ref": f"#/$defs/{name}", "$defs": SCHEMA["$defs"]})


def check(words: Sequence[object], document: Any) -> None:
    """Refuse a document that `ltcl` with these words may not print."""
    name = str(words[0])
    if name == "acquire":
        name = f"acquire-{words[1]}"
    if isinstance(document, dict) and {"error", "type"} <= document.keys():
        name = "error"
    errors = sorted(_validator(name).iter_errors(document), key=lambda error: len(error.path))
    assert errors == [], f"{name}: {errors[0].json_path}: {errors[0].message:.500}"
