# SPDX-License-Identifier: BSD-3-Clause
"""`Progress`: a bar on stderr with elapsed time and time left."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import rich.progress
from rich.console import Console
from rich.progress import (
    BarColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

# Seconds of the past from which the time left is estimated.
ESTIMATE_PERIOD = 300.0
_logger = logging.getLogger(__name__)


class Progress(rich.progress.Progress):
    """`progress(step, done, total)`: a bar on stderr, on a terminal only.

    It runs from the start of a command to its end; without a total it shows that something is
    running.
    """

    def __init__(self, quiet: bool = False) -> None:
        console = Console(stderr=True)
        super().__init__(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
            speed_estimate_period=ESTIMATE_PERIOD,
        )
        self._item = ""
        self._step = ""
        self._solves_begun = 0
        self.add_task("", total=None)

    def __call__(
        self, step: str, done: float = 0, total: float | None = None, *, detail: str = ""
    ) -> None:
        """Show the current step and how much of it is done."""
        if step != self._step:
            _logger.info("%s%s", self._item, step)
        self._step = step
        (task,) = self.tasks
        if task.total != total or done < task.completed:
            # Another quantity is counted now, at another pace.
            self.remove_task(task.id)
            self.add_task("", total=total)
        description = f"{self._item}{step}{detail}"
        self.update(self.task_ids[0], description=description, completed=done)

    @property
    def completed(self) -> float:
        """Amount of the current step that is done."""
        return self.tasks[0].completed

    def each(self, items: Sequence[Any]) -> Iterator[Any]:
        """Yield all items, and show their names before the steps that follow."""
        for number, item in enumerate(items, 1):
            count = ""
            if len(items) > 1:
                count = f"{number}/{len(items)} "
            self._item = f"{count}{item}: "
            self._step = ""
            self._solves_begun = 0
            yield item
        self._item = ""

    def solve(self, rtol: float, solves: int) -> Callable[[int, float], None]:
        """Return a `callback(iteration, residual)` for so many solves of an item.

        It shows the digits gained towards `rtol`.
        """

        def callback(iteration: int, residual: float) -> None:
            if iteration == 0:
                self._solves_begun += 1
            gained = 0.0
            if 0 < residual < 1 and 0 < rtol < 1:
                gained = math.log(residual) / math.log(rtol)
            detail = f": iteration {iteration}"
            if not math.isnan(residual):
                detail += f", relative residual {residual:.1e}"
            done = self._solves_begun - 1 + min(gained, 1.0)
            self("solving", min(done, solves), solves, detail=detail)

        return callback
