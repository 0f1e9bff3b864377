# SPDX-License-Identifier: BSD-3-Clause
"""Folders as a disk may hold them after a power cut, at any moment of a program that writes.

`Recorder` lists the operations of the program on files: changes of names, contents, flushes, and
what the program says it has committed. `PowerCuts` draws states that POSIX allows after a cut
between two of them. What was flushed is there. Of the rest, each change of names is there or not,
in any order, but for one name in its own; and a file has any of its contents since its last flush,
or the beginning of one, or zeros in its place.

`survey` draws many states, asks for each different one what a program reads in it, and counts those
in which something committed is lost, or something wrong is taken for right.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from ltcl import files

# A folder's number and a name in it.
Place = tuple[int, str]
# Functions of `os` that change names.
RENAMING = ("mkdir", "rmdir", "unlink", "remove", "rename", "replace")


@dataclass(frozen=True)
class Names:
    """Places that got another file or folder, or none, all at once."""

    changes: tuple[tuple[Place, int | None], ...]


@dataclass(frozen=True)
class Content:
    """A file that got other bytes."""

    node: int
    data: bytes


@dataclass(frozen=True)
class Flush:
    """A file or folder that was flushed."""

    node: int


@dataclass(frozen=True)
class Commit:
    """Something that the program says is on the disk from now on."""

    what: Hashable


@dataclass(frozen=True)
class Begin:
    """The beginning of the program; all before it is on the disk."""


Operation = Names | Content | Flush | Commit | Begin


@dataclass(eq=False)
class Recorder:
    """Operations in a folder while the block of `recording` runs, by comparing it with before."""

    root: Path
    operations: list[Operation] = field(default_factory=list)
    places: dict[Place, int] = field(default_factory=dict)
    contents: dict[int, bytes] = field(default_factory=dict)
    # Numbers of files and folders by those of the file system, which uses its numbers again.
    _nodes: dict[int, int] = field(default_factory=dict)
    _count: int = 0
    _lock: Any = field(default_factory=threading.RLock)

    def __post_init__(self) -> None:
        self._node(self.root.stat().st_ino)
        self.observe()
        flushes = [Flush(node) for node in self._nodes.values()]
        self.operations += [*flushes, Begin()]

    def commit(self, what: Hashable) -> None:
        """Note what is committed."""
        with self._lock:
            self.observe()
            self.operations.append(Commit(what))

    def observe(self) -> None:
        """Append what has changed since the last time."""
        with self._lock:
            places: dict[Place, int] = {}
            contents: dict[int, bytes] = {}
            present = {self.root.stat().st_ino}
            self._scan(self.root, 0, places, contents, present)
            self.operations += _changes_of_names(self.places, places)
            for node, data in contents.items():
                if self.contents.get(node) != data:
                    self.operations.append(Content(node, data))
            self.places = places
            self.contents = contents
            for number in self._nodes.keys() - present:
                del self._nodes[number]

    def _scan(
        self,
        folder: Path,
        node: int,
        places: dict[Place, int],
        contents: dict[int, bytes],
        present: set[int],
    ) -> None:
        with contextlib.suppress(FileNotFoundError), os.scandir(folder) as entries:
            for entry in entries:
                number = entry.inode()
                present.add(number)
                inner = self._node(number)
                places[node, entry.name] = inner
                if entry.is_dir(follow_symlinks=False):
                    self._scan(folder / entry.name, inner, places, contents, present)
                else:
                    contents[inner] = (folder / entry.name).read_bytes()

    def _node(self, number: int) -> int:
        if number not in self._nodes:
            self._nodes[number] = self._count
            self._count += 1
        return self._nodes[number]

    def _flushed(self, handle: int) -> None:
        with self._lock:
            self.observe()
            node = self._nodes.get(os.fstat(handle).st_ino)
            if node is not None:
                self.operations.append(Flush(node))

    def _observed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            with self._lock:
                self.observe()
                result = function(*arguments, **options)
                self.observe()
            return result

        return call

    @contextlib.contextmanager
    def recording(self) -> Iterator[None]:
        """Record the block; no flush waits for a disk."""
        with contextlib.ExitStack() as patches:
            for name in RENAMING:
                function = self._observed(getattr(os, name))
                patches.enter_context(mock.patch.object(os, name, function))
            exchange = self._observed(files.exchange)
            patches.enter_context(mock.patch.object(files, "exchange", exchange))
            patches.enter_context(mock.patch.object(os, "fsync", self._flushed))
            yield
        self.observe()


def _changes_of_names(before: Mapping[Place, int], now: Mapping[Place, int]) -> list[Names]:
    """Changes of names, those of a rename or an exchange as one."""
    changed = [place for place in {**before, **now} if before.get(place) != now.get(place)]
    groups: list[tuple[set[int | None], list[Place]]] = []
    for place in changed:
        nodes = {before.get(place), now.get(place)} - {None}
        group_places = [place]
        for group in [group for group in groups if group[0] & nodes]:
            groups.remove(group)
            nodes |= group[0]
            group_places += group[1]
        groups.append((nodes, group_places))
    return [Names(tuple((place, now.get(place)) for place in places)) for _, places in groups]


@dataclass(frozen=True)
class State:
    """A folder after a power cut: bytes of files by their path, None of folders."""

    contents: Mapping[str, bytes | None]
    committed: frozenset[Hashable]

    def write(self, root: Path) -> None:
        """Make the folder."""
        for name in sorted(self.contents):
            data = self.contents[name]
            if data is None:
                (root / name).mkdir()
            else:
                (root / name).write_bytes(data)


class PowerCuts:
    """States of a disk that a power cut leaves of recorded operations."""

    def __init__(self, operations: list[Operation]) -> None:
        self.operations = operations
        # Numbers of files, as opposed to folders.
        self.files = {item.node for item in operations if isinstance(item, Content)}
        self.first = operations.index(Begin()) + 1
        self.durable_after = self._durable_after()

    def _durable_after(self) -> list[float]:
        """Number of operations after which each change of names cannot be lost."""
        durable = [np.inf] * len(self.operations)
        flushed: dict[int, float] = defaultdict(lambda: np.inf)
        places: dict[Place, float] = defaultdict(lambda: np.inf)
        for number in reversed(range(len(self.operations))):
            operation = self.operations[number]
            if isinstance(operation, Flush):
                flushed[operation.node] = number
            elif isinstance(operation, Names):
                folders = {folder for (folder, _), _ in operation.changes}
                after = max(flushed[folder] for folder in folders)
                # A later change of the same name is not there without this one.
                for place, _ in operation.changes:
                    after = min(after, places[place])
                for place, _ in operation.changes:
                    places[place] = after
                durable[number] = after
        return durable

    def draw(self, random: np.random.Generator, *, is_killed: bool = False) -> State:
        """A state after a cut at a random moment, or when the program is killed there."""
        moment = int(random.integers(self.first, len(self.operations) + 1))
        keep = 1.0 if is_killed else random.choice([0.0, 0.5, 0.9, 1.0])
        chances = random.random(moment)
        tree: dict[Place, int] = {}
        lost: set[Place] = set()
        versions: dict[int, list[bytes]] = defaultdict(lambda: [b""])
        committed = []
        for number, operation in enumerate(self.operations[:moment]):
            if isinstance(operation, Content):
                versions[operation.node].append(operation.data)
                if is_killed:
                    versions[operation.node] = [operation.data]
            elif isinstance(operation, Flush):
                versions[operation.node] = versions[operation.node][-1:]
            elif isinstance(operation, Commit):
                committed.append(operation.what)
            elif isinstance(operation, Names):
                is_durable = self.durable_after[number] < moment
                depends_on_lost = any(place in lost for place, _ in operation.changes)
                if not is_durable and (depends_on_lost or chances[number] >= keep):
                    lost.update(place for place, _ in operation.changes)
                    continue
                for place, node in operation.changes:
                    tree.pop(place, None)
                    if node is not None:
                        tree[place] = node
        return State(self._contents(tree, versions, random), frozenset(committed))

    def _contents(
        self, tree: Mapping[Place, int], versions: Mapping[int, list[bytes]], random: Any
    ) -> dict[str, bytes | None]:
        folders: dict[int, list[tuple[str, int]]] = defaultdict(list)
        for (folder, name), node in tree.items():
            folders[folder].append((name, node))
        contents: dict[str, bytes | None] = {}

        def visit(folder: int, prefix: str) -> None:
            for name, node in folders[folder]:
                is_file = node in self.files
                contents[prefix + name] = _version(versions[node], random) if is_file else None
                if not is_file:
                    visit(node, f"{prefix}{name}/")

        visit(0, "")
        return contents


def _version(versions: list[bytes], random: np.random.Generator) -> bytes:
    """One of the contents that a file may have: the first was flushed, the others were not."""
    number = int(random.integers(len(versions)))
    data = versions[number]
    if number == 0 or random.random() < 0.5:
        return data
    cut = int(random.integers(len(data) + 1))
    zeros = bytes(len(data) - cut) if random.random() < 0.5 else b""
    return data[:cut] + zeros


@dataclass(kw_only=True)
class Survey:
    """Counts of states by their outcome, and an example of each that is not right."""

    states: int = 0
    distinct: int = 0
    lost: int = 0
    wrong: int = 0
    resumed: int = 0
    examples: list[str] = field(default_factory=list)


# Judges what is read in a state by what was committed: "lost", "wrong", or "" if it is right.
Judge = Callable[[Any, frozenset[Hashable]], str]


def survey(
    operations: list[Operation],
    read: Callable[[Path], Hashable],
    judge: Judge,
    count: int,
    random: np.random.Generator,
    resume: Callable[[Path], object] | None = None,
    resumed: int = 0,
) -> Survey:
    """Draw states, and judge what `read` says of each; `resume` a few of them to the end."""
    result = Survey(states=count)
    cuts = PowerCuts(operations)
    outcomes: dict[Hashable, Hashable] = {}
    for _ in range(count):
        state = cuts.draw(random)
        key = hash(frozenset(state.contents.items()))
        if key not in outcomes:
            with _folder(state) as folder:
                outcomes[key] = read(folder)
            if resume is not None and result.resumed < resumed:
                with _folder(state) as folder:
                    resume(folder)
                result.resumed += 1
        verdict = judge(outcomes[key], state.committed)
        if verdict:
            setattr(result, verdict, getattr(result, verdict) + 1)
            result.examples.append(f"{verdict}: {outcomes[key]}, {sorted(state.contents)}")
    result.distinct = len(outcomes)
    return result


@contextlib.contextmanager
def _folder(state: State) -> Iterator[Path]:
    memory = Path("/dev/shm")  # noqa: S108 - a folder with a random name in it
    folder = Path(tempfile.mkdtemp(dir=memory if memory.is_dir() else None))
    try:
        state.write(folder)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def total(surveys: Mapping[str, Survey]) -> Counter[str]:
    """Sums over surveys."""
    sums: Counter[str] = Counter()
    for result in surveys.values():
        for name in ("states", "distinct", "lost", "wrong", "resumed"):
            sums[name] += getattr(result, name)
    return sums
