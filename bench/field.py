# SPDX-License-Identifier: BSD-3-Clause
"""A benchmark for inverse light transport: methods on scenes whose bounces are known (scenes/README.md).

With `--data DIR` traces the scenes that DIR lacks (Mitsuba 3, LLVM), and scores the baselines on
all in it. `--method mine="python mine.py"` scores that command instead, `--method dense` one of the
baselines; either may be repeated. `--smoke` takes one small scene, which it simulates without LLVM,
and says so.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from matplotlib.figure import Figure
from rich.table import Table

from _harness import Options, parse_options, publish
from scenes import baselines, dataset, scoring, tracing

# These fail, and it is no error: R of the closed box has eigenvalues above 1.
DIVERGES = {("closed", "iteration")}
ARGUMENTS: dict[str, dict[str, Any]] = {
    "data": {"type": Path, "metavar": "DIR", "help": "the scenes; what is missing is traced"},
    "size": {"type": int, "default": dataset.SIZE, "help": "pixels along a side of what is traced"},
    "method": {
        "action": "append",
        "default": [],
        "metavar": "NAME=COMMAND",
        "help": "not the baselines",
    },
}


def commands(asked: list[str]) -> dict[str, str]:
    """By their names; of nothing asked all baselines."""
    script = shlex.join([sys.executable, str(Path(baselines.__file__).resolve())])
    own = {name: f"{script} {shlex.quote(name)}" for name in baselines.METHODS}
    chosen = {}
    for text in asked or own:
        name, _, command = text.partition("=")
        if not command and name not in own:
            raise SystemExit(
                f"--method {text}: it must be NAME=COMMAND, or one of {', '.join(own)}"
            )
        chosen[name] = command or own[name]
    return chosen


def make(data: Path, given: Options) -> dict[str, Any]:
    """Make what `data` lacks; facts of all its scenes."""
    facts: dict[str, Any] = {}
    names = ("coloured",) if given.smoke else dataset.NAMES
    missing = [name for name in names if name not in dataset.find_scenes(data)]
    why = tracing.unavailable() if missing else ""
    if why:
        facts[f"NOT TRACED: {', '.join(missing)}"] = why
        missing = missing * given.smoke
    for name in missing:
        print(f"making {name}", flush=True)
        if why:
            dataset.simulate(data / name, name)
        else:
            small = {"size": 12, "paths": 256, "samples": 256}
            dataset.trace(
                data / name, name, **(small if given.smoke else {"size": given.arguments.size})
            )
    if not (scenes := dataset.find_scenes(data)):
        raise SystemExit(f"{data} has no scenes, and none can be traced: {why}")
    return facts | {name: scene.facts for name, scene in scenes.items()}


def main() -> None:
    """Score every method on every scene; exit status 1 where one fails that is not of `DIVERGES`."""
    given, failures = parse_options(__doc__ or "", ARGUMENTS), []
    chosen = commands(given.arguments.method)
    if not given.smoke and given.arguments.data is None:
        raise SystemExit(
            "--data DIR is missing: the folder of the scenes, or where they are to be traced"
        )
    with TemporaryDirectory() as scratch:
        data = given.arguments.data or Path(scratch)
        facts, results = make(data, given), dict[str, dict[str, dict[str, Any]]]()
        table = Table("scene", "method", *scoring.COLUMNS, *scoring.OTHERS)
        for name, scene in dataset.find_scenes(data).items():
            results[name] = {"traced": scoring.traced(scene)}
            for method, command in chosen.items():
                print(f"{name}: {method}", flush=True)
                results[name][method] = scoring.run(command, scene)
                if "failed" in results[name][method] and (name, method) not in DIVERGES:
                    failures.append(f"{name}, {method}: {results[name][method]['failed']}")
            for method, scores in results[name].items():
                table.add_row(name, method, *scoring.row(scores))
    publish(
        given,
        "Inverse light transport on known bounces",
        facts,
        table,
        {"results": results},
        Figure,
    )
    if failures:
        raise SystemExit("failed:\n" + "\n".join(failures))


if __name__ == "__main__":
    main()
