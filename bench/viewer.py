# SPDX-License-Identifier: BSD-3-Clause
"""The viewer in Chromium on the same machine: from a pointer or a slider to pixels of the canvas.

T of 256 x 512 and of 64 x 64 pixels in colour are compressed, as in `video.py`. Events are sent to the page's
own elements; an answer counts when its canvas is drawn. A film of 30 frames a second is played with a kept
inverse.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

import ltcl
import video
from _harness import Options, Row, options, report
from ltcl.images.frames import open_frames, write_video
from ltcl.scenes import landscape
from ltcl.viewer.answers import Scene
from ltcl.viewer.window import Window, play

FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"]
FLAGS += ["--disable-component-update", "--disable-sync", "--disable-gpu", "--enable-unsafe-swiftshader"]
PROBE_MS, PAINT, SLIDE, PLAY, FIRST = 60.0, 25.0, 30.0, 24.0, 3.0  # targets; frames a second, seconds
SMALL_MS, FPS = 20.0, 30.0
MOVES, FRAMES = 100, 150
PROBE = """async (count) => {
  const source = document.getElementById("probe-projector-canvas"), box = source.getBoundingClientRect();
  const target = document.getElementById("probe-camera-canvas"), times = [];
  for (let i = 0; i < count; i++) {
    const begun = performance.now();
    const drawn = new Promise((end) => {
      const observer = new MutationObserver(() => { observer.disconnect(); end(performance.now()); });
      observer.observe(target, { attributes: true, attributeFilter: ["data-frame"] });
    });
    const [x, y] = [(i * 0.37) % 1, (i * 0.61) % 1];
    const place = { clientX: box.left + box.width * x, clientY: box.top + box.height * y };
    source.dispatchEvent(new PointerEvent("pointermove", { ...place, pointerId: 1, bubbles: true }));
    times.push((await drawn) - begun);
    await new Promise((end) => setTimeout(end, 20));
  }
  return times;
}"""
PAINTING = """async (seconds) => {
  const pattern = document.getElementById("relight-pattern-canvas"), box = pattern.getBoundingClientRect();
  const seen = document.getElementById("relight-seen-canvas");
  pattern.setPointerCapture = () => {};
  const point = (kind, x, y) => pattern.dispatchEvent(new PointerEvent(kind, {
    clientX: box.left + box.width * x, clientY: box.top + box.height * y,
    pointerId: 1, button: 0, bubbles: true,
  }));
  const first = Number(seen.dataset.frame), begun = performance.now();
  point("pointerdown", 0.5, 0.5);
  for (let i = 0; performance.now() - begun < 1000 * seconds; i++) {
    point("pointermove", 0.5 + 0.4 * Math.sin(0.11 * i), 0.5 + 0.4 * Math.sin(0.17 * i));
    await new Promise(requestAnimationFrame);
  }
  point("pointerup", 0.5, 0.5);
  return (1000 * (Number(seen.dataset.frame) - first)) / (performance.now() - begun);
}"""
SLIDING = """async (seconds) => {
  const slider = document.getElementById("bounces-1"), mix = document.getElementById("bounces-mix-canvas");
  const first = Number(mix.dataset.frame), begun = performance.now();
  for (let i = 0; performance.now() - begun < 1000 * seconds; i++) {
    slider.value = 1 + 2 * Math.sin(0.1 * i);
    slider.dispatchEvent(new Event("input", { bubbles: true }));
    await new Promise(requestAnimationFrame);
  }
  return (1000 * (Number(mix.dataset.frame) - first)) / (performance.now() - begun);
}"""


def visit(page: Page, view: str) -> None:
    """Open a view, and wait until it shows something and nothing is asked any more."""
    page.locator(f"#tab-{view}").click()
    page.wait_for_selector({"relight": "#relight-seen-canvas[data-frame]", "bounces": "#bounces-1"}[view])
    page.wait_for_selector("body[data-state=ready]")


def first_picture(browser: Browser, T: ltcl.Transport, folder: Path) -> float:
    """Seconds from the command until a column of T is drawn."""
    ltcl.save(folder / "T.npz", T)
    begun = time.perf_counter()
    words = [sys.executable, "-m", "ltcl", "view", str(folder / "T.npz"), "--no-browser"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:  # noqa: S603 - ours
        page = browser.new_page()
        page.goto(next(line for line in process.stderr or [] if line.startswith("http")).split()[0])
        page.wait_for_selector("#probe-camera-canvas[data-frame]")
        spent = time.perf_counter() - begun
        page.close()
        process.terminate()
    return spent


def touch(browser: Browser, T: ltcl.Transport, given: Options) -> tuple[float, float, float]:
    """The 95th percentile of ms from pointer to column; frames a second of painting and of sliders."""
    seconds, moves = (0.5, 5) if given.smoke else (5.0, MOVES)
    with ltcl.view(T, {"landscape": landscape(*T.grid)}, open_browser=False) as viewer:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(viewer.url)
        page.wait_for_selector("#probe-camera-canvas[data-frame]")
        page.wait_for_selector("body[data-state=ready]")
        page.evaluate(PROBE, 3)
        times = page.evaluate(PROBE, moves)
        visit(page, "relight")
        painting = page.evaluate(PAINTING, seconds)
        visit(page, "bounces")
        sliding = page.evaluate(SLIDING, seconds)
        page.close()
    return float(np.percentile(times, 95)), painting, sliding


def playing(browser: Browser, T: ltcl.Transport, folder: Path, given: Options) -> dict[str, Any]:
    """What is reached with a film and a kept inverse."""
    frames = (video.TO_LINEAR[codes] for codes in video.film(T, 10 if given.smoke else FRAMES))
    write_video(folder / "film.mkv", frames, FPS)
    rules: Any = {"rtol": video.RTOL, "inverse": ltcl.invert(T, video.RTOL)}
    with Window("film", open_browser=False) as window:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(window.url)
        facts = play(Scene(T, "T", {}, None), open_frames(folder / "film.mkv"), window, 1.0, nothing, **rules)
        page.close()
    return facts


def nothing(*_: Any, **__: Any) -> None:
    """Progress that is not drawn."""


def rate(question: str, target: float, reached: float) -> Row:
    """Of frames a second: the more, the better."""
    return Row(question, f"{target:g} frames/s", target, reached, "frames/s", reached / target, 1.0)


def main() -> None:
    given = options(__doc__ or "")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    sizes = (
        [((16, 32), (4, 8)), ((16, 16), (4, 8))]
        if given.smoke
        else [((256, 512), (32, 64)), ((64, 64), (16, 16))]
    )
    large, small = (video.transport(given, *each) for each in sizes)
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        probe, painting, sliding = touch(browser, large, given)
        small_probe, small_painting, small_sliding = touch(browser, small, given)
        first, film = first_picture(browser, large, Path(name)), playing(browser, large, Path(name), given)
        browser.close()
    size, small_size = ("{} x {}".format(*T.grid) for T in (large, small))
    often = 1000 / SMALL_MS
    rows = [
        Row.of_times(f"probe, 95th percentile, {size}", "60 ms", PROBE_MS, probe, "ms", 1.0),
        rate(f"painting, {size}", PAINT, painting),
        rate(f"sliders of bounces, {size}", SLIDE, sliding),
        rate(f"a film of {FPS:g} frames/s, {size}", PLAY, film["frames_per_second"]),
        Row.of_times(f"first picture after the command, {size}", "3 s", FIRST, first, "s", 1.0),
        Row.of_times(f"probe, 95th percentile, {small_size}", "20 ms", SMALL_MS, small_probe, "ms", 1.0),
        rate(f"painting, {small_size}", often, small_painting),
        rate(f"sliders of bounces, {small_size}", often, small_sliding),
    ]
    facts = {"frames of the film dropped": film["dropped"], "latency of the film, s": film["latency"]}
    report(given, "The viewer in Chromium", rows, facts)


if __name__ == "__main__":
    main()
