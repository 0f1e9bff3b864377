# SPDX-License-Identifier: BSD-3-Clause
"""The viewer in Chromium on the same machine: from a pointer or a slider to pixels of the canvas.

T is that of `resolution131k.py`, 256 x 512 pixels in colour, in the numbers that pictures need to 1
%; it takes minutes to make, and is kept in ltcl's cache folder. The small one is made in the same
way, of 48 x 96, more pixels than 64 x 64. Events are sent to the page's own elements; an answer
counts when its canvas is drawn. A film of 30 frames a second is played with a kept inverse.

Chromium is asked by its protocol, for results only: Playwright has it copy each frame of a socket
to its own process, which takes as long as all the rest.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from websockets.sync.client import connect

import _figures as figures
import ltcl
import resolution131k
import video
from _corner import Bounce
from _figures import Claim
from _harness import Options, parse_options
from ltcl.device import tuning
from ltcl.images.frames import open_frames, write_video
from ltcl.scenes import landscape
from ltcl.show.player import Pace, play
from ltcl.show.window import Window
from ltcl.viewer.answers import ViewerScene

FLAGS = ["--headless=new", "--remote-debugging-port=0", "--window-size=1280,900", "--no-sandbox"]
FLAGS += ["--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync"]
FLAGS += ["--disable-component-update", "--disable-gpu", "--enable-unsafe-swiftshader"]
PROBE_MS, PAINT, SLIDE, PLAY, FIRST = (
    60.0,
    25.0,
    30.0,
    24.0,
    3.0,
)  # targets; frames a second, seconds
SMALL_MS, FPS, PATIENCE = 20.0, 30.0, 60.0
MOVES, FRAMES, STARTS = 100, 150, 3
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


class Chromium(contextlib.AbstractContextManager):
    """One page of a browser without a window."""

    def __init__(self) -> None:
        names = ("chromium", "chromium-browser", "google-chrome")
        program = next(filter(None, map(shutil.which, names)), "chromium")
        self._closed = contextlib.ExitStack()
        folder = Path(
            self._closed.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        )
        words = [program, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
        process = subprocess.Popen(words, stderr=subprocess.DEVNULL)  # noqa: S603 - ours
        self._closed.callback(process.wait)
        self._closed.callback(process.terminate)
        end, port = time.monotonic() + PATIENCE, folder / "DevToolsActivePort"
        while not (port.exists() and port.read_text().count("\n")):
            if time.monotonic() > end:
                raise TimeoutError(f"{program} does not start")
            time.sleep(0.05)
        with urllib.request.urlopen(
            f"http://127.0.0.1:{port.read_text().split()[0]}/json/list"
        ) as answer:
            url = next(
                page["webSocketDebuggerUrl"] for page in json.load(answer) if page["type"] == "page"
            )
        self._socket, self._asked = self._closed.enter_context(connect(url, max_size=None)), 0

    def __exit__(self, *_: object) -> None:
        self._closed.close()

    def _ask(self, method: str, **asked: Any) -> dict[str, Any]:
        self._asked += 1
        self._socket.send(json.dumps({"id": self._asked, "method": method, "params": asked}))
        while (found := json.loads(self._socket.recv())).get("id") != self._asked:
            pass
        return found["result"]

    def open(self, url: str) -> None:
        """Go to a page, and wait until it has drawn something and asks nothing any more."""
        self._ask("Page.navigate", url=url)
        if "#" not in url:
            self.wait("#probe-camera-canvas[data-frame]")

    def evaluate(self, function: str, *arguments: Any) -> Any:
        """What a JavaScript function of the page returns, awaited."""
        call = f"({function})({', '.join(map(json.dumps, arguments))})"
        found = self._ask(
            "Runtime.evaluate", expression=call, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in found:
            raise RuntimeError(found["exceptionDetails"])
        return found["result"].get("value")

    def wait(self, *selectors: str) -> None:
        """Until the page has these elements."""
        end = time.monotonic() + PATIENCE
        for selector in selectors:
            while not self.evaluate("(s) => Boolean(document.querySelector(s))", selector):
                if time.monotonic() > end:
                    raise TimeoutError(selector)
                time.sleep(0.01)


def transport(given: Options, n: int) -> ltcl.Transport:
    """T of a corner of n x 2 n pixels, made or kept."""
    file = tuning.make_folder() / f"bench-viewer-{n}.npz"
    if not file.exists() or given.smoke:
        T = resolution131k.build(given, Bounce(n, resolution131k.REFERENCE)).lighter
        if given.smoke:
            return T
        ltcl.save(file, T)
    return ltcl.load(file)


def first_picture(page: Chromium, T: ltcl.Transport, folder: Path) -> float:
    """Seconds from the command until a column of T is drawn."""
    ltcl.save(folder / "T.npz", T)
    begun = time.perf_counter()
    words = [sys.executable, "-m", "ltcl", "view", str(folder / "T.npz"), "--no-browser"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:  # noqa: S603 - ours
        page.open(next(line for line in process.stderr or [] if line.startswith("http")).split()[0])
        spent = time.perf_counter() - begun
        process.terminate()
    return spent


def touch(page: Chromium, T: ltcl.Transport, given: Options) -> tuple[float, float, float, float]:
    """The 95th percentile of ms from pointer to column; frames a second of painting and of sliders.

    And the viewer's own ms of a processor for a column, which other work on the machine hardly
    changes.
    """
    seconds, moves = (0.5, 5) if given.smoke else (5.0, MOVES)
    with ltcl.view(T, {"landscape": landscape(*T.grid)}, open_browser=False) as viewer:
        page.open(viewer.url)
        page.wait("body[data-state=ready]")
        page.evaluate(PROBE, 3)
        begun = time.process_time()
        times = page.evaluate(PROBE, moves)
        busy = 1e3 * (time.process_time() - begun) / moves
        rates = []
        for view, drawn, script in (
            ("relight", "#relight-seen-canvas[data-frame]", PAINTING),
            ("bounces", "#bounces-1", SLIDING),
        ):
            page.evaluate("(view) => document.getElementById(`tab-${view}`).click()", view)
            page.wait(drawn, "body[data-state=ready]")
            rates.append(page.evaluate(script, seconds))
    return float(np.percentile(times, 95)), *rates, busy


def playing(page: Chromium, T: ltcl.Transport, folder: Path, given: Options) -> Pace:
    """What is reached with a film and a kept inverse."""
    frames = (video.TO_LINEAR[codes] for codes in video.film(T, 10 if given.smoke else FRAMES))
    write_video(folder / "film.mkv", frames, FPS)
    rules: Any = {"rtol": video.RTOL, "inverse": ltcl.invert(T, video.RTOL)}
    with Window("film", open_browser=False) as window:
        page.open(f"{window.url}#projector")
        return play(
            ViewerScene(T, "T", {}, None),
            open_frames(folder / "film.mkv"),
            window,
            1.0,
            nothing,
            **rules,
        )


def nothing(*_: Any, **__: Any) -> None:
    """Progress that is not drawn."""


def below(text: str, value: float, most: float, unit: str) -> Claim:
    """The less, the better."""
    return Claim(text, f"{value:.3g} {unit}", f"at most {most:g} {unit}", value <= most)


def rate(text: str, value: float, least: float) -> Claim:
    """Of frames a second: the more, the better."""
    return Claim(text, f"{value:.3g} frames/s", f"at least {least:g} frames/s", value >= least)


def main() -> None:
    given = parse_options(__doc__ or "")
    large, small = (transport(given, n) for n in ((8, 4) if given.smoke else (256, 48)))
    with tempfile.TemporaryDirectory() as name, Chromium() as page:
        probe, painting, sliding, busy = touch(page, large, given)
        small_probe, small_painting, small_sliding, small_busy = touch(page, small, given)
        starts = [
            first_picture(page, large, Path(name)) for _ in range(1 if given.smoke else STARTS)
        ]
        film = playing(page, large, Path(name), given)
    first, often = float(np.median(starts)), 1e3 / SMALL_MS
    size, small_size = ("{} x {}".format(*T.grid) for T in (large, small))
    claims = [
        below(f"probe, 95th percentile, {size}", probe, PROBE_MS, "ms"),
        rate(f"painting, {size}", painting, PAINT),
        rate(f"sliders of bounces, {size}", sliding, SLIDE),
        rate(f"a film of {FPS:g} frames/s, {size}", film.frames_per_second, PLAY),
        below(f"first picture after the command, {size}", first, FIRST, "s"),
        below(f"probe, 95th percentile, {small_size}", small_probe, SMALL_MS, "ms"),
        rate(f"painting, {small_size}", small_painting, often),
        rate(f"sliders of bounces, {small_size}", small_sliding, often),
    ]
    facts = {
        "bytes of T": large.nbytes,
        f"the viewer's ms of a processor for a column, {size}": busy,
        f"the viewer's ms of a processor for a column, {small_size}": small_busy,
        "frames of the film dropped": film.dropped,
        "latency of the film, s": film.latency,
        "load of the machine": os.getloadavg()[0],
    }
    figures.conclude(given, "The viewer in Chromium", [] if given.smoke else claims, facts, Figure)


if __name__ == "__main__":
    main()
