# SPDX-License-Identifier: BSD-3-Clause
"""The viewer's page in Chromium: views by clicks and keys, pixels against Python's results."""

from __future__ import annotations

import re
import socket
import threading
import time
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ltcl
from ltcl.acquisition import FolderRig
from ltcl.acquisition.aiming import read_white
from ltcl.acquisition.projectors import combine_scans
from ltcl.images import to_srgb
from ltcl.images.encoding import to_linear
from ltcl.show.window import Window
from ltcl.viewer import server
from ltcl.viewer.aim import AimScene
from ltcl.viewer.answers import ViewerScene
from ltcl.viewer.scan import Scan
from ltcl.viewer.server import Viewer

pytest.importorskip("playwright", reason='playwright is not installed: pip install "ltcl[test]"')

from playwright.sync_api import Browser, Locator, Page

pytestmark = pytest.mark.slow
PATIENCE = 20.0  # seconds
VIEWS = ("probe", "bounces", "relight", "compensate")
ALBEDO = (0.8, 0.5, 0.3)


@pytest.fixture(scope="module")
def corner() -> ltcl.scenes.Scene:
    return ltcl.scenes.dihedral(6, albedo=ALBEDO)


@pytest.fixture(scope="module")
def T(corner: ltcl.scenes.Scene) -> ltcl.Transport:
    return corner.transport(first_bounce=corner.first_bounce)


@pytest.fixture(scope="module")
def picture(corner: ltcl.scenes.Scene) -> np.ndarray:
    return (0.2 + 0.6 * corner.sample(ltcl.scenes.landscape(60, 60))).astype(np.float32)


@pytest.fixture
def scene(T: ltcl.Transport, picture: np.ndarray) -> ViewerScene:
    return ViewerScene(T, "corner", {"landscape": picture}, None)


@pytest.fixture
def viewer(scene: ViewerScene) -> Iterator[Viewer]:
    with Viewer(scene, open_browser=False) as viewer:
        yield viewer


@pytest.fixture
def page(browser: Browser, viewer: Any) -> Iterator[Page]:
    with browser.new_context(viewport={"width": 1280, "height": 800}) as context:
        page = context.new_page()
        wrong: list[str] = []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on(
            "console",
            lambda message: wrong.append(message.text) if message.type == "error" else None,
        )
        visit(page, viewer, "probe")
        yield page
        assert [text for text in wrong if "400 (Bad Request)" not in text] == []  # a refused upload


def visit(page: Page, viewer: Any, view: str) -> None:
    page.goto("about:blank")
    page.goto(f"{viewer.url}#{view}")
    page.wait_for_selector(".viewer[data-state=ready]")


def pixels(page: Page, name: str) -> tuple[np.ndarray, float]:
    """Return the codes of a canvas, (h, w, 3), and the light that is shown as white."""
    canvas(page, name).wait_for(state="attached")
    codes, shape, white = page.evaluate(
        """(name) => { const c = document.getElementById(name + "-canvas");
        const image = c.getContext("2d").getImageData(0, 0, c.width, c.height);
        return [[...image.data], [c.height, c.width, 4], Number(c.dataset.white ?? 1)]; }""",
        name,
    )
    return np.array(codes, np.float64).reshape(shape)[..., :3], white


def shows(
    page: Page, name: str, light: np.ndarray, *, logarithmic: bool = False, atol: float = 1.01
) -> None:
    """Wait until a canvas has these pixels, to `atol` codes; fail with the difference."""
    light = np.broadcast_to(light if light.ndim == 3 else light[..., None], (*light.shape[:2], 3))
    deadline = time.monotonic() + PATIENCE
    codes: Any = np.inf
    expected = np.zeros(1)
    while time.monotonic() < deadline:
        codes, white = pixels(page, name)
        value = light / white
        if logarithmic:
            expected = 0.75 + np.log10(np.maximum(value, 1e-9)) / 4
        else:
            expected = to_srgb(np.clip(value, 0, 1))
        expected = 255 * np.clip(expected, 0, 1)
        if codes.shape == expected.shape and abs(codes - expected).max() <= atol:
            return
        time.sleep(0.05)
    np.testing.assert_allclose(codes, expected, atol=atol)


def canvas(page: Page, name: str) -> Locator:
    return page.locator(f"#{name}-canvas")


def at(page: Page, name: str, row: int, col: int, grid: tuple[int, int]) -> tuple[float, float]:
    """Return the middle of a pixel of a canvas, on the page."""
    box = canvas(page, name).bounding_box()
    assert box is not None
    height, width = grid
    x = box["x"] + (col + 0.5) / width * box["width"]
    y = box["y"] + (row + 0.5) / height * box["height"]
    return x, y


def unit(grid: tuple[int, int], row: int, col: int) -> np.ndarray:
    light = np.zeros(grid, np.float32)
    light[row, col] = 1.0
    return light


def row_of(T: ltcl.Transport, row: int, col: int) -> np.ndarray:
    """Return the light of each projector pixel in a camera pixel, (h, w, 3)."""
    i = row * T.camera_grid[1] + col
    return np.stack([np.reshape(np.asarray(matrix)[i], T.grid) for matrix in T.matrices], axis=-1)


