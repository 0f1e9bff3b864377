# SPDX-License-Identifier: BSD-3-Clause
"""An acquisition that ends at any line of ltcl loses nothing committed; going on gives the same store.

It ends by SIGKILL and by Ctrl-C. LTCL_KILLS=N in the environment takes N ends of each strategy.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ltcl.acquisition import kept
from ltcl.store import BlockStore
from tests.store.stores import contents

from .stopping import MADE, Nursery

random = np.random.default_rng()
KILLS = int(os.environ.get("LTCL_KILLS", "9"))
STATUS = {"SIGKILL": -signal.SIGKILL, "Ctrl-C": 2}


@pytest.fixture(scope="module")
def nursery() -> Iterator[Nursery]:
    made = Nursery()
    yield made
    made.close()


def committed(path: Path) -> tuple[bool, bool, int]:
    """Whether the calibration and the transport are; photographs of the one or batches of the other."""
    if not path.exists():
        return False, False, kept.count(path)
    store = BlockStore.open(path)
    store.verify()
    begun = "strategy" in store.attributes
    return begun, store.final, 0 if store.final else len(store.written) if begun else kept.count(path)


@pytest.mark.parametrize("strategy", MADE)
def test_ended_and_resumed(tmp_path: Path, nursery: Nursery, strategy: str) -> None:
    """Three ends each, so that all stages are met; then to the end."""
    whole = tmp_path / "whole" / "T.zarr"
    whole.parent.mkdir()
    _, lines, photographs = nursery.acquire(whole, strategy)
    batch = max(16, BlockStore.open(whole).layout.block_rows + 2)
    for number in range(-(-KILLS // 3)):
        path, taken, before = tmp_path / str(number) / "T.zarr", 0, (False, False, 0)
        path.parent.mkdir()
        for line in random.integers(1, lines, 3).tolist():
            end = str(random.choice(list(STATUS)))
            status, _, more = nursery.acquire(path, strategy, line, end)
            assert status in (STATUS[end], 0), (line, end)  # what is resumed has fewer lines
            taken += more
            after = committed(path)
            assert after >= before
            before = after
        status, _, more = nursery.acquire(path, strategy)
        assert status == 0
        assert photographs <= taken + more <= photographs + 3 * (batch + 1)
        assert contents(path) == contents(whole)
        assert os.listdir(path.parent) == ["T.zarr"]
