# SPDX-License-Identifier: BSD-3-Clause
"""Exchange of light fields between patches by rays, G of A = K G (eq. 4): reciprocal, lossless.

A beam is a patch and a bin of directions over it (`brdf`): beam i M + m is bin m of patch i, of N
patches and M bins. All rays that leave beam a fall into beams b that point back, and the etendue E
(area x projected solid angle) shared by two beams is the same from both ends:

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
import scipy  # its subpackage stats is loaded at the first use
import scipy.sparse

from ltcl import checks
from ltcl.scenes.gloss import brdf
from ltcl.scenes.patches import Patches, check_blocks, cut
from ltcl.scenes.rays import cast
from ltcl.scenes.walls import Wall

RAYS_AT_ONCE = 1 << 19
# A ray takes so many bytes at worst, with an entry of its own in E and in the matrices that make
# up E.
BYTES_PER_RAY = 60
MAX_SCALING_ROUNDS = 1000
SCALING_TOLERANCE = 1e-9


def exchange(
    walls: Sequence[Wall], n: int, directions: int, rays: int, blocks: Any = (), seed: int = 0
) -> scipy.sparse.csr_array:
    """Light that beams get from beams, G (N M, N M), with N = n * n * len(walls).

    Incoming radiance is G times outgoing radiance.

    M `directions` are a square number, `rays` are followed from each beam past boxes (B, 2, 3)
    along the axes, from places that `seed` decides. InputError if a number is out of range,
    MemoryLimitError if so many rays do not fit in the memory of the host.

    >>> from ltcl.scenes.builders import WALLS
    >>> G = exchange(WALLS, 2, directions=16, rays=16)
    >>> G.shape, bool(np.allclose(G.sum(axis=1), 1))  # a closed room
    ((384, 384), True)
    """
    k = brdf.side(directions)
    rays = checks.count("rays", rays)
    seed = checks.count("seed", seed, least=0)
    boxes = check_blocks(blocks)
    patches = cut(walls, n)
    bins = k * k
    beams = len(patches) * bins
    light_field = f"an exchange of {beams} beams by {rays} rays each"
    checks.fits_host(light_field, BYTES_PER_RAY * beams * rays)
    hits = scipy.sparse.csr_array((beams, beams))
    patches_at_once = max(1, RAYS_AT_ONCE // (bins * rays))
    generator = np.random.default_rng(seed)
    for start in range(0, len(patches), patches_at_once):
        sources = np.arange(start, min(start + patches_at_once, len(patches)))
        places = _places(len(sources), k, rays, generator)
        hits = hits + _count_hits(walls, n, patches, sources, places, boxes)
    etendue = np.repeat(patches.area / bins, bins)  # e
    E = scipy.sparse.diags_array(etendue / rays) @ hits
    return _scaled_exchange(E, etendue)


def _scaled_exchange(E: Any, etendue: np.ndarray) -> scipy.sparse.csr_array:
    """G of an etendue E that was found from each end: reciprocal, and without loss."""
    lost = etendue - E.sum(axis=1)
    E = (E + E.T) / 2
    scale = np.ones(len(etendue))
    # To d E d with d (E d + lost) = etendue.
    for _ in range(MAX_SCALING_ROUNDS):
        correction = etendue / (scale * (E @ scale + lost))
        scale *= np.sqrt(correction)
        if np.abs(correction - 1).max() < SCALING_TOLERANCE:
            break
    # Rows alone are scaled last, to make that exact.
    rows = scipy.sparse.diags_array(1.0 / (E @ scale + lost))
    return scipy.sparse.csr_array(rows @ E @ scipy.sparse.diags_array(scale))


def _places(patches: int, k: int, rays: int, generator: np.random.Generator) -> np.ndarray:
    """Points of [0, 1)^4, (patches, k^2, rays, 4): u, v on the patch, the square of directions.

    One set of low discrepancy, shifted for each beam (Cranley and Patterson 1976).
    """
    sequence = scipy.stats.qmc.Sobol(4, scramble=False)
    sobol = sequence.random_base2(int(np.ceil(np.log2(rays))))[:rays]
    places = (sobol + generator.random((patches, k * k, 1, 4))) % 1.0
    column, row = np.divmod(np.arange(k * k), k)
    corner = np.stack([column, row], axis=1)[:, None, :]
    places[..., 2:] = (places[..., 2:] + corner) / k
    return places


def _count_hits(
    walls: Sequence[Wall],
    n: int,
    patches: Patches,
    sources: np.ndarray,
    places: np.ndarray,
    blocks: Any,
) -> scipy.sparse.csr_array:
    """Number of rays of each beam of the patches `sources` that end in each beam, (N M, N M)."""
    _, bins, rays, _ = places.shape
    k = int(np.sqrt(bins))
    axes = patches.frames
    u = places[..., :1] - 0.5
    v = places[..., 1:2] - 0.5
    right = patches.right[sources, None, None]
    down = patches.down[sources, None, None]
    centre = patches.centre[sources, None, None]
    origins = (centre + u * right + v * down).reshape(-1, 3)
    directions = brdf.from_square(places[..., 2:])
    directions = directions.reshape(len(sources), -1, 3)
    vectors = (directions @ axes[sources]).reshape(-1, 3)
    hits = cast(walls, origins, vectors, blocks)
    ray = np.flatnonzero(hits.wall >= 0)
    row = np.minimum((hits.v[ray] * n).astype(np.intp), n - 1)
    column = np.minimum((hits.u[ray] * n).astype(np.intp), n - 1)
    target = row * (n * len(walls)) + hits.wall[ray] * n + column
    towards_source = np.einsum("rij,rj->ri", axes[target], -vectors[ray])
    source = sources[ray // (bins * rays)]
    source_beam = source * bins + ray // rays % bins
    target_beam = target * bins + brdf.bins(towards_source, k)
    beams = len(patches) * bins
    entries = (np.ones(len(ray)), (source_beam, target_beam))
    return scipy.sparse.csr_array(entries, shape=(beams, beams))