def painted(page: Page) -> np.ndarray:
    return to_linear(pixels(page, "relight-pattern")[0].astype(np.uint8), "auto")


def test_probe_by_pointer_shows_columns_and_rows(page: Page, T: ltcl.Transport) -> None:
    page.mouse.move(*at(page, "probe-projector", 2, 3, T.grid))
    shows(page, "probe-camera", T @ unit(T.grid, 2, 3))
    assert "row 2, column 3" in page.locator("#probe-projector-values").inner_text()
    page.mouse.down()  # hold
    page.mouse.up()
    page.mouse.move(*at(page, "probe-projector", 5, 9, T.grid))
    page.mouse.move(*at(page, "probe-camera", 1, 1, T.grid))
    shows(page, "probe-camera", T @ unit(T.grid, 2, 3))
    value = float((T @ unit(T.grid, 2, 3))[1, 1, 0])
    shown = page.locator("#probe-camera-values").inner_text()
    assert float(shown.split("R\u00a0")[1].split()[0]) == pytest.approx(value, rel=2e-2)
    page.mouse.down()  # the other way
    page.mouse.up()
    shows(page, "probe-projector", row_of(T, 1, 1))


def test_probe_by_keys(page: Page, T: ltcl.Transport) -> None:
    canvas(page, "probe-projector").focus()
    height, width = T.grid
    row = height // 2
    col = width // 2
    shows(page, "probe-camera", T @ unit(T.grid, row, col))
    for key in ("ArrowDown", "ArrowLeft", "ArrowLeft"):
        page.keyboard.press(key)
    shows(page, "probe-camera", T @ unit(T.grid, row + 1, col - 2))
    page.keyboard.press("Shift+ArrowLeft")  # ten, but not beyond the edge
    shows(page, "probe-camera", T @ unit(T.grid, row + 1, 0))
    page.locator("#probe-back").press("Enter")
    shows(page, "probe-projector", row_of(T, row, col))


