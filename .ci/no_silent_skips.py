# SPDX-License-Identifier: BSD-3-Clause
"""Pytest plugin of CI: a skipped test fails, and so does a run in which no test meets a device.

Failures are named as they happen: a run that is ended has said what failed.

One reason to skip is accepted: that the folder `../shared/data` is absent, which holds captures
that are not part of the project. Expected failures (`xfail`) are no skips.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

DATA = "../shared/data"
data_absent = not (Path(__file__).resolve().parents[2] / "shared" / "data").is_dir()


def _refuse_skip(report: pytest.TestReport | pytest.CollectReport) -> None:
    if not report.skipped or hasattr(report, "wasxfail"):
        return
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    if DATA in reason and data_absent:
        return
    report.outcome = "failed"
    report.longrepr = f"unexpected skip, as CI accepts none but for an absent {DATA}: {reason}"


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Turn the skip of a test into a failure."""
    report = yield
    _refuse_skip(report)
    return report


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Turn the skip of a whole module into a failure."""
    report = yield
    _refuse_skip(report)
    return report


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Name what failed at once, in the process that collects reports."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        print(f"\nFAILED {report.nodeid} ({report.when})", file=sys.stderr, flush=True)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Refuse a run without a test of the `device` fixture, which fails if there is no device."""
    fixtures: set[Any] = set().union(*(getattr(item, "fixturenames", ()) for item in session.items))
    if "device" not in fixtures:
        raise pytest.UsageError(
            "no test asks for the `device` fixture: the kernels would go untested"
        )
