# SPDX-License-Identifier: BSD-3-Clause
"""How well T tells its noise: standard deviations of entries, estimated over true, on scenes that are known.

`Transport.noise` from T alone and from a second measurement, with noise of 1e-5 to 1e-2 of the median first
bounce: a floor alone; with photon noise as large at the first bounce; and with 300 times its variance, which
is as large as the floor where light is indirect. Medians of all entries, and of the diagonal. Goal: 1 / 1.3
to 1.3. The first bounce of the glossy scene is traced, with errors of 7.6e-6 of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
from rich.console import Console
from rich.table import Table

import ltcl
from _harness import options, record, write_json
from ltcl import scenes
from ltcl.noise import Noise

LEVELS, PHOTONS, GOAL = (1e-5, 1e-4, 1e-3, 1e-2), (0.0, 1.0, 300.0), 1.3
BLOCK = scenes.Block((0.3, 0.3, 0.2), (0.3, 0.3, 0.3))
GLOSSY = {"albedo": 0.6, "gloss": 0.4, "projector": (0.5, 0.8, 1.5)}
SCENES: dict[str, Callable[[int], ltcl.Transport]] = {
    "corner": lambda n: scenes.dihedral(n, albedo=0.6).transport(),
    "painted": lambda n: scenes.trihedral(n, albedo=[[0.9], [0.3], [0.6]]).transport(),
    "box": lambda n: scenes.box(n, 3, albedo=0.7).transport(),
    "occluded": lambda n: scenes.box(n, 3, albedo=0.7, occluder=BLOCK).transport(),
    "glossy": lambda n: scenes.glossy(scenes.dihedral(n), n, **GLOSSY).transport(),
}


def ratios(
    T: np.ndarray, grid: tuple[int, int], level: float, photons: float, twice: bool
) -> tuple[float, float, float]:
    """Estimated over true: median of all entries and of the diagonal; share of entries within the goal."""
    F, random = float(np.median(np.diag(T))), np.random.default_rng(0)
    true = Noise.uniform(T.shape, level * F, photons * level**2 * F)
    root = np.sqrt(true.variance(T))
    first, second = ((T + root * random.standard_normal(T.shape)).astype(np.float32) for _ in range(2))
    other = ltcl.Transport(second, grid) if twice else None
    ratio = np.sqrt(ltcl.Transport(first, grid, noise=other).noise.variance(T)) / root
    within = float(np.mean(np.abs(np.log(ratio)) < np.log(GOAL)))
    return float(np.median(ratio)), float(np.median(np.diag(ratio))), within


def main() -> None:
    """Print a table of each way, and write the figures."""
    given = options(__doc__ or "")
    console, rows = Console(width=150), []
    transports = {name: make(6 if given.smoke else 12) for name, make in SCENES.items()}
    for twice, photons in product((False, True), PHOTONS):
        title = f"{'from a second measurement' if twice else 'from T alone'}, {photons:g} times photon noise"
        table = Table("scene", *map(str, LEVELS), title=f"Entries / first bounce {title}", width=70)
        for name, transport in transports.items():
            T, cells = transport.to_numpy().astype(np.float64), []
            for level in LEVELS:
                entries, first, within = ratios(T, transport.grid, level, photons, twice)
                rows.append({"title": title, "scene": name, "level": level, "within": within})
                rows[-1] |= {"entries": entries, "first_bounce": first}
                cells.append(f"{entries:.2f} / {first:.2f}")
            table.add_row(name, *cells)
        console.print(table)
    good = np.mean([row["within"] >= 0.95 for row in rows])
    console.print(f"{good:.0%} of the cases have 95 % of the entries within a factor {GOAL}")
    if given.json is not None:
        write_json(given.json, record(given, "Noise of T", {"cases within": float(good)}) | {"rows": rows})


if __name__ == "__main__":
    main()
