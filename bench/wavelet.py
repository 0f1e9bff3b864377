# SPDX-License-Identifier: BSD-3-Clause
"""Wavelet transforms of pictures in colour, beside what their memory traffic takes.

Three planes of 256 x 512 pixels stand one below the other (`ltcl.operators.Planes`). A transform
reads each number once and writes it once, which the triad's rate turns into milliseconds; a copy of
the same numbers is timed, too. Vectors are on the device, as inside a solve.

Of an analysis by db2 of 0.5 ms the first level takes 0.17, as a copy of its numbers; launches of
the other levels, each of which waits for the one before, take most of the rest, and more than twice
as much at real-time priority (``chrt``) as without, 0.28 ms on an idle machine: threads then wake
late on the processor that they had before.
"""

from __future__ import annotations

import numpy as np

from _harness import Options, Row, milliseconds, parse_options, product, report, triad
from ltcl.device import vectors
from ltcl.operators import Planes, Wavelet

PLANES = 3
# Share of the triad's rate at which a transform of db2, the paper's wavelet, moves its numbers.
TARGETS = {"db2": 0.5}


def compare(options: Options, name: str, grid: tuple[int, int]) -> list[Row]:
    """Both transforms of one wavelet, and a copy."""
    W = Planes(Wavelet(options.device, grid, name), PLANES)
    pictures = np.random.default_rng(0).random(W.shape[1], dtype=np.float32)
    coefficients = W @ pictures
    if not np.allclose(W.T @ coefficients, pictures, atol=1e-5):
        raise SystemExit(f"the transforms by {name} do not undo each other")
    run_triad, triad_bytes = triad(options.device, options.smoke)
    x = options.device.upload(pictures)
    copied = x.like()

    def copy() -> None:
        vectors.axpby(1.0, x, 0.0, x, copied)
        options.device.finish()

    actions = {
        "triad": run_triad,
        "split": product(W, pictures),
        "join": product(W.T, coefficients),
        "copy": copy,
    }
    ms = milliseconds(actions, repeats=15)
    needed = ms["triad"] * 8 * W.shape[1] / triad_bytes
    size = f"{grid[0]} x {grid[1]}, k = {PLANES}"
    rows = []
    for action in ("split", "join", "copy"):
        target = None if action == "copy" else TARGETS.get(name)
        question = f"{name} of {size}: {action}"
        row = Row.from_times(question, "its bytes, our triad", needed, ms[action], "ms", target)
        rows.append(row)
    return rows


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    grid = (16, 32) if options.smoke else (256, 512)
    rows = []
    for name in ("haar", "db2", "db4"):
        rows += compare(options, name, grid)
    report(options, "Wavelet transforms", rows, {"pixels": PLANES * grid[0] * grid[1]})


if __name__ == "__main__":
    main()
