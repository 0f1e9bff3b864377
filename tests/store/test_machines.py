# SPDX-License-Identifier: BSD-3-Clause
"""Lives of a store, a scan and a film: written, killed, cut off, damaged, converted, resumed.

Hypothesis chooses the steps. A step that is killed or cut off leaves the
folder in one of the states of `power_cuts`.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Hashable
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

import ltcl
from ltcl.errors import AcquisitionError, FileError, LtclError
from ltcl.store import ArrayLog, BlockStore, formats
from tests.acquisition.stopping import set_up
from tests.store import power_cut_works as works
from tests.store import stores
from tests.store.power_cuts import PowerCuts, Recorder

ENDS = st.sampled_from(["whole", "killed", "power cut"])
SEEDS = st.integers(0, 2**32 - 1)
BLOCKS = st.integers(0, 3)
PLACES = st.integers(0, 2**20)


class Folder(RuleBasedStateMachine):
    """A folder in which programs end early."""

    def __init__(self) -> None:
        super().__init__()
        self.root = Path(tempfile.mkdtemp())

    def teardown(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.root)

    def work(
        self, act: Callable[[Callable[[Hashable], None]], object], end: str, seed: int
    ) -> frozenset[Hashable]:
        """Act in the folder, as far as it comes; return what it has committed until then."""
        recorder = Recorder(self.root)
        with recorder.recording():
            act(recorder.commit)
            recorder.commit("whole")
        if end == "whole":
            return frozenset({"whole"})
        random = np.random.default_rng(seed)
        state = PowerCuts(recorder.operations).draw(random, is_killed=end == "killed")
        for place in self.root.iterdir():
            if place.is_dir():
                shutil.rmtree(place)
            else:
                place.unlink()
        state.write(self.root)
        return state.committed

    def flip(self, folder: Path, place: int, unused: str = "") -> tuple[Path, bytes]:
        """Flip a bit in a file of a folder; return the file, and its bytes before.

        Temporaries that a program has left count for nothing, nor do files in folders `unused`.
        """
        unused_files = set(folder.glob(f"{unused}/**/*")) if unused else set()
        files = [file for file in sorted(folder.rglob("[!.]*")) if file.is_file()]
        files = [file for file in files if file not in unused_files]
        file = files[place % len(files)]
        good = file.read_bytes()
        bad = bytearray(good)
        bad[place % len(good)] ^= 1 << place % 8
        file.write_bytes(bad)
        return file, good


def columns(store: BlockStore, block: int, seed: int) -> Any:
    """Columns of a transport of any values."""
    T = stores.transport(12, 12) * np.float32(1 + seed % 7)
    return stores.batch(store, T, block)


class StoreLife(Folder):
    """A store of four batches; `seeds` are those of the batches that are committed."""

    @initialize()
    def create(self) -> None:
        """Begin."""
        self.path = self.root / "T.zarr"
        stores.make(self.path, shape=(12, 12), camera_grid=None)
        self.seeds: dict[int, int] = {}
        self.steps = 0
        self.is_final = False

    @precondition(lambda self: not self.is_final)
    @rule(block=BLOCKS, seed=SEEDS, end=ENDS)
    def write(self, block: int, seed: int, end: str) -> None:
        """Write a batch: it is there, or what was there before."""
        store = BlockStore.open(self.path)
        matrix = columns(store, block, seed)
        committed = self.work(lambda commit: store.write(0, block, matrix), end, seed)
        store = BlockStore.open(self.path)
        if (0, block) not in store.written:
            assert "whole" not in committed
            assert block not in self.seeds
            return
        is_new = not (store.block(0, block).matrix != matrix).nnz
        assert is_new or ("whole" not in committed and block in self.seeds)
        if is_new:
            self.seeds[block] = seed

    @precondition(lambda self: not self.is_final)
    @rule(seed=SEEDS, end=ENDS)
    def update(self, seed: int, end: str) -> None:
        """Count a step."""
        store = BlockStore.open(self.path)
        committed = self.work(lambda commit: store.update(steps=self.steps + 1), end, seed)
        steps = BlockStore.open(self.path).attributes.get("steps", 0)
        assert self.steps + ("whole" in committed) <= steps <= self.steps + 1
        self.steps = steps

    @precondition(lambda self: len(self.seeds) == 4 and not self.is_final)
    @rule(seed=SEEDS, end=ENDS)
    def finalize(self, seed: int, end: str) -> None:
        """Turn columns into rows, as far as it comes."""
        store = BlockStore.open(self.path)
        committed = self.work(lambda commit: store.finalize(), end, seed)
        self.is_final = BlockStore.open(self.path).final
        assert self.is_final or "whole" not in committed

    @precondition(lambda self: self.is_final)
    @rule(extension=st.sampled_from([".npz", ".h5", ".mat", ".zarr", ".mtx"]), end=ENDS, seed=SEEDS)
    def convert(self, extension: str, end: str, seed: int) -> None:
        """Write it as a file of another format, and read that."""
        place = self.root / f"converted{extension}"
        committed = self.work(
            lambda commit: formats.write(place, formats.read(self.path)), end, seed
        )
        if place.exists():
            record: Any = formats.read(place)
            (matrix,) = record.in_memory().matrices
            T = stores.rows(BlockStore.open(self.path))
            np.testing.assert_array_equal(matrix.toarray().astype(np.float32), T)
        assert place.exists() or "whole" not in committed

    @rule(place=PLACES)
    def damage(self, place: int) -> None:
        """Any flipped bit is noticed."""
        # Rows of a finalize that was cut off are written again.
        unused = "" if self.is_final else "channel_*"
        file, good = self.flip(self.path, place, unused)
        with pytest.raises(FileError):
            BlockStore.open(self.path).verify()
        file.write_bytes(good)

    @invariant()
    def all_is_there(self) -> None:
        """Nothing that was committed is lost."""
        store = BlockStore.open(self.path)
        store.verify()
        assert store.final == self.is_final
        for block, seed in self.seeds.items():
            if not store.final:
                matrix = store.block(0, block).matrix
                assert not (matrix != columns(store, block, seed)).nnz
                continue
            first, stop = store.layout.span(block, "columns")
            T = stores.rows(store)[:, first:stop]
            np.testing.assert_array_equal(T.T, columns(store, block, seed).toarray())


@cache
def undisturbed_scan() -> works.Work:
    """A scan that nothing stops, and how to judge others."""
    return works.acquisition("pixel")


class ScanLife(Folder):
    """A scan by a rig that is unplugged, in a store that is damaged and resumed."""

    @rule(left=st.integers(1, 90), end=ENDS, seed=SEEDS)
    def scan(self, left: int, end: str, seed: int) -> None:
        """Go on for so many photographs, as far as it comes."""
        scan = undisturbed_scan()
        put = ArrayLog.put
        before = scan.read(self.root)

        def act(commit: Callable[[Hashable], None]) -> None:
            def put_and_commit(log: ArrayLog, name: str, **arrays: Any) -> None:
                put(log, name, **arrays)
                commit((log.path.name, name))

            rig, options = set_up("pixel", left=left)
            with mock.patch.object(ArrayLog, "put", put_and_commit):
                try:
                    ltcl.acquire(rig, store=self.root / "T.zarr", **options)
                except AcquisitionError as error:
                    assert "unplugged" in str(error)  # noqa: PT017 - or it ends well

        committed = self.work(act, end, seed) - {"whole"}
        outcome: Any = scan.read(self.root)
        assert scan.judge(outcome, committed) == ""
        if isinstance(before, tuple) and outcome[0] == before[0]:
            assert before[1] <= outcome[1]

    @rule(place=PLACES)
    def damage(self, place: int) -> None:
        """A flipped bit is noticed."""
        path = self.root / "T.zarr"
        if not path.exists():
            return
        file, good = self.flip(path, place)
        with pytest.raises(LtclError):
            BlockStore.open(path).verify()
        file.write_bytes(good)

    def teardown(self) -> None:
        """Resumed to the end, all files are those of a scan that nothing stopped."""
        resume = undisturbed_scan().resume
        assert resume is not None
        resume(self.root)
        super().teardown()


class FilmLife(Folder):
    """Patterns for a film, by runs that end, whose files are damaged."""

    @initialize()
    def begin(self) -> None:
        """Write the film."""
        (self.root / "film").mkdir()
        random = np.random.default_rng(3)
        for number in range(works.FRAMES):
            picture = random.uniform(0.1, 0.3, works.GRID).astype(np.float32)
            ltcl.images.write(self.root / f"film/{number}.exr", picture)
        self.pictures = sorted((self.root / "film").iterdir())
        self.T = works.transport(1.0, is_sparse=False)
        self.done = 0

    def run_on(self, frames: int | None = None, commit: Any = None) -> ltcl.batch.CompensatedFrames:
        """Go on with the film."""
        return ltcl.batch.compensate_frames(
            self.T,
            self.root / "film",
            self.root / "out",
            batch=2,
            frames=frames,
            resume=True,
            progress=None if commit is None else lambda step, done, count: commit(done),
        )

    @rule(frames=st.integers(1, works.FRAMES), end=ENDS, seed=SEEDS)
    def run(self, frames: int, end: str, seed: int) -> None:
        """Go on with so many frames, as far as it comes."""
        committed = self.work(lambda commit: self.run_on(frames, commit), end, seed)
        counts: Any = committed - {"whole"}
        self.done = frames if "whole" in committed else max(counts, default=0)

    @rule(place=PLACES, how=st.sampled_from(["flip", "empty", "cut", "remove"]))
    def damage(self, place: int, how: str) -> None:
        """Damage a pattern."""
        patterns = sorted((self.root / "out").glob("pattern_*.png"))
        if not patterns:
            return
        pattern = patterns[place % len(patterns)]
        data = pattern.read_bytes()
        if how == "flip":
            changed = bytearray(data)
            changed[place % len(data)] ^= 1
            pattern.write_bytes(changed)
        elif how == "remove":
            pattern.unlink()
        else:
            pattern.write_bytes(data[: len(data) // 2 if how == "cut" else 0])

    @rule(share=st.floats(0.0, 0.99))
    def damage_list(self, share: float) -> None:
        """A list of frames that is cut off is refused."""
        listed = self.root / "out/frames.json"
        if not listed.exists():
            return
        good = listed.read_bytes()
        listed.write_bytes(good[: int(share * len(good.rstrip()))])
        with pytest.raises(FileError):
            self.run_on()
        listed.write_bytes(good)

    def teardown(self) -> None:
        """Resumed to the end, all patterns give their frames."""
        result = self.run_on()
        assert len(result.records) == works.FRAMES
        assert result.worst.error < 1e-3
        for number, file in enumerate(self.pictures, start=1):
            pattern = ltcl.images.read(self.root / f"out/pattern_{number:06}.png")
            picture = ltcl.images.read(file)
            np.testing.assert_allclose(self.T @ pattern, picture, atol=1e-3)
        again = self.run_on()
        assert again.solved == 0
        super().teardown()


@pytest.mark.parametrize(
    ("life", "examples", "steps"),
    [
        pytest.param(StoreLife, 8, 10),
        pytest.param(StoreLife, 60, 20, marks=pytest.mark.slow),
        pytest.param(ScanLife, 6, 6, marks=pytest.mark.slow),
        pytest.param(FilmLife, 20, 8, marks=pytest.mark.slow),
    ],
)
def test_life(life: type[Folder], examples: int, steps: int) -> None:
    run_state_machine_as_test(
        life,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            database=None,
            # To shorten what fails takes minutes.
            phases=[Phase.generate],
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
        ),
    )
