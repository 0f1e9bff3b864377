# SPDX-License-Identifier: BSD-3-Clause
"""Write the SBOM that the wheel carries (PEP 770), in CycloneDX: ltcl and what it depends on.

The wheel holds no code of others, so the components are its dependencies, with the ranges of
pyproject.toml. Versions of a whole installation are in the SBOM that the release workflow makes.

Usage: python .ci/sbom.py
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PLACE = ROOT / "packaging" / "ltcl.cdx.json"


def component(requirement: str) -> dict[str, Any]:
    """Return a dependency as a component, whose range is a property."""
    needed, _, marker = requirement.partition(";")
    # All are for ltcl's Python; some are for one platform alone.
    platform = marker.replace("python_version >= '3.11'", "").strip()
    name = re.split(r"[^\w.-]", needed)[0]
    return {
        "type": "library",
        "bom-ref": f"requirement:{requirement}",
        "name": name,
        "purl": f"pkg:pypi/{name.lower()}",
        "scope": "optional" if platform else "required",
        "properties": [{"name": "requirement", "value": requirement}],
    }


def sbom() -> dict[str, Any]:
    """Return the whole document."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    source = (ROOT / "ltcl" / "__init__.py").read_text(encoding="utf-8")
    (version,) = re.findall(r'^__version__ = "(.*)"$', source, re.MULTILINE)
    own = f"pkg:pypi/ltcl@{version}"
    components = [component(requirement) for requirement in project["dependencies"]]
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "component": {
                "type": "library",
                "bom-ref": own,
                "name": "ltcl",
                "version": version,
                "description": project["description"],
                "licenses": [{"license": {"id": project["license"]}}],
                "purl": own,
            }
        },
        "components": components,
        "dependencies": [{"ref": own, "dependsOn": [part["bom-ref"] for part in components]}],
    }


if __name__ == "__main__":
    PLACE.write_text(json.dumps(sbom(), indent=2) + "\n", encoding="utf-8")
