# SPDX-License-Identifier: BSD-3-Clause
"""Results in a notebook: one line of text, and pictures in HTML that show what they are of."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import ltcl
from ltcl.acquisition import Report, VirtualRig, forecast_bounces
from ltcl.acquisition.scanning import plans
from ltcl.images.thumbnails import figures


def decoded(html: str) -> list[np.ndarray]:
    parts = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(part)))) for part in parts]


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    scene = ltcl.scenes.dihedral(8, albedo=((0.7, 0.5, 0.3),))
    T = scene.transport()
    c = ltcl.compensate(T, np.full((*T.grid, 3), 0.2))
    sampled = ltcl.solve(T.interreflection, np.ones((3, 128, 1)), "monte_carlo", samples=16)
    return {
        "Transport": T,
        "Compensation": c,
        "Separation": ltcl.separate(T, c.appearance, 2),
        "Analysis": ltcl.analyze(T),
        "Solution": sampled,
        "Compression": ltcl.compress(T, rtol=0.02).compression,
        "Inverse": ltcl.invert(T, rtol=0.02),
        "Scene": scene,
        "Plan": plans((1080, 1920), (0.5, 8.0), channels=3)["adaptive"],
    }


def test_text_is_one_line(results: dict[str, Any], tmp_path: Path) -> None:
    T = ltcl.scenes.dihedral(4).transport()
    ltcl.acquire(VirtualRig(T, T.grid), geometry="aligned", strategy="pixel", store=tmp_path / "T.zarr")
    measured = {
        "Report": Report.of(tmp_path / "T.zarr"),
        "Forecast": forecast_bounces(tmp_path / "T.zarr", np.ones(T.grid), 30, draws=2),
    }
    for name, result in (results | measured).items():
        text = repr(result)
        assert name in text
        assert "\n" not in text
        assert len(text) <= 110, text


@pytest.mark.parametrize(
    ("name", "count"), [("Transport", 1), ("Compensation", 4), ("Separation", 4), ("Analysis", 3)]
)
def test_html_holds_small_pictures(results: dict[str, Any], name: str, count: int) -> None:
    html = results[name]._repr_html_()
    pictures = decoded(html)
    assert len(pictures) == count
    assert f"&lt;ltcl {name}" in html
    for picture in pictures:
        assert max(picture.shape[:2]) <= 64


def test_pictures_are_encoded_as_light() -> None:
    """White is the 0.99 quantile; colours, frames and large pictures as their means."""
    light = np.full((200, 100, 3), (0.5, 0.25, 0.0))
    (colour,) = decoded(figures("a < b", {"x": light}))
    assert colour.shape == (64, 32, 3)
    np.testing.assert_allclose(colour[5, 5], [255, 188, 0], atol=1)
    frames, grey = decoded(figures("", {"frames": np.stack([np.eye(2), np.ones((2, 2))]), "grey": np.eye(2)}))
    np.testing.assert_array_equal(frames, [[255, 0], [0, 255]])
    np.testing.assert_array_equal(grey, frames)
    dark, nan = decoded(figures("", {"dark": np.zeros((2, 2)), "nan": np.full((2, 2), np.nan)}))
    assert not dark.any()
    assert not nan.any()
    assert "a &lt; b" in figures("a < b", {})
