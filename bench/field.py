# SPDX-License-Identifier: BSD-3-Clause
"""A benchmark for inverse light transport: methods on scenes with known bounces (scenes/README.md).

`--data DIR` traces the scenes that DIR lacks (Mitsuba 3, LLVM), and scores the baselines on all
scenes in it. `--method mine="python mine.py"` scores that command instead, `--method dense` one of
the baselines; either may be repeated. `--smoke` takes one small scene, which it simulates and
reports so if LLVM is missing.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.table import Table

from _harness import Options, parse_options, publish
from scenes import baselines, dataset, scoring, tracing

# Scene and method that fail without an error: R of the closed box has eigenvalues above 1.
DIVERGES = {("closed", "iteration")}
ARGUMENTS: dict[str, dict[str, Any]] = {
    "data": {
        "type": Path,
        "metavar": "DIR",
        "help": "folder of the scenes; missing ones are traced",
    },
    "size": {
        "type": int,
        "default": dataset.SIZE,
        "help": "pixels along a side of traced scenes",
    },
    "method": {
        "action": "append",
        "default": [],
        "metavar": "NAME=COMMAND",
        "help": "method to score instead of the baselines",
    },
}


def commands(methods: list[str]) -> dict[str, str]:
    """Commands by the names of their methods; all baselines if there are no methods."""
    script = shlex.join([sys.executable, str(Path(baselines.__file__).resolve())])
    own = {name: f"{script} {shlex.quote(name)}" for name in baselines.METHODS}
    if not methods:
        return own
    chosen = {}
    for text in methods:
        name, _, command = text.partition("=")
        if command:
            chosen[name] = command
        elif name in own:
            chosen[name] = own[name]
        else:
            names = ", ".join(own)
            raise SystemExit(f"--method {text}: it must be NAME=COMMAND, or one of {names}")
    return chosen


def make_scenes(data: Path, options: Options) -> dict[str, Any]:
    """Make the scenes that `data` lacks, and return facts of all its scenes."""
    facts: dict[str, Any] = {}
    names = ("coloured",) if options.smoke else dataset.NAMES
    present = dataset.find_scenes(data)
    missing = [name for name in names if name not in present]
    why_not_traced = tracing.unavailable() if missing else ""
    if why_not_traced:
        facts[f"NOT TRACED: {', '.join(missing)}"] = why_not_traced
        if not options.smoke:
            missing = []
    for name in missing:
        print(f"making {name}", flush=True)
        if why_not_traced:
            dataset.simulate(data / name, name)
        elif options.smoke:
            dataset.trace(data / name, name, size=12, paths=256, samples=256)
        else:
            dataset.trace(data / name, name, size=options.arguments.size)
    scenes = dataset.find_scenes(data)
    if not scenes:
        raise SystemExit(f"{data} has no scenes, and none can be traced: {why_not_traced}")
    for name, scene in scenes.items():
        facts[name] = scene.facts
    return facts


def score(scene: dataset.Scene, name: str, methods: dict[str, str]) -> dict[str, dict[str, Any]]:
    """Scores of all methods on a scene, after those of the traced bounces themselves."""
    scores = {"traced": scoring.traced(scene)}
    for method, command in methods.items():
        print(f"{name}: {method}", flush=True)
        scores[method] = scoring.run(command, scene)
    return scores


def unexpected_failures(results: dict[str, dict[str, dict[str, Any]]]) -> list[str]:
    """Failures of methods that are not in `DIVERGES`."""
    failures = []
    for name, scores in results.items():
        for method, values in scores.items():
            if "failed" in values and (name, method) not in DIVERGES:
                failures.append(f"{name}, {method}: {values['failed']}")
    return failures


def main() -> None:
    """Score every method on every scene; exit status 1 if one fails that is not in `DIVERGES`."""
    options = parse_options(__doc__, ARGUMENTS)
    methods = commands(options.arguments.method)
    data = options.arguments.data
    if not options.smoke and data is None:
        raise SystemExit(
            "--data DIR is missing: the folder of the scenes, or where they are to be traced"
        )
    results: dict[str, dict[str, dict[str, Any]]] = {}
    with TemporaryDirectory() as scratch:
        if data is None:
            data = Path(scratch)
        facts = make_scenes(data, options)
        for name, scene in dataset.find_scenes(data).items():
            results[name] = score(scene, name, methods)
    table = Table("scene", "method", *scoring.COLUMNS, *scoring.OTHERS)
    for name, scores in results.items():
        for method, values in scores.items():
            table.add_row(name, method, *scoring.row(values))
    title = "Inverse light transport on known bounces"
    publish(options, title, facts, table, {"results": results})
    failures = unexpected_failures(results)
    if failures:
        raise SystemExit("failed:\n" + "\n".join(failures))


if __name__ == "__main__":
    main()
