# SPDX-License-Identifier: BSD-3-Clause
"""Exchange of beams: energy, reciprocity, exact form factors in the limit."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl import checks
from ltcl.errors import InputError, MemoryLimitError
from ltcl.scenes.box import WALLS
from ltcl.scenes.gloss.beams import exchange
from ltcl.scenes.patches import cut
from ltcl.scenes.walls import Wall, form_factors

LONG = Wall("long", corner=(1, 0, 2), right=(-1, 0, 0), down=(0, 0, -2))
WIDE = Wall("wide", corner=(0, 0, 1), right=(0, 3, 0.5), down=(0, 0, -1))


def totals(G, area: np.ndarray) -> np.ndarray:
    """Form factors: means over the bins of both patches."""
    size, bins = len(area), G.shape[0] // len(area)
    return G.toarray().reshape(size, bins, size, bins).sum(axis=(1, 3)) / bins


def test_a_closed_room_keeps_all_light() -> None:
    G = exchange(WALLS, 3, directions=16, rays=32)
    assert G.sum(axis=1) == pytest.approx(1, rel=1e-12)
    assert G.data.min() > 0


@pytest.mark.parametrize(("walls", "n"), [(WALLS, 3), (WALLS[:3], 4), ((LONG, WIDE), 3)])
def test_beams_exchange_the_same_light_both_ways(walls: tuple[Wall, ...], n: int) -> None:
    G = exchange(walls, n, directions=16, rays=64)
    E = np.repeat(cut(walls, n).area, 16)[:, None] * G.toarray()
    assert pytest.approx(E.T, abs=1e-6 * E.max()) == E
    assert G.sum(axis=1).max() <= 1 + 1e-12


def test_patches_of_one_wall_do_not_see_each_other() -> None:
    G = exchange(WALLS[:2], 2, directions=16, rays=16)
    shares = totals(G, cut(WALLS[:2], 2).area).reshape(2, 2, 2, 2, 2, 2)
    assert (shares[:, 0, :, :, 0] == 0).all()
    assert (shares[:, 1, :, :, 1] == 0).all()


def test_means_over_bins_approach_exact_form_factors_as_rays_grow() -> None:
    exact, area = form_factors(WALLS, 4), cut(WALLS, 4).area
    errors = [
        np.linalg.norm(totals(exchange(WALLS, 4, 16, rays), area) - exact) / np.linalg.norm(exact)
        for rays in (16, 64, 256)
    ]
    assert errors[0] > 1.7 * errors[1] > 2.5 * errors[2]  # at least as 1 / sqrt(rays), nearly
    assert errors[2] < 0.025


def test_light_comes_from_the_bin_it_was_sent_to() -> None:
    """Two squares face each other far apart: their light runs in the bins around the normals alone."""
    near = Wall("near", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    far = Wall("far", corner=(0, 0, 5), right=(1, 0, 0), down=(0, 1, 0))
    G = exchange([near, far], 1, directions=64, rays=4096).tocoo()
    middle = {27, 28, 35, 36}
    assert set((G.row % 64).tolist()) == set((G.col % 64).tolist()) == middle
    # Closed form of two unit squares at distance 5 (Howell C-11).
    x, root = 1 / 5, np.sqrt(1 + 1 / 25)
    F = 2 / (np.pi * x**2) * (np.log(root**2 / np.sqrt(1 + 2 * x**2)) + 2 * x * root * np.arctan(x / root))
    F -= 2 / (np.pi * x**2) * 2 * x * np.arctan(x)
    assert G.data.sum() / 64 == pytest.approx(2 * F, rel=0.01)


def test_blocks_keep_light_from_passing() -> None:
    facing = (WALLS[0], WALLS[4])
    assert exchange(facing, 2, 16, 16).sum() > 1
    curtain = [[(-1, 0.4, -1), (2, 0.5, 2)]]
    assert exchange(facing, 2, 16, 16, blocks=curtain).sum() == 0


def test_seed_decides_everything() -> None:
    first, again, other = (exchange(WALLS[:2], 2, 16, 8, seed=seed) for seed in (3, 3, 4))
    assert (first.toarray() == again.toarray()).all()
    assert (first.toarray() != other.toarray()).any()


def test_bad_numbers_are_refused_before_any_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="rays is 0"):
        exchange(WALLS, 2, 16, rays=0)
    with pytest.raises(InputError, match="n is 0"):
        exchange(WALLS, 0, 16, rays=4)
    with pytest.raises(InputError, match="seed is -1"):
        exchange(WALLS, 2, 16, rays=4, seed=-1)
    monkeypatch.setattr(checks, "host_memory", lambda: 1 << 10)
    with pytest.raises(MemoryLimitError, match="exchange of 384 beams by 4 rays each needs"):
        exchange(WALLS, 2, 16, rays=4)
