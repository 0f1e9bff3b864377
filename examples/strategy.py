# SPDX-License-Identifier: BSD-3-Clause
"""A strategy of your own: patterns that you choose, and T from their photographs by `ltcl.fit`.

Strategies that are part of ltcl lie in `ltcl/acquisition/scanning`: they also choose exposures, go
on after a stop, and state their error. `fit` needs none of that: it takes pairs of linear light.
"""

import numpy as np

import ltcl

COUNT = 60
BLOCK = 2


def blocks(count: int, grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Make patterns of random grey blocks, each shifted by some pixels, (count, h, w)."""
    h, w = grid
    patterns = []
    for _ in range(count):
        coarse = random.random((h // BLOCK + 1, w // BLOCK + 1))
        fine = np.kron(coarse, np.ones((BLOCK, BLOCK)))
        top, left = random.integers(0, BLOCK, 2)
        patterns.append(fine[top : top + h, left : left + w])
    return np.stack(patterns).astype(np.float32)


def main() -> None:
    """Fit T of a corner to its photographs, and judge it by a pattern that was not used."""
    random = np.random.default_rng(0)
    corner = ltcl.scenes.dihedral(8, albedo=0.6)
    room = corner.transport()
    patterns = blocks(COUNT, corner.grid, random)
    photographs = np.stack([room @ pattern for pattern in patterns])
    photographs *= 1.0 + 1e-3 * random.standard_normal(photographs.shape)

    fitted = ltcl.fit(patterns, photographs)
    other = corner.sample(ltcl.scenes.landscape(64, 128)).mean(axis=-1)
    error = np.linalg.norm(fitted.transport @ other - room @ other) / np.linalg.norm(room @ other)
    assert error < 0.05
    print(f"T of {COUNT} patterns instead of {other.size}: error {error:.2%}")


if __name__ == "__main__":
    main()
