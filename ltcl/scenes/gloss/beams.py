# SPDX-License-Identifier: BSD-3-Clause
"""Exchange of light fields between patches: G of A = K G (eq. 4), found by rays, reciprocal and lossless.

A beam is a patch and a bin of directions over it (`brdf`); beam i M + m of N patches and M
bins. All rays that leave beam a fall into beams b that point back, and the etendue E (area x
projected solid angle) shared by two beams is the same from both ends:

    G = diag(1 / e) E,    E = E^T,    e_a = area pi / M    (here without the pi)

Every beam sends `rays` rays, spread over patch and bin alike, so E is found twice, from each end.
The mean of both is reciprocal but makes or loses a little light, so E is scaled as Sinkhorn scales
matrices: with l_a the etendue of a's rays that met nothing, or what is black,

    d_a (sum_b E_ab d_b + l_a) = e_a

Rows of G then sum to 1 - d l / e, in a closed room to 1.

Known limit: row sums are exact to rounding, as no light may be made. Where the scaling has not
settled in the last round, because rays are few, it is reciprocity that is off by what is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse
import scipy.stats

from ltcl import checks
from ltcl.scenes.gloss import brdf
from ltcl.scenes.patches import Patches, check_blocks, cut
from ltcl.scenes.rays import cast
from ltcl.scenes.walls import Wall

_AT_ONCE = 1 << 19  # rays followed together
_ROUNDS, _CLOSE = 1000, 1e-9  # of the scaling
_BYTES = 60  # a ray takes at worst, with an entry of its own in E and in what E is made of


def exchange(
    walls: Sequence[Wall], n: int, directions: int, rays: int, blocks: Any = (), seed: int = 0
) -> scipy.sparse.csr_array:
    """Light that beams get from beams, (N M, N M), N = n * n * len(walls): incoming = G outgoing radiance.

    M `directions` are a square number, `rays` are followed from each beam past boxes (B, 2, 3)
    along the axes, from places that `seed` decides. InputError: a number is out of range.
    MemoryLimitError: so many rays do not fit in the memory of the host.

    >>> from ltcl.scenes.builders import WALLS
    >>> G = exchange(WALLS, 2, directions=16, rays=16)
    >>> G.shape, bool(np.allclose(G.sum(axis=1), 1))  # a closed room
    ((384, 384), True)
    """
    k, rays = brdf.side(directions), checks.count("rays", rays)
    seed, boxes = checks.count("seed", seed, least=0), check_blocks(blocks)
    patches = cut(walls, n)
    beams = len(patches) * k * k
    checks.fits_host(f"an exchange of {beams} beams by {rays} rays each", _BYTES * beams * rays)
    share = np.repeat(patches.area / k**2, k**2)  # e
    met = scipy.sparse.csr_array((beams, beams))
    step = max(1, _AT_ONCE // (k * k * rays))
    generator = np.random.default_rng(seed)
    for start in range(0, len(patches), step):
        some = np.arange(start, min(start + step, len(patches)))
        met = met + _met(walls, n, patches, some, _places(len(some), k, rays, generator), boxes)
    E = scipy.sparse.diags_array(share / rays) @ met
    E, lost, scale = (E + E.T) / 2, share - E.sum(axis=1), np.ones(beams)
    for _ in range(_ROUNDS):  # to d E d with d (E d + lost) = share
        correction = share / (scale * (E @ scale + lost))
        scale *= np.sqrt(correction)
        if np.abs(correction - 1).max() < _CLOSE:
            break
    # Rows alone are scaled last, to make that exact.
    rows = scipy.sparse.diags_array(1.0 / (E @ scale + lost))
    return scipy.sparse.csr_array(rows @ E @ scipy.sparse.diags_array(scale))


def _places(patches: int, k: int, rays: int, generator: np.random.Generator) -> np.ndarray:
    """Points of [0, 1)^4, (patches, k^2, rays, 4): u, v on the patch, then the square of directions.

    One set of low discrepancy, shifted for each beam (Cranley and Patterson 1976).
    """
    sobol = scipy.stats.qmc.Sobol(4, scramble=False).random_base2(int(np.ceil(np.log2(rays))))[
        :rays
    ]
    places = (sobol + generator.random((patches, k * k, 1, 4))) % 1.0
    row, column = np.arange(k * k) % k, np.arange(k * k) // k
    places[..., 2:] = (places[..., 2:] + np.stack([column, row], axis=1)[:, None, :]) / k
    return places


def _met(
    walls: Sequence[Wall],
    n: int,
    patches: Patches,
    some: np.ndarray,
    places: np.ndarray,
    blocks: Any,
) -> scipy.sparse.csr_array:
    """How many rays of each beam of `some` patches end in each beam, (N M, N M)."""
    _, bins, rays, _ = places.shape
    k, axes = int(np.sqrt(bins)), patches.frames
    u, v = places[..., :1] - 0.5, places[..., 1:2] - 0.5
    right, down, centre = (
        getattr(patches, edge)[some, None, None] for edge in ("right", "down", "centre")
    )
    origins = (centre + u * right + v * down).reshape(-1, 3)
    vectors = brdf.from_square(places[..., 2:]).reshape(len(some), -1, 3) @ axes[some]
    vectors = vectors.reshape(-1, 3)
    hits = cast(walls, origins, vectors, blocks)
    good = np.flatnonzero(hits.wall >= 0)
    row, column = (
        np.minimum((place[good] * n).astype(np.intp), n - 1) for place in (hits.v, hits.u)
    )
    there = row * (n * len(walls)) + hits.wall[good] * n + column
    back = np.einsum("rij,rj->ri", axes[there], -vectors[good])
    sent = some[good // (bins * rays)] * bins + good // rays % bins
    got = there * bins + brdf.bins(back, k)
    size = len(patches) * bins
    return scipy.sparse.csr_array((np.ones(len(good)), (sent, got)), shape=(size, size))
