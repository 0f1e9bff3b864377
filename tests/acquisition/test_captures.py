# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of Gray code taken elsewhere: orders of files, the map, direct light."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ltcl import errors, images
from ltcl.acquisition import PhotographOrder, import_gray_code
from ltcl.acquisition.captures.map_file import read_map, write_map
from ltcl.acquisition.captures.order import ORDERS

GRID = (24, 40)
CAMERA = (60, 96)
DIRECT = 0.5
INDIRECT = 0.2
DARK = 0.02


def opencv_patterns(grid: tuple[int, int]) -> list[np.ndarray]:
    """Patterns of OpenCV, then white and black."""
    height, width = grid
    _, patterns = cv2.structured_light.GrayCodePattern.create(width, height).generate()
    return [*patterns, np.full(grid, 255, np.uint8), np.zeros(grid, np.uint8)]


def true_map(grid: tuple[int, int] = GRID) -> tuple[np.ndarray, np.ndarray]:
    """Column and row of the projector that each camera pixel sees, a little turned."""
    row, column = np.indices(CAMERA, np.float32)
    x = 0.4 * column + 0.02 * row - 0.3
    y = 0.38 * row + 0.01 * column - 0.2
    return x * grid[1] / GRID[1], y * grid[0] / GRID[0]


def photograph(pattern: np.ndarray) -> np.ndarray:
    """Light of the camera: direct, indirect of the mean of the pattern, and ambient."""
    lit = pattern.astype(np.float32) / 255
    x, y = true_map(lit.shape)
    direct = cv2.remap(lit, x, y, cv2.INTER_NEAREST, borderValue=0)
    return DIRECT * direct + INDIRECT * lit.mean() + DARK


def save_all(folder: Path, patterns: Sequence[np.ndarray], names: Sequence[str]) -> None:
    folder.mkdir(exist_ok=True)
    for pattern, name in zip(patterns, names, strict=True):
        images.write(folder / name, photograph(pattern), bits=16)


def error_of(mapping, grid: tuple[int, int] = GRID) -> float:
    x, y = true_map(grid)
    assert mapping.decoded > 0.8
    valid = mapping.valid
    return float(np.hypot(mapping.x - x, mapping.y - y)[valid].mean())


@pytest.fixture(scope="module")
def opencv(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("opencv")
    patterns = opencv_patterns(GRID)
    save_all(folder, patterns, [f"graycode_{k}.png" for k in range(len(patterns))])
    return folder


def test_opencv_order_gives_map_and_direct_light(opencv):
    capture = import_gray_code(opencv, GRID)
    assert error_of(capture.mapping) < 0.2
    assert capture.direct is not None
    inner = capture.direct[3:-3, 3:-3]
    assert capture.seen > 0.9
    # Coarse stripes light a little more or less than half of so small a picture.
    np.testing.assert_allclose(inner[inner > 0], DIRECT, rtol=0.06)
    assert inner[inner > 0].mean() == pytest.approx(DIRECT, rel=0.02)
    assert capture.indirect == pytest.approx(INDIRECT / (DIRECT + INDIRECT), abs=0.03)
    assert capture.saturated == 0.0


def test_map_agrees_with_opencv(opencv):
    mapping = import_gray_code(opencv, GRID).mapping
    height, width = GRID
    code = cv2.structured_light.GrayCodePattern.create(width, height)
    code.setWhiteThreshold(5)
    files = [opencv / f"graycode_{k}.png" for k in range(2 * (6 + 5))]
    pictures: Any = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]
    for row in range(5, 55, 10):
        for column in range(5, 90, 10):
            is_wrong, place = code.getProjPixel(pictures, column, row)
            if not is_wrong and mapping.valid[row, column]:
                assert abs(mapping.x[row, column] - place[0]) <= 1
                assert abs(mapping.y[row, column] - place[1]) <= 1


def centred_patterns(grid: tuple[int, int]) -> list[np.ndarray]:
    """Patterns as scan3d-capture makes them: code of columns plus an offset, equal bits."""
    height, width = grid
    bits = [(side - 1).bit_length() for side in (width, height)]
    patterns = [np.full(grid, 255, np.uint8), np.zeros(grid, np.uint8)]
    for axis, side in enumerate((width, height)):
        number = np.arange(side) + ((1 << bits[axis]) - side) // 2
        gray = number ^ (number >> 1)
        for k in range(min(bits)):
            stripes = np.uint8(255) * ((gray >> (bits[axis] - 1 - k)) & 1).astype(np.uint8)
            stripes = stripes[None, :] if axis == 0 else stripes[:, None]
            pattern = np.broadcast_to(stripes, grid)
            patterns += [pattern, 255 - pattern]
    return patterns


def test_scan3d_order_leaves_finest_columns_out(tmp_path):
    patterns = centred_patterns(GRID)
    assert len(patterns) == 2 + 4 * 5
    save_all(tmp_path, patterns, [f"cam_{k + 1:02}.png" for k in range(len(patterns))])
    capture = import_gray_code(tmp_path, GRID, "scan3d")
    assert error_of(capture.mapping) < 0.5


NAMED = """
columns = "v{n}.png"
columns_inverse = "iv{n}.png"
rows = "h{n}.png"
rows_inverse = "ih{n}.png"
white = "w.png"
black = "b.png"
"""
WITHOUT_INVERSES = """
columns = { name = "gray_h_{n:02}.png", first = 1 }
rows = { name = "gray_v_{n:02}.png", first = 1 }
white = "white.png"
black = "black.png"
coarsest_first = false
"""


