# SPDX-License-Identifier: BSD-3-Clause
"""From an empty environment to the demo's picture, and what each import and package costs.

The picture is the sheet of the compensation, which the demo announces by a line with its name: the
clock is read at that line, and the file must be a whole picture then. All other pictures follow.

The wheel of this checkout goes into a new virtual environment with pip, and with uv if PATH has
it; all other packages come from the index that they are configured for, with no cache of their own.
pip goes twice: it compiles the modules of all packages, unless it is told to leave that to Python.
Then the demo runs for the first time, with no kernel compiled. Folders of caches are new ones, so
that nothing of the user's is touched. Times of imports are those of `python -X importtime`: a
package counts without the packages that it imports.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image
from rich.table import Table

from _harness import Options, parse_options, publish

ROOT = Path(__file__).resolve().parents[1]
# Seconds from an empty environment to a picture, and of the first help.
MAX_SECONDS = 20.0
MAX_HELP_SECONDS = 0.3
HELP_RUNS = 5
LARGEST = 8
PICTURE = "compensation.png"
PICTURE_WIDTH = 1600
# Variables that would lead out of the new environment, or keep modules uncompiled.
HIDDEN = (
    "PYTHONPATH",
    "PYTHONHOME",
    "PYTHONDONTWRITEBYTECODE",
    "VIRTUAL_ENV",
    "LTCL_DEVICE",
    "OCL_ICD_VENDORS",
)
IMPORT_TIME = re.compile(r"import time:\s+(\d+) \|\s+\d+ \|\s+([\w.]+)")
SIZES = """
import importlib.metadata, json, os
sizes = {}
for distribution in importlib.metadata.distributions():
    files = [distribution.locate_file(file) for file in distribution.files or []]
    sizes[distribution.name] = sum(os.path.getsize(file) for file in files if os.path.exists(file))
print(json.dumps(sizes))
"""


@dataclass(frozen=True, kw_only=True)
class DemoTimes:
    """Seconds from the start of a demo to the line with its first picture, and to its end."""

    picture: float
    end: float


class Newcomer:
    """Somebody with an empty virtual environment below a folder, and one way to install."""

    def __init__(self, installer: str, folder: Path) -> None:
        # Its name, and options.
        self.installer = installer
        self.folder = folder
        self.environment = {name: text for name, text in os.environ.items() if name not in HIDDEN}
        self.environment["LTCL_CACHE"] = str(folder / "cache")
        self.environment["POCL_CACHE_DIR"] = str(folder / "pocl")
        self.programs = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
        self.run(sys.executable, "-m", "venv", str(folder / "venv"))

    def run(self, *words: str) -> str:
        """Run a command; its output, or the end of the bench with it."""
        done = subprocess.run(  # noqa: S603
            words,
            cwd=self.folder,
            env=self.environment,
            check=False,
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        if done.returncode:
            raise SystemExit(f"{' '.join(words)}: exit status {done.returncode}\n{done.stdout}")
        return done.stdout

    def seconds(self, *words: str) -> float:
        """Seconds that a command takes."""
        start = time.perf_counter()
        self.run(*words)
        return time.perf_counter() - start

    @property
    def python(self) -> str:
        """The Python of the environment."""
        return str(self.programs / "python")

    @property
    def ltcl(self) -> str:
        """The installed command."""
        return str(self.programs / "ltcl")

    def install(self, wheel: Path) -> float:
        """Seconds until the wheel and all that it needs are installed."""
        if self.installer == "uv":
            target = ("--python", self.python)
            return self.seconds("uv", "pip", "install", "--no-cache", *target, str(wheel))
        pip = (self.python, "-m", "pip", "--disable-pip-version-check", "--no-cache-dir")
        options = self.installer.split()[1:]
        return self.seconds(*pip, "install", *options, str(wheel))

    def demo(self, name: str, size: int | None) -> DemoTimes:
        """Run a demo, whose picture must be whole when the line with its name comes."""
        words = [self.ltcl, "demo", "--out", name]
        if size is not None:
            words += ["--size", str(size)]
        picture_seconds = None
        output = []
        start = time.perf_counter()
        with subprocess.Popen(  # noqa: S603
            words,
            cwd=self.folder,
            env=self.environment,
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        ) as process:
            for line in process.stdout or ():
                output.append(line)
                if picture_seconds is None and PICTURE in line:
                    picture_seconds = time.perf_counter() - start
                    check_picture(self.folder / name / PICTURE)
        end = time.perf_counter() - start
        if process.returncode or picture_seconds is None:
            text = "".join(output)
            raise SystemExit(f"{' '.join(words)}: exit status {process.returncode}\n{text}")
        if not (self.folder / name / "contact_sheet.png").is_file():
            raise SystemExit("the demo wrote no contact_sheet.png")
        return DemoTimes(picture=picture_seconds, end=end)

    def help_seconds(self) -> float:
        """Median seconds of `ltcl --help`, once its modules are compiled."""
        self.run(self.ltcl, "--help")
        return statistics.median(self.seconds(self.ltcl, "--help") for _ in range(HELP_RUNS))

    def package_megabytes(self) -> dict[str, float]:
        """Megabytes of the files of each installed package."""
        sizes = json.loads(self.run(self.python, "-c", SIZES))
        return {name: size / 1e6 for name, size in sizes.items()}

    def import_milliseconds(self) -> dict[str, float]:
        """Milliseconds of `import ltcl.demo` in each package, once modules are compiled."""
        text = self.run(self.python, "-X", "importtime", "-c", "import ltcl.demo")
        spent: dict[str, float] = defaultdict(float)
        for microseconds, module in IMPORT_TIME.findall(text):
            spent[self._package(module)] += int(microseconds) / 1e3
        return dict(spent)

    def _package(self, module: str) -> str:
        """The name under which a module counts: all of Python's own are one."""
        package = module.partition(".")[0].removeprefix("_")
        if module.partition(".")[0] in sys.stdlib_module_names:
            return "Python"
        return package


