# SPDX-License-Identifier: BSD-3-Clause
"""A rig of your own: any object that shows codes and takes a photograph, for `ltcl.acquire`.

A simulated room stands in the place of a projector and a camera; put your own two calls there.
`ltcl.acquire` checks all that goes in and comes back.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import ltcl

CORNER = ltcl.scenes.dihedral(8, albedo=(0.7, 0.6, 0.5))
ROOM = CORNER.transport()


class Rig:
    """A projector of 8 x 16 pixels, whose light is its code squared, and a camera of 16 bits."""

    projector_grid = CORNER.grid
    channels = 3

    def __init__(self) -> None:
        self.random = np.random.default_rng(0)

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """Show codes, (8, 16, 3) in [0, 1], and expose for so many seconds."""
        light = ROOM @ np.asarray(codes, np.float32) ** 2
        electrons = self.random.poisson(20_000.0 * seconds * (light + 0.001))
        return np.clip(100 + electrons, 0, 65_535).astype(np.uint16)


def main() -> None:
    """Scan the room, and compare T with the true one."""
    with TemporaryDirectory() as folder:
        T = ltcl.acquire(Rig(), store=Path(folder) / "scan.zarr")
        white = np.ones((*CORNER.grid, 3), np.float32)
        seen = T @ white
    true = ROOM @ white
    # The unit of light is the camera's own.
    scale = np.vdot(seen, true) / np.vdot(seen, seen)
    error = np.linalg.norm(scale * seen - true) / np.linalg.norm(true)
    assert error < 0.02
    print(f"T by a rig of one's own: error under white {error:.2%}")


if __name__ == "__main__":
    main()
