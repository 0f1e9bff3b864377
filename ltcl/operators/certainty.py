# SPDX-License-Identifier: BSD-3-Clause
"""Where walks have no noise: found from which entries of R are not zero, whatever was drawn.

That a pixel's samples were all alike tells nothing: the one that differs may be rare. Its standard error is 0
only where no walk from it can meet light, or where none has a choice.
"""

from __future__ import annotations

import numpy as np

from ltcl.operators.alias import Tables
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense
from ltcl.operators.links import Links
from ltcl.operators.walks import Lengths

_FARTHEST = 256  # steps; what is farther apart counts as within reach


def without_noise(
    R: CSR | Dense, made: Tables, lengths: Lengths, b: np.ndarray, only_dark: bool = False
) -> np.ndarray:
    """Pixels whose samples are all alike for certain, bool like `b`, (N,) or (N, k).

    Of walks from b, which choose where to start, or that score at their end, `only_dark` pixels are certain.

    >>> import ltcl
    >>> from ltcl.operators import CSR
    >>> from ltcl.operators.alias import tables
    >>> from ltcl.operators.walks import geometric
    >>> import scipy.sparse
    >>> R = CSR(ltcl.open_device(), scipy.sparse.csr_array([[0.0, 0.5], [0.0, 0.0]]))
    >>> without_noise(R, tables(R), geometric(0.5, -1.0), np.array([1.0, 0.0])).tolist()
    [True, True]
    """
    b = np.asarray(b)
    steps = len(lengths.coefficients)
    lit = reached(R, b.reshape(len(b), -1) != 0.0, steps)
    if only_dark:
        return ~lit.reshape(b.shape)
    several = (_drawn(R, made) > 1)[:, None]
    choice = lit & several if lengths.are_one else lit  # to go on is one, where light may still come
    return ~(lit & (several | reached(R, choice, steps))).reshape(b.shape)


def _drawn(R: CSR | Dense, made: Tables) -> np.ndarray:
    """Entries of each row that a walk may draw; of a row of zeros, that ends it, 0 or more."""
    if isinstance(made, Links):
        return made.drawn()
    if made.sampler == "uniform":
        return made.counts()
    if "entries" not in R.tables:
        R.tables["entries"] = _entries(R)
    return R.tables["entries"]


def _entries(R: CSR | Dense) -> np.ndarray:
    """How many of each row are not zero."""
    if isinstance(R, CSR):
        return np.diff(np.concatenate([[0], np.cumsum(R.data != 0.0)])[R.pattern.indptr])
    return np.concatenate([np.count_nonzero(slab.arguments[1].get(), axis=1) for slab in R.slabs])


def reached(R: CSR | Dense, goal: np.ndarray, steps: int) -> np.ndarray:
    """Pixels from which 1 .. `steps` steps along entries of R lead to `goal`, (N, k) bool.

    Products of R with random numbers in place of ones tell it without another matrix: they cancel by chance
    only, and of two draws at once hardly ever.
    """
    rng, found = np.random.default_rng(0), np.zeros_like(goal)
    for _ in range(min(steps, _FARTHEST)):
        x = rng.uniform(0.5, 1.5, (2, *goal.shape)) * (goal | found)
        y = R.apply(R.device.upload(np.concatenate(list(x), axis=1))).get()
        now = found | np.logical_or(*np.split(y != 0.0, 2, axis=1))
        if np.array_equal(now, found):
            return found
        found = now
    return found if steps <= _FARTHEST else np.ones_like(found)
