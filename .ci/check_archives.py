# SPDX-License-Identifier: BSD-3-Clause
"""Check that a wheel and a source archive hold every file of the checkout that belongs in them.

The wheel's description must not point into the repository: a package index shows it without the
files.

Usage: python .ci/check_archives.py dist/ltcl-*.whl dist/ltcl-*.tar.gz
"""

from __future__ import annotations

import re
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUFFIXES = {".py", ".cl", ".h", ".jpg", ".typed", ".html", ".css", ".js", ".svg"}


def checkout(*folders: str) -> set[str]:
    """Names of the source files in `folders`, relative to the checkout."""
    files = (path for folder in folders for path in (ROOT / folder).rglob("*"))
    return {path.relative_to(ROOT).as_posix() for path in files if path.suffix in SUFFIXES}


def missing(archive: Path) -> set[str]:
    """Names that `archive` should hold and does not."""
    if archive.suffix == ".whl":
        required = checkout("ltcl") | {f"ltcl/{name}" for name in checkout("kernels")}
        with zipfile.ZipFile(archive) as wheel:
            return required - set(wheel.namelist())
    required = checkout(
        "ltcl", "kernels", "tests", "bench", "docs/tutorials", "docs/examples", ".ci"
    )
    required |= {"pyproject.toml", "LICENSE", "CITATION.cff"}
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / ".github").rglob("*.md")]
    required |= {path.relative_to(ROOT).as_posix() for path in pages}
    with tarfile.open(archive) as sdist:
        return required - {name.partition("/")[2] for name in sdist.getnames()}


def broken_links(wheel: Path) -> list[str]:
    """Targets of links and pictures in the wheel's description that are paths."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return re.findall(r"\]\(((?!https?:|#)[^)]*)\)", archive.read(name).decode())


def main(names: list[str]) -> int:
    """Report on each archive; return the exit status."""
    archives = [Path(name) for name in names]
    if sorted(archive.suffix for archive in archives) != [".gz", ".whl"]:
        print(f"expected one wheel and one source archive, found {names}")
        return 1
    if not checkout("kernels"):
        print("kernels/ holds no OpenCL source")
        return 1
    status = 0
    for archive in archives:
        lost = sorted(missing(archive))
        print(f"{archive.name}:", f"lacks {', '.join(lost)}" if lost else "complete")
        status |= bool(lost)
        if archive.suffix == ".whl" and (broken := broken_links(archive)):
            print(f"{archive.name}: its description points to {', '.join(broken)}")
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