def check_picture(path: Path) -> None:
    """End the bench unless the file is a whole picture."""
    with Image.open(path) as picture:
        # It reads all pixels, and fails where some are missing.
        picture.load()
        if picture.width != PICTURE_WIDTH:
            raise SystemExit(f"{path.name} is {picture.width} pixels wide, not {PICTURE_WIDTH}")


def build_wheel(folder: Path) -> Path:
    """Build the wheel of this checkout."""
    words = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps"]
    subprocess.run([*words, "--wheel-dir", str(folder), str(ROOT)], check=True)  # noqa: S603
    return next(folder.glob("*.whl"))


def largest(amounts: Mapping[str, float]) -> dict[str, float]:
    """The largest amounts, in their order, and the sum of the others."""
    ordered = sorted(amounts, key=lambda name: -amounts[name])
    top = {name: round(amounts[name], 1) for name in ordered[:LARGEST]}
    top["others"] = round(sum(amounts[name] for name in ordered[LARGEST:]), 1)
    return top


def measure(newcomer: Newcomer, wheel: Path, size: int | None) -> dict[str, Any]:
    """All figures of one way to install."""
    install = newcomer.install(wheel)
    first_demo = newcomer.demo("first", size)
    packages = newcomer.package_megabytes()
    imports = newcomer.import_milliseconds()
    second_demo = newcomer.demo("second", size)
    return {
        "install, s": install,
        "first demo until its picture, s": first_demo.picture,
        "first demo until its end, s": first_demo.end,
        "demo with compiled kernels until its picture, s": second_demo.picture,
        "demo with compiled kernels until its end, s": second_demo.end,
        "until the picture, s": install + first_demo.picture,
        "until all pictures, s": install + first_demo.end,
        "help, s": newcomer.help_seconds(),
        "packages, MB": round(sum(packages.values()), 1),
        "largest packages, MB": largest(packages),
        "import ltcl.demo, ms": round(sum(imports.values()), 1),
        "imports, ms": largest(imports),
    }


def tabulate(results: Mapping[str, Mapping[str, Any]]) -> Table:
    """The two targets for each way to install."""
    table = Table("installed with", "question", "measured", "target", "verdict")
    targets = {"until the picture, s": MAX_SECONDS, "help, s": MAX_HELP_SECONDS}
    for installer, figures in results.items():
        for question, target in targets.items():
            measured = figures[question]
            verdict = "hit"
            if measured > target:
                verdict = f"MISS: {measured / target:.2f} times"
            table.add_row(installer, question, f"{measured:.2f}", f"{target:g}", verdict)
    return table


def main() -> None:
    """Run the bench."""
    options: Options = parse_options(__doc__)
    installers = ["pip", "pip --no-compile", "uv"]
    size = None
    if options.smoke:
        installers = ["pip"]
        size = 4
    if shutil.which("uv") is None and "uv" in installers:
        print("left out, since PATH has no uv: installing with it")
        installers.remove("uv")
    results = {}
    facts: dict[str, Any] = {"processor cores": os.cpu_count()}
    if hasattr(os, "getloadavg"):
        # Above 0 others work on this machine, too, and all takes longer.
        facts["load before the bench, of the last minute"] = round(os.getloadavg()[0], 1)
    with tempfile.TemporaryDirectory(prefix="ltcl-install-") as folder:
        wheel = build_wheel(Path(folder))
        for installer in installers:
            home = Path(folder) / installer.replace(" ", "")
            home.mkdir()
            results[installer] = measure(Newcomer(installer, home), wheel, size)
    for installer, figures in results.items():
        for name, value in figures.items():
            facts[f"{installer}: {name}"] = value
    publish(options, "From nothing to a picture", facts, tabulate(results), {"results": results})


if __name__ == "__main__":
    main()
