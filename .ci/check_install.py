# SPDX-License-Identifier: BSD-3-Clause
"""Install a wheel and a source archive as a user would, and use them, for each Python of ltcl.

Each archive goes into an empty virtual environment of its own, away from the checkout. All other
packages come as wheels: nothing is compiled. Then `ltcl doctor` and a small `ltcl demo` must end
well, with neither compiler nor linker on PATH; that takes an OpenCL driver, the wheel of PoCL on
Linux x86-64. Pythons are those of the classifiers in pyproject.toml that PATH or pyenv has; those
that are missing are named, which is no error unless --all is given.

Usage: python .ci/check_install.py [--all] [--python 3.12] [--turn 5] dist/*.whl dist/*.tar.gz
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
OLDER = "3.10"
PYENV = Path(os.environ.get("PYENV_ROOT", "~/.pyenv")).expanduser()
VERSION = """
import importlib.metadata, sys, ltcl
assert ltcl.__file__.startswith(sys.prefix), ltcl.__file__
assert importlib.metadata.version("ltcl") == ltcl.__version__
"""


def interpreter(version: str) -> str | None:
    """A Python of that version that can make virtual environments, of PATH or of pyenv's."""
    found = shutil.which(f"python{version}")
    candidates = [found] if found is not None else []
    # Commands that pyenv puts on PATH may only say that their version is not active.
    candidates += map(str, sorted(PYENV.glob(f"versions/{version}.*/bin/python3")))
    code = "import ensurepip, sys, venv; print(sys.version.split()[0])"
    for python in candidates:
        answer = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)  # noqa: S603
        if answer.returncode == 0 and answer.stdout.startswith(f"{version}."):
            return python
    return None


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


def refused(python: str, archive: Path, folder: Path) -> str | None:
    """Ask the pip of an older Python for `archive`; its output unless it names what is needed."""
    subprocess.run([python, "-m", "venv", str(folder)], check=True)  # noqa: S603
    own = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    # With dependencies, as users ask: their lines in pyproject.toml decide what is refused first.
    words = [str(own), "-m", "pip", "install", str(archive)]
    run = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603
    output = run.stdout + run.stderr
    return None if run.returncode and PROJECT["requires-python"] in output else output


def main() -> int:
    """Report on each Python and archive; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("archives", nargs="+", type=Path)
    parser.add_argument("--python", action="append", choices=NAMED, help="these versions only")
    parser.add_argument("--all", action="store_true", help="a Python that is missing is an error")
    parser.add_argument("--turn", type=int, help="one of those that are here, by this number")
    arguments = parser.parse_args()
    archives = [path.resolve(strict=True) for path in arguments.archives]
    asked = arguments.python or NAMED
    pythons: dict[str, str] = {}
    for version in asked:
        python = interpreter(version)
        if python is not None:
            pythons[version] = python
    missing = [version for version in asked if version not in pythons]
    if arguments.turn is not None and pythons:
        taken = list(pythons)[arguments.turn % len(pythons)]
        print(f"Python {taken} has its turn, of {', '.join(pythons)}")
        pythons = {taken: pythons[taken]}
    failed = 0
    for version, python in pythons.items():
        for archive in archives:
            start = time.monotonic()
            with tempfile.TemporaryDirectory(prefix="ltcl-install-") as folder:
                error = use(python, archive, Path(folder))
            failed += error is not None
            verdict = f"FAILED\n{error}" if error else "installed, doctor and demo ran"
            spent = time.monotonic() - start
            print(f"Python {version}, {archive.name}: {verdict} ({spent:.0f} s)", flush=True)
    python = interpreter(OLDER)
    if python is not None:
        with tempfile.TemporaryDirectory(prefix="ltcl-install-") as folder:
            error = refused(python, archives[0], Path(folder))
        failed += error is not None
        verdict = f"FAILED\n{error}" if error else "refused, with the version that is needed"
        print(f"Python {OLDER}, {archives[0].name}: {verdict}")
    if missing:
        print(f"NOT TESTED, for want of such a Python with venv: {', '.join(missing)}")
    return int(failed > 0 or (arguments.all and bool(missing)) or len(missing) == len(asked))


if __name__ == "__main__":
    sys.exit(main())
