# SPDX-License-Identifier: BSD-3-Clause
"""How well T tells its noise: standard deviations of entries, estimated over true, on scenes that are known.

`Transport.noise` from T alone and from a second measurement, with noise of 1e-5 to 1e-2 of the
median first bounce: a floor alone; with photon noise as large at the first bounce; and with 300
times its variance, which is as large as the floor where light is indirect. For each level: medians
of all entries / of the diagonal, and the share of entries from 1 / 1.3 to 1.3. The first bounce of
the glossy scene is traced, with errors of 7.6e-6 of its own.
"""

from __future__ import annotations

import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _figures import Claim
from _harness import parse_options

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.transport.noise.measured import SCENES, measure, noise_of, truth

LEVELS, PHOTONS, GOAL = (1e-5, 1e-4, 1e-3, 1e-2), (0.0, 1.0, 300.0), 1.3


def ratios(
    exact: ltcl.Transport, level: float, photons: float, twice: bool
) -> tuple[float, float, float]:
    """Estimated over true: median of all entries and of the diagonal; share of entries within the goal."""
    true, T = noise_of(exact, level, photons), exact.to_numpy()
    first, second = (measure(exact, true, seed, known=False) for seed in (0, 1))
    measured = ltcl.Transport(first.to_numpy(), exact.grid, noise=second if twice else None)
    ratio = np.sqrt(measured.noise.variance(T) / true.variance(T))
    within = float(np.mean(np.abs(np.log(ratio)) < np.log(GOAL)))
    return float(np.median(ratio)), float(np.median(np.diag(ratio))), within


def main() -> None:
    """Judge each way, scene and noise."""
    given, facts, good = parse_options(__doc__ or ""), dict[str, Any](), list[bool]()
    for twice, photons, scene in product((False, True), PHOTONS, SCENES):
        exact = truth(scene, 6 if given.smoke else 12)
        found = [ratios(exact, level, photons, twice) for level in LEVELS]
        way = "a second measurement" if twice else "T alone"
        text = "; ".join(
            f"{entries:.2f} / {first:.2f}, {within:.0%}" for entries, first, within in found
        )
        facts[f"{scene}, {photons:g} times photon noise, by {way}"] = text
        good += [within >= 0.95 for *_, within in found]
    text = f"cases of which 95 % of the entries are within a factor {GOAL}"
    listed = [Claim(text, f"{sum(good)} of {len(good)}", "all", all(good))]
    figures.conclude(given, "Noise of T, estimated over true", listed[given.smoke :], facts, Figure)


if __name__ == "__main__":
    main()
