# SPDX-License-Identifier: BSD-3-Clause
"""
Figure 7: time over resolution
==============================

How long it takes to find the direct light of a picture, from 128 to 131 072 pixels, with an error
of at most 1 %. A matrix inverse by the series is the slowest way; two sides in wavelets, on which
ltcl's compressed transports rest, is the fastest.

These are measured times: this page draws the record of ``bench/fig7.py``,
``bench/results/fig7.json``.
"""

import json
from pathlib import Path

import fig7

record = json.loads(Path("../../bench/results/fig7.json").read_text())
points = fig7.recorded(record["facts"])
figure = fig7.draw(points, fig7.all_laws(points))
figure

# %%
# At the largest size of each:

print(record["device"])
for name, method in fig7.METHODS.items():
    last = [point for point in points if point.method == name][-1]
    print(
        f"{method.label:20} {last.pixels:7} pixels {1e3 * last.seconds:10.4g} ms, "
        f"error {last.way.error:.2%}"
    )
