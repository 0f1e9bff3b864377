# SPDX-License-Identifier: BSD-3-Clause
"""The twelve photographs of an update: what is shown, and the light that they show.

    black, white     ambient light, and the lamp
    fitted           a picture like nature, and squares of 2, 4 and 8 pixels at random, two of each:
                     where the light falls now, and what has changed
    judges           three of the pictures that judge a sketch, which are never fitted
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltcl.acquisition.agreement import CameraModel
from ltcl.acquisition.radiance import StoredRadiance
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.scanning.sketch import judges, like_nature
from ltcl.acquisition.scratch import ImageFile
from ltcl.acquisition.session import Photograph, ProgressFunction, merge_photographs

# Pictures like nature, and sides of squares, of the patterns that are fitted.
NATURE_PATTERNS = 1
SQUARES = (2, 2, 4, 4, 8, 8)
# Places of the judges among those of a sketch: like nature, text, a lit patch.
JUDGE_PLACES = (0, 4, 7)
SEED = 5
# All photographs.
PHOTOGRAPHS = 2 + NATURE_PATTERNS + len(SQUARES) + len(JUDGE_PLACES)


def fitted_patterns(grid: tuple[int, int]) -> list[np.ndarray]:
    """The patterns (h, w) of 0 and 1 that are fitted.

    >>> len(fitted_patterns((16, 16)))
    7
    """
    random = np.random.default_rng(SEED)
    patterns = [like_nature(grid, random) > 0 for _ in range(NATURE_PATTERNS)]
    for side in SQUARES:
        size = min(side, max(min(grid) // 2, 1))
        height, width = (-(-length // size) for length in grid)
        squares = random.permutation(np.arange(height * width) % 2 == 0).reshape(height, width)
        picture = np.kron(squares, np.ones((size, size), bool))
        patterns.append(picture[: grid[0], : grid[1]])
    return [pattern.astype(np.float32) for pattern in patterns]


def judging_patterns(grid: tuple[int, int]) -> list[np.ndarray]:
    """The patterns (h, w) of 0 and 1 that judge."""
    pictures = judges(grid)
    return [pictures[place] for place in JUDGE_PLACES]


@dataclass(frozen=True, eq=False, kw_only=True)
class UpdateLight:
    """Radiance of the photographs on the camera's pixels, with the ambient light.

    Attributes
    ----------
    black, white : StoredRadiance
    fitted, judging : sequence of StoredRadiance
        Under the patterns.
    """

    black: StoredRadiance
    white: StoredRadiance
    fitted: Sequence[StoredRadiance]
    judging: Sequence[StoredRadiance]


def photograph(
    shots: Shots, seconds: float, camera: CameraModel, progress: ProgressFunction
) -> UpdateLight:
    """Take the photographs; errors are those of `Shots.expose` and `merge_photographs`."""
    black = np.zeros(shots.grid, np.float32)
    shown = [black, black + 1.0, *fitted_patterns(shots.grid), *judging_patterns(shots.grid)]
    shots.prepare([(codes, seconds) for codes in shown])
    file = ImageFile()
    light = []
    for number, codes in enumerate(shown):
        progress("update", number, len(shown))
        shots.expose(codes, seconds)
        taken = Photograph.of(shots, seconds, ImageFile())
        light.append(merge_photographs([taken], camera, None, file))
    progress("update", len(shown), len(shown))
    black_light, white_light, *others = light
    return UpdateLight(
        black=black_light,
        white=white_light,
        fitted=others[: -len(JUDGE_PLACES)],
        judging=others[-len(JUDGE_PLACES) :],
    )
