# SPDX-License-Identifier: BSD-3-Clause
"""The photographs of an update, twelve and rounds of 16: what is shown, and the light they show.

black, white     ambient light, and the lamp
fitted           a picture like nature, and squares of 2, 4 and 8 pixels at random, two of each:
                 where the light falls now, and what has changed
judges           three of the pictures that judge a sketch, which are never fitted
rounds           patterns of a sketch's rounds, if a place fails by these
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltcl.acquisition.agreement import CameraModel
from ltcl.acquisition.radiance import StoredRadiance
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.scanning.sketch import judges, like_nature, more_patterns
from ltcl.acquisition.scratch import ImageFile
from ltcl.acquisition.session import Photograph, ProgressFunction, merge_photographs

# Pictures like nature, and sides of squares, of the patterns that are fitted.
NATURE_PATTERNS = 1
SQUARES = (2, 2, 4, 4, 8, 8)
# Judges, and their places among those of a sketch, the first that light anything: like nature,
# text, a lit patch; and with too few pixels for text a checkerboard, or a half plane.
JUDGES = 3
JUDGE_PLACES = (0, 4, 7, 5, 2)
SEED = 5
# All photographs.
PHOTOGRAPHS = 2 + NATURE_PATTERNS + len(SQUARES) + JUDGES


def fitted_patterns(grid: tuple[int, int]) -> list[np.ndarray]:
    """The patterns (h, w) of 0 and 1 that are fitted.

    >>> len(fitted_patterns((16, 16)))
    7
    """
    random = np.random.default_rng(SEED)
    h, w = grid
    patterns = []
    for _ in range(NATURE_PATTERNS):
        is_lit = like_nature(grid, random) > 0
        patterns.append(is_lit.astype(np.float32))
    for side in SQUARES:
        size = min(side, max(min(grid) // 2, 1))
        rows = -(-h // size)
        columns = -(-w // size)
        squares = random.permutation(np.arange(rows * columns) % 2 == 0).reshape(rows, columns)
        is_lit = np.kron(squares, np.ones((size, size), bool))
        patterns.append(is_lit[:h, :w].astype(np.float32))
    return patterns


def judge_places(grid: tuple[int, int]) -> list[int]:
    """Places of the judges among those of a sketch.

    >>> judge_places((64, 64)), judge_places((4, 8))
    ([0, 4, 7], [0, 7, 5])
    """
    pictures = judges(grid)
    return [place for place in JUDGE_PLACES if pictures[place].any()][:JUDGES]


def judging_patterns(grid: tuple[int, int]) -> list[np.ndarray]:
    """The patterns (h, w) of 0 and 1 that judge."""
    pictures = judges(grid)
    return [pictures[place] for place in judge_places(grid)]


def all_patterns(grid: tuple[int, int]) -> list[np.ndarray]:
    """The patterns (h, w) of all photographs, in their order."""
    black = np.zeros(grid, np.float32)
    return [black, black + 1.0, *fitted_patterns(grid), *judging_patterns(grid)]


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
    shown = all_patterns(shots.grid)
    black_light, white_light, *others = _take(shots, shown, seconds, camera, progress, 0)
    return UpdateLight(
        black=black_light,
        white=white_light,
        fitted=others[:-JUDGES],
        judging=others[-JUDGES:],
    )


def photograph_round(
    shots: Shots, number: int, seconds: float, camera: CameraModel, progress: ProgressFunction
) -> list[StoredRadiance]:
    """Take the photographs of a round, from 0 on, of patterns that a sketch's round has."""
    shown = more_patterns(shots.grid, number)
    done = PHOTOGRAPHS + number * len(shown)
    return _take(shots, shown, seconds, camera, progress, done)


def _take(
    shots: Shots,
    shown: Sequence[np.ndarray],
    seconds: float,
    camera: CameraModel,
    progress: ProgressFunction,
    done: int,
) -> list[StoredRadiance]:
    """Photograph patterns, all of which come on the list of a person at once."""
    shots.prepare([(codes, seconds) for codes in shown])
    file = ImageFile()
    light = []
    total = done + len(shown)
    for number, codes in enumerate(shown):
        progress("update", done + number, total)
        shots.expose(codes, seconds)
        taken = Photograph.of(shots, seconds, ImageFile())
        light.append(merge_photographs([taken], camera, None, file))
    progress("update", total, total)
    return light
