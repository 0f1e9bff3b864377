# SPDX-License-Identifier: BSD-3-Clause
"""What commands print with --json, against the schema of docs/reference."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator

PAGES = Path(__file__).resolve().parents[1] / "docs" / "reference"
SCHEMA = json.loads((PAGES / "json-schema.json").read_text(encoding="utf-8"))
HIDDEN = {
    "acquire-resume": "acquire-run",
    "acquire-finalize": "acquire-run",
}  # names of earlier versions


@functools.cache
def _validator(name: str) -> Draft202012Validator:
    return Draft202012Validator({"$ref": f"#/$defs/{name}", "$defs": SCHEMA["$defs"]})


def check(words: Sequence[object], document: Any) -> None:
    """Refuse a document that `ltcl` with these words may not print."""
    name = "-".join(map(str, words[: 1 + (words[0] == "acquire")]))
    failed = isinstance(document, dict) and "error" in document and "type" in document
    name = "error" if failed else HIDDEN.get(name, name)
    errors = sorted(_validator(name).iter_errors(document), key=lambda error: len(error.path))
    assert errors == [], f"{name}: {errors[0].json_path}: {errors[0].message:.500}"
