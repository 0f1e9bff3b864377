# SPDX-License-Identifier: BSD-3-Clause
"""One bounce of light between 131424 patches of a closed box, form factors computed on the way, beside NumPy.

NumPy computes the same sums in float32, a few rows at a time: centre to centre, the close pairs
again at eight pairs of points, near pairs by SciPy from the same sparse corrections. It takes
minutes for all rows, so it does a sample of them, is checked against ours there, and pairs a second
are compared. Every row of F sums to 1 in a closed box: that is how far off the products are.
"""

from __future__ import annotations

import numpy as np

from _harness import Row, parse_options, product, report, seconds
from ltcl.device import Device
from ltcl.scenes import FormFactor, Patches, box, cut
from ltcl.scenes.patches import scaled, squared_size

TARGETS = {"numpy": 20.0, "side": 2.0}
ACCURACY = 1e-4
FAR = 64.0  # sizes of a pair, as `kernels/form_factor.cl` takes it


class Peer:
    """The same sums in NumPy, for some rows."""

    def __init__(self, device: Device, patches: Patches, rows: np.ndarray) -> None:
        placed, _ = scaled(device, patches, np.zeros((0, 2, 3)))
        parts = (placed.centre, placed.normal, placed.right, placed.down)
        self.centre, self.normal, self.right, self.down = (
            part.astype(np.float32) for part in parts
        )
        self.area, self.reach = placed.area.astype(np.float32), FAR**2 * squared_size(placed)
        self.rows = rows

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Rows of F x, (rows,), without the corrections of near pairs."""
        return np.array([self._row(i) @ (self.area * x) for i in self.rows])

    def _row(self, i: int) -> np.ndarray:
        d = self.centre - self.centre[i]
        values = self._exchange(d, self.normal[i], self.normal)
        close = np.flatnonzero(np.einsum("nc,nc->n", d, d) < self.reach + self.reach[i])
        close = close[
            np.abs(self.normal[close] - self.normal[i]).max(axis=1) > 0
        ]  # not of this wall
        angle, total = np.arange(8) * np.pi / 4, np.zeros(len(close), np.float32)
        place = (np.sqrt(1 / 6) * np.stack([np.cos(angle), np.sin(angle)], axis=1)).astype(
            np.float32
        )
        for k in range(8):
            (a, b), (u, v) = place[k], place[3 * k % 8]
            end = self.centre[close] + u * self.right[close] + v * self.down[close]
            start = self.centre[i] + a * self.right[i] + b * self.down[i]
            total += self._exchange(end - start, self.normal[i], self.normal[close])
        values[close] = total / 8
        return values

    def _exchange(self, d: np.ndarray, normal: np.ndarray, normals: np.ndarray) -> np.ndarray:
        here, there = d @ normal, -np.einsum("nc,nc->n", d, normals)
        r2 = np.einsum("nc,nc->n", d, d)
        return np.where((here > 1e-6) & (there > 1e-6), here * there, 0) / (
            np.float32(np.pi) * r2**2 + 1e-30
        )


def main() -> None:
    given = parse_options(__doc__ or "")
    n = 12 if given.smoke else 148
    patches = cut(box(1).walls, n)
    count = len(patches)
    rows = np.random.default_rng(0).choice(count, 16 if given.smoke else 64, replace=False)
    A = FormFactor(patches, device=given.device)
    peer, x = (
        Peer(given.device, patches, rows),
        np.random.default_rng(1).random((count, 3), dtype=np.float32),
    )
    one = np.ascontiguousarray(x[:, 0])
    exact = peer(one) + A._near.apply(given.device.upload(one)).get()[rows]
    if not np.allclose(A.dot(one)[rows], exact, rtol=1e-4):
        raise SystemExit("the product and NumPy's are not the same")
    actions = {"ours 1": product(A, one), "ours 3": product(A, x), "numpy": lambda: peer(one)}
    times = seconds(actions, repeats=3 if given.smoke else 1)
    pairs = {"numpy": len(rows) * count, "ours 1": count**2, "ours 3": 3 * count**2}
    theirs, alone, three = (pairs[name] / times[name] / 1e9 for name in pairs)
    off = float(np.abs(A.row_sums() - 1).max())
    table = [
        Row("product, k = 1", "NumPy", theirs, alone, "Gpairs/s", alone / theirs, TARGETS["numpy"]),
        Row("product, k = 3", "k = 1", alone, three, "Gpairs/s", three / alone, TARGETS["side"]),
        Row.from_times("row sums off 1", "what is promised", ACCURACY, off, "", 1.0),
    ]
    facts = {
        "patches": count,
        "seconds of one product": times["ours 1"],
        "MB stored": A.nbytes / 1e6,
        "MB of a float32 matrix": 4 * count**2 / 1e6,
    }
    report(given, "Form factors computed on the way", table, facts)


if __name__ == "__main__":
    main()
