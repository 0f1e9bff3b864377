# SPDX-License-Identifier: BSD-3-Clause
"""A bounce of light between 131424 patches of a closed box, with no stored matrix, beside NumPy.

Form factors are computed on the way. NumPy computes the same sums in float32, a few rows at a time:
centre to centre, the close pairs again at eight pairs of points, near pairs by SciPy from the same
sparse corrections. It takes minutes for all rows, so it does a sample of them, is checked against
ours there, and pairs a second are compared. Every row of F sums to 1 in a closed box: the deviation
from 1 is the error of the products.
"""

from __future__ import annotations

import numpy as np

from _harness import Row, parse_options, product, report, seconds
from ltcl.device import Device
from ltcl.scenes import FormFactor, Patches, box, cut
from ltcl.scenes.patches import scaled, squared_size

# Least ratio to NumPy, and of three sides to one.
TARGETS = {"numpy": 20.0, "side": 2.0}
ACCURACY = 1e-4
# Distance in sizes of a pair beyond which centres suffice, as in `kernels/form_factor.cl`.
FAR = 64.0


class Peer:
    """The same sums in NumPy, for some rows."""

    def __init__(self, device: Device, patches: Patches, rows: np.ndarray) -> None:
        placed, _ = scaled(device, patches, np.zeros((0, 2, 3)))
        self.centre = placed.centre.astype(np.float32)
        self.normal = placed.normal.astype(np.float32)
        self.right = placed.right.astype(np.float32)
        self.down = placed.down.astype(np.float32)
        self.area = placed.area.astype(np.float32)
        self.squared_reach = FAR**2 * squared_size(placed)
        self.rows = rows

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Rows of F x, (rows,), without the corrections of near pairs."""
        return np.array([self._row(i) @ (self.area * x) for i in self.rows])

    def _row(self, i: int) -> np.ndarray:
        offsets = self.centre - self.centre[i]
        values = _exchange(offsets, self.normal[i], self.normal)
        close = self._close_patches(i, offsets)
        values[close] = self._close_exchange(i, close)
        return values

    def _close_patches(self, i: int, offsets: np.ndarray) -> np.ndarray:
        """Indices of the patches on other walls within reach of patch i."""
        squared_distance = np.einsum("nc,nc->n", offsets, offsets)
        close = np.flatnonzero(squared_distance < self.squared_reach + self.squared_reach[i])
        is_on_other_wall = np.abs(self.normal[close] - self.normal[i]).max(axis=1) > 0
        return close[is_on_other_wall]

    def _close_exchange(self, i: int, close: np.ndarray) -> np.ndarray:
        """Mean over eight pairs of points, on circles in both patches."""
        angle = np.arange(8) * np.pi / 4
        circle = np.sqrt(1 / 6) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points = circle.astype(np.float32)
        total = np.zeros(len(close), np.float32)
        for k in range(8):
            a, b = points[k]
            u, v = points[3 * k % 8]
            end = self.centre[close] + u * self.right[close] + v * self.down[close]
            start = self.centre[i] + a * self.right[i] + b * self.down[i]
            total += _exchange(end - start, self.normal[i], self.normal[close])
        return total / 8


def _exchange(offsets: np.ndarray, normal: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Exchange of light between a patch and others at these offsets, per area."""
    cosine = offsets @ normal
    other_cosine = -np.einsum("nc,nc->n", offsets, normals)
    squared_distance = np.einsum("nc,nc->n", offsets, offsets)
    is_facing = (cosine > 1e-6) & (other_cosine > 1e-6)
    numerator = np.where(is_facing, cosine * other_cosine, 0)
    return numerator / (np.float32(np.pi) * squared_distance**2 + 1e-30)


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    n = 148
    sampled = 64
    if options.smoke:
        n = 12
        sampled = 16
    patches = cut(box(1).walls, n)
    count = len(patches)
    rows = np.random.default_rng(0).choice(count, sampled, replace=False)
    A = FormFactor(patches, device=options.device)
    peer = Peer(options.device, patches, rows)
    x = np.random.default_rng(1).random((count, 3), dtype=np.float32)
    one = np.ascontiguousarray(x[:, 0])
    corrections = A._near.apply(options.device.upload(one)).get()[rows]
    if not np.allclose(A.dot(one)[rows], peer(one) + corrections, rtol=1e-4):
        raise SystemExit("the product and NumPy's are not the same")
    actions = {"ours 1": product(A, one), "ours 3": product(A, x), "numpy": lambda: peer(one)}
    times = seconds(actions, repeats=3 if options.smoke else 1)
    facts = {
        "patches": count,
        "seconds of one product": times["ours 1"],
        "MB stored": A.nbytes / 1e6,
        "MB of a float32 matrix": 4 * count**2 / 1e6,
    }
    table = comparisons(times, count, sampled)
    deviation = float(np.abs(A.row_sums() - 1).max())
    table.append(
        Row.from_times("row sums off 1", "what is promised", ACCURACY, deviation, "", target=1.0)
    )
    report(options, "Form factors computed on the way", table, facts)


def comparisons(times: dict[str, float], count: int, sampled: int) -> list[Row]:
    """Compare billions of pairs a second: NumPy's, of one side and of three."""
    theirs = sampled * count / times["numpy"] / 1e9
    one_side = count**2 / times["ours 1"] / 1e9
    three_sides = 3 * count**2 / times["ours 3"] / 1e9
    beside_numpy = Row(
        question="product, k = 1",
        competitor="NumPy",
        theirs=theirs,
        ours=one_side,
        unit="Gpairs/s",
        ratio=one_side / theirs,
        target=TARGETS["numpy"],
    )
    beside_one_side = Row(
        question="product, k = 3",
        competitor="k = 1",
        theirs=one_side,
        ours=three_sides,
        unit="Gpairs/s",
        ratio=three_sides / one_side,
        target=TARGETS["side"],
    )
    return [beside_numpy, beside_one_side]


if __name__ == "__main__":
    main()
