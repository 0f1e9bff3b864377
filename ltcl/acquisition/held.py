# SPDX-License-Identifier: BSD-3-Clause
"""How far T p is from what a known scene shows, for patterns p that no scan has lit.

Patterns of 0 and 1 are the same in codes and in light, whatever the projector's response. With c the scene
under p less that under black, on the pixels of T, without noise,

    off = ||s T p - c|| / ||c||,    s = <T p, c> / ||T p||^2

of all patterns together, for each channel: the unit of light of a camera is not known, so one scale is free.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl.acquisition.setup import Setup
from ltcl.transport import Transport


def off(rig: Any, T: Transport, setup: Setup, count: int = 4) -> tuple[float, ...]:
    """The relative error of T p in each channel.

    Parameters
    ----------
    rig : VirtualRig
        What was photographed, best without its camera_map: on the projector's pixels. Else pictures of its
        camera are resampled, and what these cannot tell apart is not told.
    T : Transport
        As it was found.
    setup : Setup
        Of its store.
    count : int
        Of patterns, each with about half of the pixels on.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> truth = ltcl.scenes.dihedral(4, albedo=0.6).transport()
    >>> rig, store = VirtualRig(truth, truth.grid, bits=12, ambient=0.01), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=store)
    >>> off(rig, T, Setup.of(store))[0] < 0.02
    True
    """
    rng = np.random.default_rng(0)
    dark = rig.radiance(np.zeros(setup.blocks.pixels))
    seen = ~T.masked
    on_grid = setup.mean if rig.camera_grid == rig.projector_grid else setup.resampled
    found, wanted = [], []
    for _ in range(count):
        p = (rng.random(T.grid) < 0.5).astype(np.float32)
        picture = rig.radiance(setup.blocks.enlarged(p)) - dark
        light = p if T.channels == 1 else np.repeat(p[..., None], 3, axis=-1)
        found.append(np.asarray(T @ light, np.float64).reshape(-1, T.channels)[seen])
        wanted.append(on_grid(picture).astype(np.float64).reshape(-1, T.channels)[seen])
    ours, theirs = np.concatenate(found), np.concatenate(wanted)
    return tuple(_relative(ours[:, c], theirs[:, c]) for c in range(T.channels))


def _relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    size = float(ours @ ours)
    scale = float(ours @ theirs) / size if size > 0 else 0.0
    return float(np.linalg.norm(scale * ours - theirs) / np.linalg.norm(theirs))