def test_display_by_keys_and_clicks(page: Page, T: ltcl.Transport) -> None:
    light = T @ unit(T.grid, T.grid[0] // 2, T.grid[1] // 2)
    shows(page, "probe-camera", light)
    white = pixels(page, "probe-camera")[1]
    page.keyboard.press("+")
    page.locator("#brighter").click()
    shows(page, "probe-camera", light)
    assert pixels(page, "probe-camera")[1] == pytest.approx(white / 2)
    page.keyboard.press("-")
    page.keyboard.press("l")
    shows(page, "probe-camera", light, logarithmic=True)
    assert page.locator("#logarithmic").get_attribute("aria-pressed") == "true"
    page.locator("#logarithmic").click()
    page.locator("#white").click()
    shows(page, "probe-camera", light)
    assert pixels(page, "probe-camera")[1] == pytest.approx(white)
    page.locator("#mode").select_option("heat map")
    heat = pixels(page, "probe-camera")[0]
    brightest = np.unravel_index(light.max(axis=2).argmax(), T.grid)
    assert (heat[brightest] > (230, 240, 120)).all()  # inferno ends in light yellow
    assert (heat[brightest] == heat.reshape(-1, 3).max(axis=0)).all()


def test_zoom_by_wheel_and_buttons_keeps_pixels_under_the_pointer(
    page: Page, T: ltcl.Transport
) -> None:
    box = canvas(page, "probe-projector").bounding_box()
    assert box is not None
    x, y = at(page, "probe-projector", 1, 2, T.grid)
    page.mouse.move(x, y)
    page.mouse.wheel(0, -400)
    deadline = time.monotonic() + PATIENCE
    while canvas(page, "probe-projector").bounding_box()["width"] < 2 * box["width"]:  # pyright: ignore[reportOptionalSubscript]
        assert time.monotonic() < deadline
        time.sleep(0.02)
    there = at(page, "probe-projector", 1, 2, T.grid)
    assert abs(there[0] - x) < 3
    assert abs(there[1] - y) < 3
    for _ in range(4):
        page.locator("#probe-projector .zoom button").first.click()
    assert canvas(page, "probe-projector").bounding_box() == box


def test_bounces_are_mixed_by_sliders(page: Page, T: ltcl.Transport, picture: np.ndarray) -> None:
    page.locator("#tab-bounces").click()
    b = ltcl.separate(T, picture, 4)
    shows(page, "bounces-mix", picture)
    page.locator("#bounces-0").fill("0")
    page.locator("#bounces-1").fill("3")
    light = 3 * b.bounces[0] + b.bounces[1:].sum(axis=0) + b.rest
    shows(page, "bounces-mix", light)
    page.locator("#bounces-2").press("Home")
    shows(page, "bounces-mix", light - 2 * b.bounces[1])
    page.locator("#bounces-reset").click()
    shows(page, "bounces-mix", picture)
    page.locator("#bounces-count").select_option("2")
    page.wait_for_selector("#bounces-4", state="detached")
    page.locator("#bounces-3").fill("0")
    shows(page, "bounces-mix", picture - ltcl.separate(T, picture, 2).rest)
    page.locator("#bounces-source").select_option("what the projector shows now")
    shows(page, "bounces-mix", T @ np.ones(T.grid, np.float32))


@pytest.mark.slow
def test_film_builds_the_picture_bounce_by_bounce(
    page: Page, T: ltcl.Transport, picture: np.ndarray
) -> None:
    page.emulate_media(reduced_motion="reduce")
    page.locator("#tab-bounces").click()
    page.wait_for_selector("#bounces-5")
    page.locator("#bounces-film").click()
    b = ltcl.separate(T, picture, 4)
    shows(page, "bounces-mix", b.direct)
    shows(page, "bounces-mix", b.direct + b.bounces[0])
    page.locator("#bounces-film").click()
    shows(page, "bounces-mix", picture)


def test_uncertainty_is_an_overlay(
    browser: Browser, corner: ltcl.scenes.Scene, picture: np.ndarray
) -> None:
    random = np.random.default_rng(5)
    clean = corner.transport()
    noisy = []
    for matrix in clean.matrices:
        entries = np.asarray(matrix) + 2e-3 * random.standard_normal(clean.shape)
        noisy.append(entries.astype(np.float32))
    T = ltcl.Transport(noisy, grid=corner.grid)
    b = ltcl.separate(T, picture, 1)
    with browser.new_context() as context, ltcl.view(T, picture, open_browser=False) as viewer:
        page = context.new_page()
        visit(page, viewer, "bounces")
        page.locator("#bounces-count").select_option("1")
        page.wait_for_selector("#bounces-3", state="detached")
        page.locator("#bounces-0").fill("0")
        page.locator("#bounces-2").fill("0")
        shows(page, "bounces-mix", b.bounces[0], atol=3)
        plain, white = pixels(page, "bounces-mix")
        page.locator("#bounces-uncertain").check()
        page.wait_for_timeout(200)
        pink = pixels(page, "bounces-mix")[0]
    light = b.bounces[0] / white
    sigma = np.max(b.std.bounces[0] / white, axis=2)
    lowest = light.min(axis=2)
    highest = light.max(axis=2)
    size = np.where(-lowest > highest, lowest, highest)
    strength = 0.9 * np.clip(sigma / np.maximum(abs(size), 1e-4), 0, 1)[..., None]
    assert strength.max() > 0.2
    expected = plain * (1 - strength) + 255 * np.array([1.0, 0.2, 0.75]) * strength
    np.testing.assert_allclose(pink, expected, atol=4)


def test_projectors_stand_side_by_side_with_their_names(
    browser: Browser, room_of_two: Path
) -> None:
    """Two scans combined: a pattern for each, under its name, in all views that show patterns."""
    T = combine_scans([room_of_two / "left.zarr", room_of_two / "right.zarr"])
    y, x = np.mgrid[: T.camera_grid[0], : T.camera_grid[1]]
    desired = (0.12 + 0.05 * np.sin(x / 3) * np.cos(y / 2)).astype(np.float32)
    with browser.new_context(viewport={"width": 1280, "height": 800}) as context:
        page = context.new_page()
        with ltcl.view(T, desired, how="browser", open_browser=False) as viewer:
            visit(page, viewer, "compensate")
            c = ltcl.compensate(T, desired, gain="auto")
            shows(page, "compensate-pattern", c.pattern, atol=2)
            left, right = T.split(c.pattern)
            assert not np.allclose(left, right)
            names = page.locator("#compensate-pattern .names b")
            assert names.all_inner_texts() == ["left", "right"]
            whole = canvas(page, "compensate-pattern").bounding_box()
            assert whole is not None
            for number in range(2):
                part = page.locator("#compensate-pattern .part").nth(number).bounding_box()
                label = names.nth(number).bounding_box()
                assert part is not None
                assert label is not None
                begin = whole["x"] + number / 2 * whole["width"]
                assert part["x"] == pytest.approx(begin, abs=1)
                assert part["width"] == pytest.approx(whole["width"] / 2, abs=1)
                assert label["x"] == pytest.approx(begin, abs=2)
                assert label["y"] + label["height"] <= whole["y"] + 1
            facts = page.locator("#facts").inner_text()
            assert facts.replace("\u00d7", "x").startswith("left 6 x 12, right 6 x 12 projector")
            page.locator("#tab-probe").click()
            page.mouse.move(*at(page, "probe-projector", 3, 12 + 8, T.grid))
            shows(page, "probe-camera", T @ unit(T.grid, 3, 12 + 8))
            assert "right: row 3, column 8" in page.locator("#probe-projector-values").inner_text()
            page.locator("#tab-relight").click()
            assert page.locator("#relight-pattern .names b").all_inner_texts() == ["left", "right"]
            page.locator("#relight-clear").click()
            page.mouse.click(*at(page, "relight-pattern", 2, 5, T.grid))
            shows(page, "relight-seen", T @ painted(page)[..., 0])


def test_painting_relights(page: Page, T: ltcl.Transport) -> None:
    page.locator("#tab-relight").click()
    page.locator("#relight-clear").click()
    page.locator("#relight-colour").fill("#ff8000")
    page.locator("#relight-size").fill("2")
    page.mouse.move(*at(page, "relight-pattern", 1, 1, T.grid))
    page.mouse.down()
    page.mouse.move(*at(page, "relight-pattern", 1, 6, T.grid), steps=8)
    page.mouse.up()
    light = painted(page)
    assert light[1, 3] == pytest.approx(
        to_linear(np.array([255, 128, 0], np.uint8), "auto"), abs=0.02
    )
    assert not light[4:].any()
    shows(page, "relight-seen", T @ light)
    page.locator("#relight-eraser").click()
    page.mouse.move(*at(page, "relight-pattern", 1, 3, T.grid))
    page.mouse.down()
    page.mouse.up()
    assert painted(page)[1, 3].max() < 0.01 < painted(page)[1, 6].max()
    shows(page, "relight-seen", T @ painted(page))
    page.locator("#relight-undo").click()
    np.testing.assert_array_equal(painted(page), light)
    shows(page, "relight-seen", T @ light)
    page.locator("#relight-fill").click()
    shows(page, "relight-seen", T @ np.broadcast_to(light[1, 3], light.shape))


def test_painting_by_keys(page: Page, T: ltcl.Transport) -> None:
    page.locator("#tab-relight").click()
    page.locator("#relight-clear").click()
    page.locator("#relight-size").fill("1")
    canvas(page, "relight-pattern").focus()
    page.keyboard.press("ArrowUp")
    page.keyboard.down(" ")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    page.keyboard.up(" ")
    page.keyboard.press("ArrowDown")
    light = painted(page)
    h, w = T.grid
    assert (light[h // 2 - 1, w // 2 : w // 2 + 3] > 0.5).all()
    assert not light[h // 2 :].any()
    shows(page, "relight-seen", T @ light)


def test_pictures_and_spots_relight(
    page: Page, T: ltcl.Transport, picture: np.ndarray, tmp_path: Path
) -> None:
    page.locator("#tab-relight").click()
    page.locator("#relight-source").select_option("landscape")
    shows(page, "relight-seen", T @ picture)
    ltcl.images.write(tmp_path / "red.png", np.full((6, 12, 3), (1.0, 0.0, 0.0), np.float32))
    page.locator("#relight-file").set_input_files(tmp_path / "red.png")
    shows(page, "relight-seen", T @ np.full((6, 12, 3), (1.0, 0.0, 0.0), np.float32))
    ltcl.images.write(tmp_path / "light.exr", picture)  # no browser reads this: the server does
    page.locator("#relight-file").set_input_files(tmp_path / "light.exr")
    shows(page, "relight-seen", T @ picture)
    page.locator("#relight-spot").click()
    first = painted(page)
    page.wait_for_timeout(400)
    assert not np.array_equal(painted(page), first)
    page.locator("#relight-spot").click()
    shows(page, "relight-seen", T @ painted(page))


@pytest.mark.slow
def test_one_choice_for_pictures_of_other_proportions(
    page: Page, T: ltcl.Transport, tmp_path: Path
) -> None:
    h, w = T.grid
    wide = np.zeros((h, 2 * w, 3), np.float32)
    wide[:, : w // 2] = (0.6, 0.2, 0.1)
    wide[:, w:] = (0.1, 0.3, 0.6)
    ltcl.images.write(tmp_path / "wide.exr", wide)
    page.locator("#tab-relight").click()
    page.locator("#relight-file").set_input_files(tmp_path / "wide.exr")
    shows(page, "relight-seen", T @ wide[:, w // 2 : w // 2 + w])
    page.locator("#relight-resize").select_option("letterbox")
    shows(page, "relight-seen", T @ ltcl.images.resize(wide, T.grid, "letterbox"))
    page.locator("#tab-compensate").click()
    page.locator("#compensate-source").select_option("wide.exr")
    page.locator("#compensate-auto").uncheck()
    page.locator("#compensate-gain").fill("1")
    shows(page, "compensate-target", ltcl.images.resize(wide, T.grid, "letterbox"))
    page.locator("#compensate-resize").select_option("stretch")
    shows(page, "compensate-target", ltcl.images.resize(wide, T.grid, "stretch"))
    page.locator("#tab-bounces").click()
    page.locator("#bounces-source").select_option("wide.exr")
    shows(page, "bounces-mix", ltcl.images.resize(wide, T.grid, "stretch"))


@pytest.mark.slow
def test_a_video_relights_as_it_plays(page: Page, T: ltcl.Transport, tmp_path: Path) -> None:
    film = cv2.VideoWriter(str(tmp_path / "v.webm"), cv2.VideoWriter.fourcc(*"VP80"), 10, (96, 48))
    for k in range(20):  # red moves to the right
        frame = np.zeros((48, 96, 3), np.uint8)
        frame[:, 9 * (k // 2) : 9 * (k // 2) + 9, 2] = 255
        film.write(frame)
    film.release()
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    page.locator("#tab-relight").click()
    page.locator("#relight-file").set_input_files(tmp_path / "v.webm")
    seen: set[int] = set()
    deadline = time.monotonic() + PATIENCE
    while len(seen) < 4:
        assert time.monotonic() < deadline
        light = painted(page)
        if light[..., 0].max() > 0.5:
            seen.add(int(light[3, :, 0].argmax()))
    page.locator("#relight-file").set_input_files(tmp_path / "broken.mp4")
    page.locator("#banner").get_by_text("broken.mp4: ").wait_for()
    shows(page, "relight-seen", T @ painted(page))
    settle(page)
    assert page.locator("#banner").is_visible()  # what was still under way leaves it there


class Late:
    """The first answer of a kind waits for `come`; `asked` is set when it has been computed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, scene: ViewerScene, do: str) -> None:
        self.come = threading.Event()
        self.asked = threading.Event()
        self._do = do
        self._answer = scene.answer
        monkeypatch.setattr(scene, "answer", self)

    def __call__(self, do: str, asked: dict[str, Any], callback: Any) -> Any:
        reply = self._answer(do, asked, lambda *_: None)
        if do == self._do and not self.asked.is_set():
            self.asked.set()
            assert self.come.wait(PATIENCE)
        return reply


def settle(page: Page) -> None:
    """Wait until all questions are answered, and no answer has led to another question."""
    page.wait_for_timeout(300)
    page.wait_for_selector(".viewer[data-state=ready]")


@pytest.mark.slow
def test_a_late_pattern_of_the_server_replaces_nothing(
    page: Page,
    scene: ViewerScene,
    T: ltcl.Transport,
    picture: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    late = Late(monkeypatch, scene, "relight")
    page.locator("#tab-relight").click()
    assert late.asked.wait(PATIENCE)
    page.locator("#relight-source").select_option("landscape")
    late.come.set()
    shows(page, "relight-seen", T @ picture)
    settle(page)
    shows(page, "relight-seen", T @ picture)
    np.testing.assert_allclose(scene.pattern, picture, atol=1e-6)

    white = np.ones(T.grid, np.float32)
    scene.pattern = white
    page.locator("#tab-probe").click()
    settle(page)
    late = Late(monkeypatch, scene, "relight")
    page.locator("#tab-relight").click()
    assert late.asked.wait(PATIENCE)
    page.locator("#tab-probe").click()  # where nothing is to be painted
    late.come.set()
    settle(page)
    assert scene.pattern is white
    late = Late(monkeypatch, scene, "relight")
    page.locator("#tab-relight").click()
    assert late.asked.wait(PATIENCE)
    page.locator("#relight-colour").fill("#00ff00")
    page.locator("#relight-fill").click()
    late.come.set()
    green = np.full((*T.grid, 3), (0.0, 1.0, 0.0), np.float32)
    shows(page, "relight-seen", T @ green)
    settle(page)
    np.testing.assert_array_equal(painted(page), green)
    np.testing.assert_allclose(scene.pattern, green)


def test_late_bounces_leave_newer_sliders(
    page: Page,
    scene: ViewerScene,
    T: ltcl.Transport,
    picture: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    page.locator("#tab-bounces").click()
    shows(page, "bounces-mix", picture)
    late = Late(monkeypatch, scene, "bounces")
    page.locator("#tab-probe").click()
    page.locator("#tab-bounces").click()
    assert late.asked.wait(PATIENCE)
    page.locator("#bounces-0").fill("0")
    late.come.set()
    settle(page)
    shows(page, "bounces-mix", picture - ltcl.separate(T, picture, 4).direct)
    assert page.locator("#bounces-0").input_value() == "0"


def test_late_compensation_is_not_that_of_another_picture(
    browser: Browser, T: ltcl.Transport, picture: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    dim = 0.5 * picture[::-1]
    scene = ViewerScene(T, "corner", {"bright": picture, "dim": dim}, None)
    late = Late(monkeypatch, scene, "compensate")
    with browser.new_context() as context, Viewer(scene, open_browser=False) as viewer:
        page = context.new_page()
        page.goto(f"{viewer.url}#compensate")
        assert late.asked.wait(PATIENCE)
        page.evaluate(
            """() => {
              const target = document.getElementById("compensate-target-canvas");
              window.drawn = 0;
              new MutationObserver(() => { window.drawn++; })
                .observe(target, { attributes: true, attributeFilter: ["data-frame"] });
            }"""
        )
        page.locator("#compensate-source").select_option("dim")
        late.come.set()
        shows(page, "compensate-target", ltcl.compensate(T, dim, gain="auto").target)
        assert page.evaluate("window.drawn") == 1


def test_compensation(page: Page, T: ltcl.Transport, picture: np.ndarray, tmp_path: Path) -> None:
    page.locator("#tab-compensate").click()
    c = ltcl.compensate(T, picture, gain="auto")
    shows(page, "compensate-pattern", c.pattern)
    shows(page, "compensate-target", c.target)
    _h, w = T.grid
    plain = T @ picture
    plain *= c.target.mean() / plain.mean()
    wiped = np.concatenate([plain[:, : w // 2], c.appearance[:, w // 2 :]], axis=1)
    shows(page, "compensate-wipe", wiped)
    canvas(page, "compensate-wipe").focus()
    page.keyboard.press("ArrowRight")
    page.mouse.move(*at(page, "compensate-wipe", 0, 0, T.grid))
    page.mouse.down()
    page.mouse.move(*at(page, "compensate-wipe", 2, w - 1, T.grid))
    page.mouse.up()
    shows(page, "compensate-wipe", np.concatenate([plain[:, :-1], c.appearance[:, -1:]], axis=1))
    report = page.locator("#compensate-report").inner_text()
    assert ("below 0.001 %" if c.error < 1e-5 else f"{100 * c.error:#.3g} %") in report
    assert f"{c.gain:#.3g}" in report
    page.locator("#compensate-auto").uncheck()
    page.locator("#compensate-gain").fill("0.3")
    shows(page, "compensate-pattern", ltcl.compensate(T, picture, gain=0.3).pattern)
    # While the slider moves, times of frames are told.
    page.locator("#compensate-gain").evaluate(
        "slider => { slider.value = 0.4; slider.dispatchEvent(new Event('input')); }"
    )
    times = page.locator("#compensate-wipe .note", has_text="99 % of frames")
    times.wait_for()
    told = re.search(r"99 % of frames within ([\d.e+]+) ms$", times.inner_text())
    assert told is not None
    assert float(told[1]) > 0.0
    page.locator("#compensate-gain").fill("0.3")
    page.locator("#compensate-high").fill("0.5")
    dim = ltcl.compensate(T, picture, gain=0.3, bounds=(0, 0.5))
    shows(page, "compensate-pattern", dim.pattern)
    with page.expect_download() as download:
        page.locator("#compensate-downloads button").first.click()
    download.value.save_as(tmp_path / "pattern.exr")
    np.testing.assert_allclose(ltcl.images.read(tmp_path / "pattern.exr"), dim.pattern, atol=2e-3)


def test_dropped_picture_is_compensated(page: Page, T: ltcl.Transport) -> None:
    page.locator("#tab-compensate").click()
    page.wait_for_selector("#compensate-more:not([hidden])")
    data = page.evaluate_handle(
        """async () => { const c = new OffscreenCanvas(12, 6), x = c.getContext("2d");
        x.fillStyle = "#808080"; x.fillRect(0, 0, 12, 6);
        const transfer = new DataTransfer();
        transfer.items.add(new File([await c.convertToBlob()], "grey.png", { type: "image/png" }));
        return transfer; }"""
    )
    canvas(page, "compensate-wipe").dispatch_event("drop", {"dataTransfer": data})
    grey = to_linear(np.full((6, 12, 3), 128, np.uint8), "auto")
    shows(page, "compensate-pattern", ltcl.compensate(T, grey, gain="auto").pattern)
    assert page.locator("#compensate-source option:checked").inner_text() == "grey.png"


def test_projector_window_shows_what_is_painted(page: Page, T: ltcl.Transport) -> None:
    with page.expect_popup() as popup:
        page.locator("#open-projector").click()
    window = popup.value
    window.wait_for_selector("body[data-state=ready]")
    page.locator("#tab-relight").click()
    page.locator("#relight-clear").click()
    page.locator("#relight-colour").fill("#3060c0")
    page.locator("#relight-fill").click()
    deadline = time.monotonic() + PATIENCE
    codes: list[int] = []
    while time.monotonic() < deadline and codes[:3] != [0x30, 0x60, 0xC0]:
        codes = window.evaluate(
            "[...document.getElementById('show').getContext('2d').getImageData(3, 2, 1, 1).data]"
        )
        time.sleep(0.05)
    assert codes == [0x30, 0x60, 0xC0, 255]
    box = window.locator("#show").bounding_box()
    assert box is not None
    h, w = T.grid
    assert box["width"] / w == box["height"] / h == int(box["width"] / w)  # whole pixels
    assert (
        window.locator("#show").evaluate("c => getComputedStyle(c).imageRendering") == "pixelated"
    )


def test_reload_and_resize_keep_the_view(
    page: Page, T: ltcl.Transport, picture: np.ndarray
) -> None:
    page.locator("#tab-bounces").click()
    shows(page, "bounces-mix", picture)
    page.reload()
    shows(page, "bounces-mix", picture)
    wide = canvas(page, "bounces-mix").bounding_box()
    page.set_viewport_size({"width": 900, "height": 600})
    shows(page, "bounces-mix", picture)
    narrow = canvas(page, "bounces-mix").bounding_box()
    assert wide is not None
    assert narrow is not None
    assert narrow["width"] < wide["width"]
    assert narrow["width"] / narrow["height"] == pytest.approx(T.grid[1] / T.grid[0], rel=0.02)
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.slow
def test_server_is_killed_and_started_again(
    browser: Browser, T: ltcl.Transport, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with browser.new_context() as context, ltcl.view(T, open_browser=False, port=port) as viewer:
        page = context.new_page()
        visit(page, viewer, "relight")
        viewer.close()
        page.wait_for_selector(".viewer[data-state=lost]")
        assert "trying again" in page.locator("#banner").inner_text()
        with ltcl.view(T, open_browser=False, port=port):
            page.wait_for_selector(".viewer[data-state=ready]")
            assert page.locator("#banner").is_hidden()
            page.locator("#relight-fill").click()
            shows(page, "relight-seen", T @ np.ones(T.grid, np.float32))
        page.wait_for_selector(".viewer[data-state=lost]")
        (tmp_path / f"viewer-{port}").unlink()
        with ltcl.view(T, open_browser=False, port=port):
            page.get_by_text("another address").wait_for()


def test_a_page_too_many_is_told_so_and_comes_in_later(
    page: Page, viewer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "MAX_PAGES", 1)
    second_page = page.context.new_page()
    second_page.goto(viewer.url)
    second_page.get_by_text("1 pages are open here").wait_for()
    page.goto("about:blank")
    second_page.wait_for_selector(".viewer[data-state=ready]")
    assert second_page.locator("#banner").is_hidden()


@pytest.mark.slow
def test_an_acquisition_as_it_grows(page: Page, tmp_path: Path) -> None:
    text = '[rig]\nkind = "folder"\nprojector_grid = [4, 6]\n[acquire]\ngeometry = "aligned"\n'
    (tmp_path / "acquisition.toml").write_text(text)
    rig = FolderRig(tmp_path, (4, 6))
    codes = np.arange(240, dtype=np.uint8).reshape(12, 20)
    rig.prepare([(np.ones((4, 6)), 0.5), (np.zeros((4, 6)), 0.5)])
    first, second = (tmp_path / f"{shot.save_as}.png" for shot in rig.shots)
    ltcl.images.write(first, codes / 255, encoding="linear", bits=8)
    with Viewer(Scan(tmp_path, None), open_browser=False) as viewer:
        visit(page, viewer, "scan")
        page.get_by_text("photograph 1, 0.500 s").first.wait_for()
        assert page.locator("#tabs button:visible").all_inner_texts() == ["Scan"]
        assert page.locator("#open-projector").is_hidden()
        assert "1 of about" in page.locator("#scan-facts").inner_text()
        shown = page.evaluate(
            """() => { const c = document.querySelector(".photograph canvas");
            return [...c.getContext("2d").getImageData(0, 0, c.width, c.height).data]; }"""
        )
        np.testing.assert_array_equal(np.reshape(shown, (*codes.shape, 4))[..., 1], codes)
        assert (
            str(page.locator("#scan-histogram polyline").get_attribute("points")).count(",") == 32
        )
        assert page.locator("#scan-warnings li").count() == 0
        second.write_bytes(b"no picture")
        page.locator("#scan-warnings li").get_by_text("photograph 2").wait_for()
        page.goto("about:blank")


def test_aiming_shows_readings_as_they_come(page: Page) -> None:
    scene = AimScene("corner")
    white = np.zeros((40, 60), np.float32)
    white[5:35, 5:55] = 1.0
    with Viewer(scene, open_browser=False) as viewer:
        visit(page, viewer, "scan")
        page.get_by_text("no photograph yet").first.wait_for()
        scene.add_reading("look 1", read_white(white, 0.5))
        page.locator("#scan-warnings li").get_by_text("expose shorter").wait_for()
        scene.add_reading("look 2", read_white(0.5 * white, 0.25))
        page.get_by_text("look 2, 0.250 s").first.wait_for()
        page.get_by_text("brightness 50%").first.wait_for()
        assert page.locator("#scan-warnings li").count() == 0
        assert page.locator(".photograph").count() == 2
        page.goto("about:blank")


def test_projector_window_shows_patterns_next_by_key(page: Page) -> None:
    patterns = [np.eye(4, 6), np.full((4, 6), 0.6)]
    with Window("patterns", open_browser=False) as window:
        page.goto(window.url)
        shower = threading.Thread(target=lambda: [window.show(pattern) for pattern in patterns])
        shower.start()
        shower.join(PATIENCE)
        window.wait(PATIENCE)
        pixels = page.evaluate(
            """() => { const c = document.getElementById("show");
            return [...c.getContext("2d").getImageData(0, 0, c.width, c.height).data]; }"""
        )
        np.testing.assert_array_equal(
            np.reshape(pixels, (4, 6, 4))[..., 0], np.rint(255 * patterns[-1])
        )
        assert not window.key_pressed()
        for key in ("Space", "ArrowRight", "PageDown"):
            page.keyboard.press(key)
            deadline = time.monotonic() + PATIENCE
            while not window.key_pressed():
                assert time.monotonic() < deadline
                time.sleep(0.02)
        page.keyboard.press("x")
        page.goto("about:blank")
        assert not window.key_pressed()


def test_two_pages_at_once(page: Page, viewer: Any, T: ltcl.Transport) -> None:
    second_page = page.context.new_page()
    visit(second_page, viewer, "probe")
    for k in range(4):
        page.mouse.move(*at(page, "probe-projector", k, 2, T.grid))
        second_page.mouse.move(*at(second_page, "probe-projector", k, 7, T.grid))
    shows(page, "probe-camera", T @ unit(T.grid, 3, 2))
    shows(second_page, "probe-camera", T @ unit(T.grid, 3, 7))


def test_rectangular_transport_has_no_bounces(browser: Browser) -> None:
    random = np.random.default_rng(3)
    T = ltcl.Transport(
        random.random((5 * 8, 4 * 6), dtype=np.float32), grid=(4, 6), camera_grid=(5, 8)
    )
    picture = (T @ np.full(T.grid, 0.5, np.float32)).astype(np.float32)
    with browser.new_context() as context, ltcl.view(T, picture, open_browser=False) as viewer:
        page = context.new_page()
        visit(page, viewer, "bounces")
        assert page.locator("#tab-probe").get_attribute("aria-selected") == "true"
        assert page.locator("#tab-bounces").is_disabled()
        page.mouse.move(*at(page, "probe-projector", 3, 1, T.grid))
        shows(page, "probe-camera", T @ unit(T.grid, 3, 1))
        page.locator("#probe-back").click()
        page.mouse.move(*at(page, "probe-camera", 4, 7, T.camera_grid))
        shows(page, "probe-projector", np.asarray(T.matrices[0][4 * 8 + 7]).reshape(T.grid))
        page.locator("#tab-compensate").click()
        shows(page, "compensate-pattern", ltcl.compensate(T, picture, gain="auto").pattern)


def test_grey_transport(browser: Browser) -> None:
    T = ltcl.scenes.dihedral(5, albedo=0.6).transport()
    with browser.new_context() as context, ltcl.view(T, open_browser=False) as viewer:
        page = context.new_page()
        visit(page, viewer, "relight")
        shows(page, "relight-seen", T @ painted(page))
        assert np.ptp(pixels(page, "relight-seen")[0], axis=2).max() == 0
        page.locator("#relight-colour").fill("#ff0000")
        page.locator("#relight-fill").click()
        shows(page, "relight-seen", T @ np.full((*T.grid, 3), (1.0, 0.0, 0.0), np.float32))


def test_bad_file_is_refused_in_words(page: Page, tmp_path: Path) -> None:
    page.locator("#tab-compensate").click()
    page.wait_for_selector("#compensate-more:not([hidden])")
    (tmp_path / "broken.png").write_bytes(b"no picture")
    page.locator("#compensate-file").set_input_files(tmp_path / "broken.png")
    page.get_by_text("broken.png: ").wait_for()


def test_tabs_by_keys(page: Page) -> None:
    page.locator("#tab-probe").focus()
    for view in (*VIEWS[1:], "probe"):
        page.keyboard.press("ArrowRight")
        page.wait_for_selector(f"#view-{view}:not([hidden])")
        assert page.locator("[role=tab][aria-selected=true]").get_attribute("id") == f"tab-{view}"


@pytest.mark.slow
def test_phone(browser: Browser, viewer: Any) -> None:
    with browser.new_context(
        viewport={"width": 360, "height": 740}, has_touch=True, is_mobile=True
    ) as context:
        page = context.new_page()
        for view in VIEWS:
            visit(page, viewer, view)
            assert page.evaluate("document.documentElement.scrollWidth") == 360
        visit(page, viewer, "probe")
        over = canvas(page, "probe-projector").bounding_box()
        under = canvas(page, "probe-camera").bounding_box()
        assert over is not None
        assert under is not None
        assert over["width"] > 320
        assert under["y"] >= over["y"] + over["height"]
        canvas(page, "probe-projector").tap(position={"x": 5, "y": 5})
        page.get_by_text("row 0, column 0").first.wait_for()


@pytest.mark.rare
@pytest.mark.parametrize("width", [1280, 360])
def test_nothing_serious_stands_in_the_way_of_access(
    browser: Browser, viewer: Any, width: int
) -> None:
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason='pip install "ltcl[test]"'
    ).Axe()
    with browser.new_context(
        viewport={"width": width, "height": 800}, reduced_motion="reduce"
    ) as context:
        page = context.new_page()
        for view in VIEWS:
            visit(page, viewer, view)
            page.wait_for_selector(".viewer[data-state=ready]")
            violations = axe.run(page).response["violations"]
            assert [
                each["id"] for each in violations if each["impact"] in ("serious", "critical")
            ] == [], view
        page.goto(f"{viewer.url}projector")
        page.wait_for_selector("body[data-state=ready]")
        violations = axe.run(page).response["violations"]
        assert [
            each["id"] for each in violations if each["impact"] in ("serious", "critical")
        ] == []


def test_the_file_that_the_browser_is_given_leads_to_the_page(
    browser: Browser, T: ltcl.Transport, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments: list[str] = []
    monkeypatch.setattr(webbrowser, "open", arguments.append)
    with ltcl.view(T) as viewer:
        page = browser.new_page()
        page.goto(arguments[0])
        page.wait_for_url(f"{viewer.url}**")
        page.wait_for_selector(".viewer[data-state=ready]")
        page.close()
