# SPDX-License-Identifier: BSD-3-Clause
"""What patterns tell of the projector coordinates that each camera pixel sees, before it is cleaned."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError


@dataclass(frozen=True)
class Edges:
    """Where stripes end between camera pixels, (H, W) each.

    Attributes
    ----------
    place : (H, W) int32
        The whole number that the brighter pictures tell, however faintly.
    right, below : (H, W) float32
        Where the number differs by 1 between a pixel and its neighbour: the fraction in [0, 1] of the way at
        which it changes; NaN elsewhere.
    """

    place: np.ndarray
    right: np.ndarray
    below: np.ndarray


@dataclass(frozen=True)
class Axis:
    """One projector coordinate of every camera pixel, (H, W) float32 each.

    Attributes
    ----------
    value : (H, W)
        Projector pixels; pixel centres are at integers. It is the middle of the interval that is known.
    width : (H, W)
        Length of that interval in projector pixels: 1 where every bit is certain, 2 on an edge between two
        stripes, more where low bits are undecided, infinite where nothing is known.
    confidence : (H, W)
        In [0, 1]: the part of the direct light by which the weakest bit differs from its inverse; of a phase,
        1 without noise and 0 where its deviation is a twelfth of a period.
    edges : Edges, optional
    weight : float
        Of a value beside an edge, in least squares: a whole number has variance 1/12, an edge is known to
        about 0.04; half of what follows, as whole numbers in one cell are not off independently.
    """

    value: np.ndarray
    width: np.ndarray
    confidence: np.ndarray
    edges: Edges | None = None
    weight: float = 0.01


def photographs(name: str, images: Sequence[Any], count: int) -> list[np.ndarray]:
    """Return `count` photographs of one size as (H, W) arrays; colour is averaged, bytes stay bytes.

    Raises
    ------
    InputError
        Another number, no picture, mixed sizes, NaN.

    >>> photographs("photographs", [np.zeros((2, 3)), np.zeros((3, 2))], 2)
    Traceback (most recent call last):
    ltcl.errors.InputError: photographs[1] has shape (3, 2); it must be (2, 3), as photographs[0]
    """
    if len(images) != count:
        raise InputError(f"{name} are {len(images)}; they must be {count}, one for each pattern")
    found: list[np.ndarray] = []
    for number, image in enumerate(images):
        label = f"{name}[{number}]"
        array = checks.finite(label, checks.real(label, image))
        if array.ndim not in (2, 3) or array.shape[2:] not in ((), (1,), (3,)) or array.size == 0:
            raise InputError(f"{label} has shape {array.shape}; it must be (H, W) or (H, W, 3)")
        if array.ndim == 3:
            array = array.mean(axis=2, dtype=np.float32)
        if found and array.shape != found[0].shape:
            first = f"{found[0].shape}, as {name}[0]"
            raise InputError(f"{label} has shape {array.shape}; it must be {first}")
        found.append(array)
    return found


def side(n: int) -> int:
    """Bits that tell n places apart.

    >>> [side(n) for n in (1, 2, 3, 64, 65)]
    [0, 1, 2, 6, 7]
    """
    return (n - 1).bit_length()


def strips(H: int, rows: int, work: Callable[[slice], None]) -> None:
    """Do `work` on slices of at most `rows` (at least one) of H rows, side by side.

    >>> found = []
    >>> strips(5, 3, found.append)
    >>> sorted(found, key=lambda part: part.start)
    [slice(0, 3, None), slice(3, 5, None)]
    """
    parts = [slice(top, min(top + max(rows, 1), H)) for top in range(0, H, max(rows, 1))]
    with ThreadPoolExecutor(min(os.cpu_count() or 1, len(parts))) as pool:
        list(pool.map(work, parts))
