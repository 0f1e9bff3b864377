# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl show`: what it asks the library for."""

from __future__ import annotations

import pytest

from ltcl.acquisition import rigs


@pytest.mark.parametrize(
    ("options", "display", "advance"),
    [([], 1, "key"), (["--display", "0", "--every", "2"], 0, 2.0), (["--arrival"], 1, "arrival")],
)
def test_how_the_next_pattern_comes(program, monkeypatch, tmp_path, options, display, advance):
    calls = []
    monkeypatch.setattr(
        rigs, "show", lambda *args, **kwargs: calls.append((args, kwargs)) or 3, raising=False
    )
    assert program("show", tmp_path, *options, "--json").json == {"folder": str(tmp_path), "shown": 3}
    ((folder,), settings), *others = calls
    assert (folder, others) == (tmp_path, [])
    assert {name: settings[name] for name in ("display", "advance")} == {
        "display": display,
        "advance": advance,
    }


def test_two_ways_at_once_are_refused(program, tmp_path):
    program("show", tmp_path, "--every", "2", "--arrival").refused("--every is 2", "--arrival")