def test_names_and_inverses(opencv, tmp_path):
    patterns = opencv_patterns(GRID)
    names = [f"{'i' * k}v{n}.png" for n in range(6) for k in range(2)]
    names += [f"{'i' * k}h{n}.png" for n in range(5) for k in range(2)]
    folder = tmp_path / "photographs"
    save_all(folder, patterns, [*names, "w.png", "b.png"])
    order = tmp_path / "order.toml"
    order.write_text(NAMED)
    mapping = import_gray_code(folder, GRID, order).mapping
    np.testing.assert_array_equal(mapping.x, import_gray_code(opencv, GRID).mapping.x)
    # Without white the map remains.
    order.write_text(NAMED.replace('white = "w.png"\nblack = "b.png"', ""))
    capture = import_gray_code(folder, GRID, order)
    assert capture.direct is None
    assert error_of(capture.mapping) < 0.2


def test_one_polarity_finest_first(tmp_path):
    patterns = opencv_patterns(GRID)
    names = [f"gray_h_{n:02}.png" for n in range(6, 0, -1)]
    names += [f"gray_v_{n:02}.png" for n in range(5, 0, -1)]
    folder = tmp_path / "photographs"
    save_all(folder, patterns[0:22:2] + patterns[-2:], [*names, "white.png", "black.png"])
    order = tmp_path / "order.toml"
    order.write_text(WITHOUT_INVERSES)
    capture = import_gray_code(folder, GRID, order)
    assert error_of(capture.mapping) < 0.3
    assert capture.direct is not None


def test_cells_of_several_pixels(tmp_path):
    patterns = opencv_patterns((12, 20))
    large = [np.kron(pattern, np.ones((2, 2), np.uint8)) for pattern in patterns]
    folder = tmp_path / "photographs"
    save_all(folder, large, [f"{k}.png" for k in range(len(large))])
    order = tmp_path / "order.toml"
    order.write_text(f"{ORDERS['opencv']}cell = 2\n")
    assert error_of(import_gray_code(folder, GRID, order).mapping) < 0.5


def test_map_file(opencv, tmp_path):
    mapping = import_gray_code(opencv, GRID).mapping
    write_map(tmp_path / "map.npz", mapping)
    again = read_map(tmp_path / "map.npz")
    assert again.grid == GRID
    np.testing.assert_array_equal(again.x, mapping.x)
    (tmp_path / "map.npz").write_bytes(b"PK")
    with pytest.raises(errors.FileError, match=r"map.npz: is not a map"):
        read_map(tmp_path / "map.npz")


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ("columns", "not valid TOML"),
        ('rows = "{n}.png"', "has no 'columns'"),
        ('columns = "{n}.png"\nrows = "{n}.png"\ncolor = 1', "has 'color'"),
        ('columns = "1.png"\nrows = "{n}.png"', "name of columns is '1.png'"),
        ('columns = "{n.a}.png"\nrows = "{n}.png"', "name of columns"),
        ('columns = "{n}.png"\nrows = "{n}.png"', "white or black is missing"),
        ('columns = "{n}.png"\nrows = {first = 0, step = 0}', "step of rows is 0"),
        ('columns = "{n}.png"\nrows = {after = "white"}', "after of rows is 'white'"),
        ('columns = "{n}.png"\nrows = "{n}.png"\nrows_inverse = "i{n}.png"', "columns_inverse"),
        ('columns = "{n}.png"\nrows = "{n}.png"\nwhite = true', "white is True"),
        ('columns = "{n}.png"\nrows = "{n}.png"\ncell = 0', "cell is 0"),
        ('columns = 3\nrows = "{n}.png"', "columns is 3"),
    ],
)
def test_bad_orders_are_refused(tmp_path, content, names):
    path = tmp_path / "order.toml"
    path.write_text(content)
    with pytest.raises(errors.InputError, match=names) as error:
        PhotographOrder.read(path)
    assert "order.toml: " in str(error.value)


def test_missing_photographs_are_named(opencv, tmp_path):
    with pytest.raises(errors.FileError, match="24 photographs"):
        import_gray_code(opencv, (200, 300))
    with pytest.raises(errors.FileError, match=r"nowhere: .* opencv and scan3d"):
        import_gray_code(opencv, GRID, "nowhere")
    with pytest.raises(errors.FileError, match="empty: cannot be read"):
        import_gray_code(tmp_path / "empty", GRID)


def test_photographs_too_few_or_too_many_are_told(tmp_path, caplog):
    """One is missing, so that another one would be of two patterns; or the grid is smaller."""
    patterns = opencv_patterns((32, 64))
    names = [f"{k}.png" for k in range(len(patterns))]
    save_all(tmp_path, patterns, names)
    with caplog.at_level("WARNING"):
        import_gray_code(tmp_path, (32, 64))
        assert caplog.text == ""
        import_gray_code(tmp_path, (32, 32))
    assert "2 photographs are of no pattern, the first one 20.png" in caplog.text
    (tmp_path / names[3]).unlink()
    with pytest.raises(errors.FileError, match=r"23 photographs, of which 22\.png .* and of white"):
        import_gray_code(tmp_path, (32, 64))


def test_exchanged_sides_are_refused(tmp_path):
    """48 x 64 pixels have as many stripes as 64 x 48, and numbers that those have not."""
    patterns = opencv_patterns((48, 64))
    save_all(tmp_path, patterns, [f"{k}.png" for k in range(len(patterns))])
    assert error_of(import_gray_code(tmp_path, (48, 64)).mapping, (48, 64)) < 0.5
    with pytest.raises(errors.InputError, match="beyond 64 x 48; grid must be"):
        import_gray_code(tmp_path, (64, 48))
