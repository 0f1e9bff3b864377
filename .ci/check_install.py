# SPDX-License-Identifier: BSD-3-Clause
"""Install a wheel and a source archive as a user would, and use them, for each Python of ltcl.

Each archive goes into an empty virtual environment of its own, away from the checkout. All other
packages come as wheels: nothing is compiled. Then `ltcl doctor` and a small `ltcl demo` must end
well, with neither compiler nor linker on PATH; that takes an OpenCL driver, the wheel of PoCL on
Linux x86-64. Pythons are those of the classifiers in pyproject.toml that PATH has; those that are
missing are named, which is no error unless --all is given.

Usage: python .ci/check_install.py [--all] [--python 3.12] dist/ltcl-*.whl dist/ltcl-*.tar.gz
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NAMED = re.findall(r"Python :: (3\.\d+)$", "\n".join(PROJECT["classifiers"]), re.MULTILINE)
HIDDEN = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "LTCL_DEVICE", "LTCL_CACHE", "OCL_ICD_VENDORS")
VERSION = """
import importlib.metadata, sys, ltcl
assert ltcl.__file__.startswith(sys.prefix), ltcl.__file__
assert importlib.metadata.version("ltcl") == ltcl.__version__
"""


def interpreter(version: str) -> str | None:
    """The Python of that version on PATH, if there is one that can make virtual environments."""
    python = shutil.which(f"python{version}")
    if python is None:
        return None
    # Version managers put a command of every version there, most of which only say that they are
    # not active.
    code = "import ensurepip, sys, venv; print(sys.version.split()[0])"
    answer = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)  # noqa: S603
    return python if answer.returncode == 0 and answer.stdout.startswith(f"{version}.") else None


def use(python: str, archive: Path, folder: Path) -> str | None:
    """Install `archive` for `python` below `folder` and use it; the output of a failed step."""
    environment = {name: value for name, value in os.environ.items() if name not in HIDDEN}
    environment["LTCL_CACHE"] = str(folder / "cache")
    # CI has kernels compiled by now.
    environment.setdefault("POCL_CACHE_DIR", str(folder / "pocl"))
    own = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
    steps = [
        [python, "-m", "venv", str(folder / "venv")],
        # The archive itself may be source, nothing else: `hatchling`, which builds it, is a wheel,
        # too.
        [
            str(own / "python"),
            "-m",
            "pip",
            "install",
            "--quiet",
            "--only-binary=:all:",
            str(archive),
        ],
        [str(own / "python"), "-m", "pip", "check"],
        [str(own / "python"), "-c", VERSION],
        [str(own / "ltcl"), "doctor"],
        [str(own / "ltcl"), "demo", "--size", "8", "--out", str(folder / "demo")],
    ]
    for step in steps:
        run = subprocess.run(  # noqa: S603
            step, cwd=folder, env=environment, text=True, check=False,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        if run.returncode:
            return f"{' '.join(step)}: exit status {run.returncode}\n{run.stdout}"
        environment["PATH"] = str(own)  # from then on: what makes environments may be a script
    sheet = folder / "demo" / "contact_sheet.png"
    return None if sheet.is_file() else f"the demo wrote no {sheet.name}"


def main() -> int:
    """Report on each Python and archive; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("archives", nargs="+", type=Path)
    parser.add_argument("--python", action="append", choices=NAMED, help="these versions only")
    parser.add_argument("--all", action="store_true", help="a Python that is missing is an error")
    arguments = parser.parse_args()
    archives = [path.resolve(strict=True) for path in arguments.archives]
    failed, missing = 0, []
    for version in arguments.python or NAMED:
        python = interpreter(version)
        if python is None:
            missing.append(version)
            continue
        for archive in archives:
            start = time.monotonic()
            with tempfile.TemporaryDirectory(prefix="ltcl-install-") as folder:
                error = use(python, archive, Path(folder))
            failed += error is not None
            verdict = f"FAILED\n{error}" if error else "installed, doctor and demo ran"
            spent = time.monotonic() - start
            print(f"Python {version}, {archive.name}: {verdict} ({spent:.0f} s)", flush=True)
    if missing:
        print(f"NOT TESTED, since PATH has no such Python with venv: {', '.join(missing)}")
    return int(
        failed > 0
        or (arguments.all and bool(missing))
        or len(missing) == len(arguments.python or NAMED)
    )


if __name__ == "__main__":
    sys.exit(main())
