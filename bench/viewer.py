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

import base64
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
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
from ltcl import Transport
from ltcl.device import tuning
from ltcl.images.frames import open_frames, write_video
from ltcl.scenes import landscape
from ltcl.show.player import Pace, play
from ltcl.show.window import Window
from ltcl.viewer.answers import ViewerScene

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new",
    "--remote-debugging-port=0",
    "--window-size=1280,900",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-sync",
    "--disable-component-update",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
)
# Seconds that the browser may take to start, and a page to show an element.
TIMEOUT = 60.0

# Largest milliseconds of the probe, least frames a second, largest seconds of the first picture.
PROBE_MS = 60.0
SMALL_PROBE_MS = 20.0
PAINTING_RATE = 25.0
SLIDER_RATE = 30.0
FILM_RATE = 24.0
SMALL_RATE = 1e3 / SMALL_PROBE_MS
FIRST_PICTURE_SECONDS = 3.0

FILM_FPS = 30.0

# Milliseconds from each of `count` movements over the projector's picture to a column of T.
PROBE = """async (count) => {
  const source = document.getElementById("probe-projector-canvas");
  const box = source.getBoundingClientRect();
  const target = document.getElementById("probe-camera-canvas");
  const times = [];
  for (let i = 0; i < count; i++) {
    const begun = performance.now();
    const drawn = new Promise((end) => {
      const observer = new MutationObserver(() => {
        observer.disconnect();
        end(performance.now());
      });
      observer.observe(target, { attributes: true, attributeFilter: ["data-frame"] });
    });
    const [x, y] = [(i * 0.37) % 1, (i * 0.61) % 1];
    source.dispatchEvent(new PointerEvent("pointermove", {
      clientX: box.left + box.width * x,
      clientY: box.top + box.height * y,
      pointerId: 1,
      bubbles: true,
    }));
    times.push((await drawn) - begun);
    await new Promise((end) => setTimeout(end, 20));
  }
  return times;
}"""
# Frames a second while a pattern is painted.
PAINTING = """async (seconds) => {
  const pattern = document.getElementById("relight-pattern-canvas");
  const box = pattern.getBoundingClientRect();
  const seen = document.getElementById("relight-seen-canvas");
  pattern.setPointerCapture = () => {};
  const point = (kind, x, y) => pattern.dispatchEvent(new PointerEvent(kind, {
    clientX: box.left + box.width * x,
    clientY: box.top + box.height * y,
    pointerId: 1,
    button: 0,
    bubbles: true,
  }));
  const first = Number(seen.dataset.frame);
  const begun = performance.now();
  point("pointerdown", 0.5, 0.5);
  for (let i = 0; performance.now() - begun < 1000 * seconds; i++) {
    point("pointermove", 0.5 + 0.4 * Math.sin(0.11 * i), 0.5 + 0.4 * Math.sin(0.17 * i));
    await new Promise(requestAnimationFrame);
  }
  point("pointerup", 0.5, 0.5);
  const frames = Number(seen.dataset.frame) - first;
  return (1000 * frames) / (performance.now() - begun);
}"""
# Frames a second while a slider of bounces moves.
SLIDING = """async (seconds) => {
  const slider = document.getElementById("bounces-1");
  const mix = document.getElementById("bounces-mix-canvas");
  const first = Number(mix.dataset.frame);
  const begun = performance.now();
  for (let i = 0; performance.now() - begun < 1000 * seconds; i++) {
    slider.value = 1 + 2 * Math.sin(0.1 * i);
    slider.dispatchEvent(new Event("input", { bubbles: true }));
    await new Promise(requestAnimationFrame);
  }
  const frames = Number(mix.dataset.frame) - first;
  return (1000 * frames) / (performance.now() - begun);
}"""
OPEN_TAB = "(view) => document.getElementById(`tab-${view}`).click()"
HAS_ELEMENT = "(selector) => Boolean(document.querySelector(selector))"


@dataclass(frozen=True, kw_only=True)
class Workload:
    """Patches along a wall of both transports, and the amount of each measurement."""

    large: int = 256
    small: int = 48
    moves: int = 100
    touch_seconds: float = 5.0
    film_frames: int = 150
    starts: int = 3


SMOKE_WORKLOAD = Workload(large=8, small=4, moves=5, touch_seconds=0.5, film_frames=10, starts=1)


def wait_until(condition: Callable[[], bool], message: str, pause: float) -> None:
    """Check a condition until it holds, or raise TimeoutError."""
    end = time.monotonic() + TIMEOUT
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(message)
        time.sleep(pause)


