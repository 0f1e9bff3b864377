# SPDX-License-Identifier: BSD-3-Clause
"""Results in a notebook: one line of text, and pictures in HTML that show what they are of."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Report, VirtualRig
from ltcl.acquisition.scanning import plans
from ltcl.images.thumbnails import thumbnails

pytestmark = pytest.mark.slow


def decoded(html: str) -> list[np.ndarray]:
    pictures = []
    for part in re.findall(r'src="data:image/png;base64,([^"]+)"', html):
        png = np.frombuffer(base64.b64decode(part), np.uint8)
        pictures.append(np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED)))
    return pictures


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    scene = ltcl.scenes.dihedral(4, albedo=((0.7, 0.5, 0.3),))
    T = scene.transport()
    c = ltcl.compensate(T, np.full((*T.grid, 3), 0.2))
    return {
        "Transport": T,
        "Compensation": c,
        "Separation": ltcl.separate(T, c.appearance, 2),
        "Analysis": ltcl.analyze(T),
        "Solution": ltcl.solve(T.interreflection, np.ones((3, 32, 1)), "monte_carlo", samples=16),
        "Compression": ltcl.compress(T, rtol=0.02).compression,
        "Inverse": ltcl.invert(T, rtol=0.02),
        "Scene": scene,
        "Plan": plans((1080, 1920), (0.5, 8.0), channels=3)["adaptive"],
    }


def test_text_is_one_line(results: dict[str, Any], tmp_path: Path) -> None:
    T = ltcl.scenes.dihedral(4).transport()
    store = tmp_path / "T.zarr"
    ltcl.acquire(VirtualRig(T, T.grid), geometry="aligned", strategy="pixel", store=store)
    for name, result in {**results, "Report": Report.of(store)}.items():
        text = repr(result)
        assert (name in text, "\n" in text, len(text) <= 110) == (True, False, True)


@pytest.mark.parametrize(
    ("name", "count"), [("Transport", 1), ("Compensation", 4), ("Separation", 4), ("Analysis", 0)]
)
def test_html_holds_small_pictures(results: dict[str, Any], name: str, count: int) -> None:
    html = results[name]._repr_html_()
    assert [max(picture.shape[:2]) <= 64 for picture in decoded(html)] == [True] * count
    assert f"&lt;ltcl {name}" in html


def test_pictures_are_encoded_as_light() -> None:
    """White is the 0.99 quantile; colours, frames and large pictures as their means."""
    light = np.full((200, 100, 3), (0.5, 0.25, 0.0))
    nan = np.full((2, 2), np.nan)
    frames = np.stack([np.eye(2), np.ones((2, 2))])
    html = thumbnails("a < b", {"x": light, "frames": frames, "dark": np.zeros((2, 2)), "nan": nan})
    colour, first, *black = decoded(html)
    assert colour.shape == (64, 32, 3)
    np.testing.assert_allclose(colour[5, 5], [0, 188, 255], atol=1)
    np.testing.assert_array_equal(first, [[255, 0], [0, 255]])
    assert not np.any(black)
    assert "a &lt; b" in html
