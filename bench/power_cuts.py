# SPDX-License-Identifier: BSD-3-Clause
"""Power cuts: is anything lost, or taken for something else, in 100 000 states of a disk.

The operations on files of `ltcl.save` in each format, of acquisitions and of `compensate_frames`
are recorded. A state is what POSIX allows on the disk after a cut between two of them
(`tests/store/power_cuts.py`): whatever was not flushed may be lost, reordered, cut or zero. What is
read in it must be the earlier file, or the new one, whole, and all that was committed before the
cut. Some states of each kind are resumed, to the bytes of a run that was not disturbed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.progress import track

import _figures as figures
from _figures import Claim
from _harness import parse_options
from tests.store.power_cut_works import all_works
from tests.store.power_cuts import Survey, survey, total

STATES = 100_000
RESUMED = 25
SEED = 1


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    works = all_works()
    states = 20 if options.smoke else -(-STATES // len(works))
    resumed = 1 if options.smoke else RESUMED
    random = np.random.default_rng(SEED)
    surveys: dict[str, Survey] = {}
    for name, work in track(works.items(), "states"):
        surveys[name] = survey(
            work.operations, work.read, work.judge, states, random, work.resume, resumed
        )
    sums = total(surveys)
    facts: dict[str, Any] = dict(sums)
    for name, result in surveys.items():
        steps = len(works[name].operations)
        facts[name] = f"{result.distinct} different states of {steps} steps"
    examples = []
    for result in surveys.values():
        examples.extend(result.examples[:1])
    facts["examples"] = examples
    claims = []
    questions = {"lost": "states that lost something", "wrong": "states read wrongly"}
    for kind, text in questions.items():
        claim = Claim(
            text=text,
            measured=f"{sums[kind]} of {sums['states']}",
            wanted="0",
            holds=sums[kind] == 0,
        )
        claims.append(claim)
    figures.conclude(options, "Power cuts", claims, facts, lambda: draw(surveys))


def draw(surveys: dict[str, Survey]) -> Figure:
    """Draw the number of different states by what was done."""
    figure = Figure(figsize=(9, 5), dpi=120, layout="constrained")
    axes = figure.subplots()
    heights = range(len(surveys))
    distinct_states = [result.distinct for result in surveys.values()]
    axes.barh(heights, distinct_states, color="#3b6ea5")
    axes.set_yticks(heights, list(surveys))
    axes.set_xlabel("different states of the disk")
    return figure


if __name__ == "__main__":
    main()