def find_browser() -> str:
    """The installed browser; if there is none, the name that the error then shows."""
    for name in BROWSERS:
        program = shutil.which(name)
        if program is not None:
            return program
    return "chromium"


class Chromium(contextlib.AbstractContextManager):
    """A page of a browser without a window."""

    def __init__(self) -> None:
        self._resources = contextlib.ExitStack()
        temporary = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        folder = Path(self._resources.enter_context(temporary))
        self._start(folder)
        url = self._page_url(folder)
        self._socket = self._resources.enter_context(connect(url, max_size=None))
        self._requests = 0

    def _start(self, folder: Path) -> None:
        """Start the browser, which is ended with the other resources."""
        program = find_browser()
        command = [program, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)  # noqa: S603 - ours
        self._resources.callback(process.wait)
        self._resources.callback(process.terminate)
        port = folder / "DevToolsActivePort"

        def has_started() -> bool:
            return port.exists() and "\n" in port.read_text()

        wait_until(has_started, f"{program} does not start", 0.05)

    def _page_url(self, folder: Path) -> str:
        """The socket of the browser's page."""
        port = (folder / "DevToolsActivePort").read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            targets = json.load(answer)
        pages = [target for target in targets if target["type"] == "page"]
        return pages[0]["webSocketDebuggerUrl"]

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    def _request(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a request of the protocol and wait for its answer; events between are dropped."""
        self._requests += 1
        number = self._requests
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv())
            if answer.get("id") == number:
                return answer["result"]

    def open(self, url: str) -> None:
        """Go to a page, and wait until it has drawn something and needs nothing more."""
        self._request("Page.navigate", url=url)
        if "#" not in url:
            self.wait("#probe-camera-canvas[data-frame]")

    def resize(self, width: int, height: int) -> None:
        """Give the page another size, in pixels."""
        self._request(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def screenshot(self, quality: int) -> bytes:
        """A JPEG file of the page."""
        answer = self._request("Page.captureScreenshot", format="jpeg", quality=quality)
        return base64.b64decode(answer["data"])

    def evaluate(self, function: str, *arguments: Any) -> Any:
        """The awaited result of a JavaScript function in the page."""
        values = ", ".join(map(json.dumps, arguments))
        call = f"({function})({values})"
        answer = self._request(
            "Runtime.evaluate", expression=call, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in answer:
            raise RuntimeError(answer["exceptionDetails"])
        return answer["result"].get("value")

    def wait(self, *selectors: str) -> None:
        """Wait until the page has these elements."""
        for selector in selectors:
            has_element = partial(self.evaluate, HAS_ELEMENT, selector)
            wait_until(has_element, selector, 0.01)


def transport(options: Options, n: int) -> Transport:
    """T of a corner of n x 2 n pixels, made, or kept from an earlier run."""
    if options.smoke:
        return make_transport(options, n)
    file = tuning.make_folder() / f"bench-viewer-{n}.npz"
    if not file.exists():
        ltcl.save(file, make_transport(options, n))
    return ltcl.load(file)


def make_transport(options: Options, n: int) -> Transport:
    rows = Bounce(n, resolution131k.REFERENCE)
    return resolution131k.build(options, rows).lighter


def first_picture(page: Chromium, T: Transport, folder: Path) -> float:
    """Seconds from the command until a column of T is drawn."""
    file = folder / "T.npz"
    ltcl.save(file, T)
    start = time.perf_counter()
    command = [sys.executable, "-m", "ltcl", "view", str(file), "--no-browser"]
    with subprocess.Popen(  # noqa: S603 - ours
        command, stderr=subprocess.PIPE, text=True
    ) as process:
        page.open(printed_url(process))
        spent = time.perf_counter() - start
        process.terminate()
    return spent


def printed_url(process: subprocess.Popen[str]) -> str:
    """The address that the viewer prints when it serves."""
    for line in process.stderr or []:
        if line.startswith("http"):
            return line.split()[0]
    raise SystemExit("the viewer ended without an address")


@dataclass(frozen=True, kw_only=True)
class Touch:
    """Answers of the viewer to a hand.

    The 95th percentile of milliseconds from pointer to column; frames a second of painting and of
    sliders; and the viewer's own milliseconds of a processor for a column, which other work on the
    machine hardly changes.
    """

    probe_ms: float
    painting_rate: float
    slider_rate: float
    column_cpu_ms: float


def touch(page: Chromium, T: Transport, workload: Workload) -> Touch:
    """Move pointer and sliders in the viewer."""
    moves = workload.moves

    def measure_rate(view: str, drawn: str, script: str) -> float:
        page.evaluate(OPEN_TAB, view)
        page.wait(drawn, ".viewer[data-state=ready]")
        return page.evaluate(script, workload.touch_seconds)

    with ltcl.view(T, {"landscape": landscape(*T.grid)}, open_browser=False) as viewer:
        page.open(viewer.url)
        page.wait(".viewer[data-state=ready]")
        # Warms up.
        page.evaluate(PROBE, 3)
        start = time.process_time()
        times = page.evaluate(PROBE, moves)
        cpu_ms = 1e3 * (time.process_time() - start) / moves
        return Touch(
            probe_ms=float(np.percentile(times, 95)),
            painting_rate=measure_rate("relight", "#relight-seen-canvas[data-frame]", PAINTING),
            slider_rate=measure_rate("bounces", "#bounces-1", SLIDING),
            column_cpu_ms=cpu_ms,
        )


def play_film(page: Chromium, T: Transport, folder: Path, frame_count: int) -> Pace:
    """The pace of a film with a kept inverse."""
    film = folder / "film.mkv"
    codes = video.film(T, frame_count)
    frames = (video.TO_LINEAR[frame] for frame in codes)
    write_video(film, frames, FILM_FPS)
    rules: Any = {"rtol": video.RTOL, "inverse": ltcl.invert(T, video.RTOL)}
    scene = ViewerScene(T, "T", {}, None)
    with Window("film", open_browser=False) as window:
        page.open(f"{window.url}#projector")
        return play(scene, open_frames(film), window, 1.0, ignore_progress, **rules)


def ignore_progress(*_: Any, **__: Any) -> None:
    """Draw no progress."""


def at_most(text: str, value: float, most: float, unit: str) -> Claim:
    limit = f"at most {most:g} {unit}"
    return Claim(text, f"{value:.3g} {unit}", limit, value <= most)


def at_least(text: str, rate: float, least: float) -> Claim:
    limit = f"at least {least:g} frames/s"
    return Claim(text, f"{rate:.3g} frames/s", limit, rate >= least)


def format_grid(T: Transport) -> str:
    h, w = T.grid
    return f"{h} x {w}"


def main() -> None:
    options = parse_options(__doc__)
    workload = SMOKE_WORKLOAD if options.smoke else Workload()
    large = transport(options, workload.large)
    small = transport(options, workload.small)
    with tempfile.TemporaryDirectory() as name, Chromium() as page:
        folder = Path(name)
        large_touch = touch(page, large, workload)
        small_touch = touch(page, small, workload)
        first_seconds = []
        for _ in range(workload.starts):
            first_seconds.append(first_picture(page, large, folder))
        film = play_film(page, large, folder, workload.film_frames)
    size = format_grid(large)
    small_size = format_grid(small)
    film_text = f"a film of {FILM_FPS:g} frames/s, {size}"
    first_text = f"first picture after the command, {size}"
    percentile = "probe, 95th percentile"
    claims = [
        at_most(f"{percentile}, {size}", large_touch.probe_ms, PROBE_MS, "ms"),
        at_least(f"painting, {size}", large_touch.painting_rate, PAINTING_RATE),
        at_least(f"sliders of bounces, {size}", large_touch.slider_rate, SLIDER_RATE),
        at_least(film_text, film.frames_per_second, FILM_RATE),
        at_most(first_text, float(np.median(first_seconds)), FIRST_PICTURE_SECONDS, "s"),
        at_most(f"{percentile}, {small_size}", small_touch.probe_ms, SMALL_PROBE_MS, "ms"),
        at_least(f"painting, {small_size}", small_touch.painting_rate, SMALL_RATE),
        at_least(f"sliders of bounces, {small_size}", small_touch.slider_rate, SMALL_RATE),
    ]
    cpu_text = "the viewer's ms of a processor for a column"
    facts = {
        "bytes of T": large.nbytes,
        f"{cpu_text}, {size}": large_touch.column_cpu_ms,
        f"{cpu_text}, {small_size}": small_touch.column_cpu_ms,
        "frames of the film dropped": film.dropped,
        "latency of the film, s": film.latency,
        "load of the machine": os.getloadavg()[0],
    }
    if options.smoke:
        claims = []
    figures.conclude(options, "The viewer in Chromium", claims, facts, Figure)


if __name__ == "__main__":
    main()
