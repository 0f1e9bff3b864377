# SPDX-License-Identifier: BSD-3-Clause
"""Acquisitions as they grow, patterns and films in a projector window, and the token of a port."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

import ltcl
from ltcl import errors, images
from ltcl.acquisition import FolderRig, Project, rigs
from ltcl.acquisition.agreement import CameraModel
from ltcl.acquisition.radiometry import Radiance, Response
from ltcl.cli.main import main
from ltcl.device import tuning
from ltcl.images.frames import open_frames, write_video
from ltcl.show.player import play
from ltcl.show.window import Window
from ltcl.viewer.answers import ViewerScene
from ltcl.viewer.scan import Scan
from ltcl.viewer.server import Viewer
from tests import json_schema
from tests.viewer.page import Page

PATIENCE = 30.0  # seconds
BY_HAND = '[rig]\nkind = "folder"\nprojector_grid = [4, 6]\n[acquire]\ngeometry = "aligned"\n'
VIRTUAL = (
    '[rig]\nkind = "virtual"\ntransport = "T.npz"\n'
    '[acquire]\ngeometry = "aligned"\nstrategy = "pixel"\n'
)
random = np.random.default_rng(0)


def project(folder: Path, text: str) -> Project:
    (folder / "acquisition.toml").write_text(text)
    return Project.open(folder)


def news(page: Page, seen: int = 0, count: int = 0, **expected: Any) -> dict[str, Any]:
    """Ask again until the answer has these facts, and `count` photographs and warnings."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        facts = page.ask("scan", seen=seen)
        if (
            facts.items() >= expected.items()
            and len(facts["photographs"] + facts["warnings"]) >= count
        ):
            return facts
        time.sleep(0.1)
    raise AssertionError(f"nothing with {expected}")


def test_photographs_come_with_histograms_and_warnings(tmp_path: Path) -> None:
    project(tmp_path, BY_HAND)
    rig = FolderRig(tmp_path, (4, 6))
    white = np.ones((4, 6))
    rig.prepare([(white, 0.5), (white, 1.0), (0 * white, 0.5)])
    codes = random.integers(0, 256, (20, 30), dtype=np.uint8)
    files = [tmp_path / f"{shot.save_as}.png" for shot in rig.shots]
    images.write(files[0], codes / 255, encoding="linear", bits=8)
    files[1].write_bytes(b"no picture")
    with Viewer(Scan(tmp_path, None), open_browser=False) as viewer, Page(viewer.url) as page:
        facts = {"do": "hello", "title": tmp_path.name, "grid": None, "scan": True, "next": False}
        assert page.hello == facts
        first = news(page, 0, 2, state="new", done=2)
        np.testing.assert_array_equal(first["0"][..., 0], codes)
        shares, _ = np.histogram(codes / np.float32(255), 32, (0, 1))
        (photograph,) = first["photographs"]
        np.testing.assert_allclose(photograph["histogram"], shares / codes.size, atol=1e-6)
        assert (photograph["name"], photograph["seconds"]) == ("photograph 1", 0.5)
        (warning,) = first["warnings"]
        assert "photograph 2" in warning
        time.sleep(0.01)
        images.write(files[1], codes / 255, encoding="linear", bits=8)  # taken again
        images.write(files[2], np.zeros((20, 31)), encoding="linear", bits=8)  # of another size
        second = news(page, first["seen"], 2, done=3)
        assert {each["name"] for each in second["photographs"]} == {"photograph 2"}
        (warning,) = second["warnings"]
        assert "photograph 3" in warning
        with Page(viewer.url) as late:
            names = {each["name"] for each in news(late, 0, 3, done=3)["photographs"]}
            assert names == {"photograph 1", "photograph 2"}
            assert "do" in late.ask("pictures")
            late.send("column", pixel=[0, 0])
            with pytest.raises(Exception, match="1008"):
                late.ask("pictures")


def test_photographs_that_deviate_are_named(tmp_path: Path) -> None:
    project(tmp_path, BY_HAND)
    rig = FolderRig(tmp_path, (4, 6))
    codes = 0.1 + 0.1 * random.random((20, 30))
    shots = []
    for pattern in (np.eye(4, 6), np.ones((4, 6)), np.zeros((4, 6))):
        shots += [(pattern, 0.1), (pattern, 0.4)]
    rig.prepare(shots)
    for shot, factor in zip(
        rig.shots, (1, 4, 1, 1.5, 9, 9), strict=True
    ):  # of 0.4 s: 4 times as bright
        path = tmp_path / f"{shot.save_as}.png"
        images.write(path, np.minimum(factor * codes, 1), encoding="linear")
    scan = Scan(tmp_path, None)
    white = Radiance(*np.ones((3, 1, 6)))
    known: Any = {
        "exposures": (0.1, 0.4),
        "camera": CameraModel(response=Response.identity()),
    }
    known |= {"resampling": SimpleNamespace(coverage=np.ones(6)), "white": white}
    scan.agreement.calibration = cast(Any, SimpleNamespace(**known))
    warnings = scan.scan(0)[0]["warnings"]
    for first, second in ((3, 4), (5, 6)):
        assert sum(f"photograph {first} or photograph {second} " in text for text in warnings) == 1
    assert sum(text.startswith("photograph 5: ") and "saturated" in text for text in warnings) == 1
    assert len(warnings) == 3


@pytest.mark.slow
def test_a_scan_is_watched_until_its_transport_is_shown(tmp_path: Path) -> None:
    truth = ltcl.scenes.dihedral(4, albedo=0.6).transport()
    ltcl.save(tmp_path / "T.npz", truth)
    scan = project(tmp_path, VIRTUAL)
    serving = Viewer(Scan(tmp_path, None), open_browser=False)
    with serving as viewer, Page(viewer.url) as page:
        assert news(page, state="new", finished=False)["done"] == 0
        with scan.rig() as rig:
            T = ltcl.acquire(rig, store=scan.store, **scan.settings)
        facts = news(page, state="final", left=None, finished=True)
        assert facts["done"] == facts["total"] >= 32
        assert (facts["coverage"], facts["saturated"]) == (1.0, 0.0)
        with Page(viewer.url) as again:
            assert again.hello.items() >= {"grid": [4, 8], "scan": True}.items()
        unit = np.zeros(T.grid, np.float32)
        unit[1, 2] = 1.0
        column = page.ask("column", pixel=[1, 2])["picture"][..., 0]
        np.testing.assert_allclose(column, T @ unit, atol=2e-3 * column.max())
    with Viewer(Scan(tmp_path, None), open_browser=False) as viewer, Page(viewer.url) as page:
        assert (page.hello["grid"], page.hello["scan"]) == ([4, 8], True)


class WatchedScan(Scan):
    """A page comes after each change of the scan, and asks what it is offered."""

    grids: list[Any]
    is_watched: bool

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        if getattr(self, "is_watched", False):
            self.grids.append(self.hello()["grid"])
            if "column" in self.questions:
                self.answer("column", {"pixel": [0, 0]}, lambda *_: None)


@pytest.mark.slow
def test_a_page_that_comes_as_a_scan_ends_reads_no_half_of_it(tmp_path: Path) -> None:
    ltcl.save(tmp_path / "T.npz", ltcl.scenes.dihedral(4, albedo=0.6).transport())
    acquisition = project(tmp_path, VIRTUAL)
    scan = WatchedScan(tmp_path, None)
    with acquisition.rig() as rig:
        ltcl.acquire(rig, store=acquisition.store, **acquisition.settings)
    scan.grids = []
    scan.is_watched = True
    assert scan.scan(0)[0]["warnings"] == []
    assert scan.grids[0] is None
    assert scan.grids[-1] == (4, 8)


@pytest.mark.slow
def test_batches_of_a_scan_that_was_stopped(tmp_path: Path) -> None:
    ltcl.save(tmp_path / "T.npz", ltcl.scenes.dihedral(6, albedo=0.6).transport())
    scan = project(tmp_path, VIRTUAL)

    def stop(step: str, done: int, total: int) -> None:
        if step == "scan" and done > 70:
            raise KeyboardInterrupt

    with scan.rig() as rig, pytest.raises(KeyboardInterrupt):
        ltcl.acquire(rig, store=scan.store, progress=stop, **scan.settings)
    facts, previews = Scan(tmp_path, None).scan(0)
    assert facts["state"] == "begun"
    assert 0 < facts["done"] < facts["total"]
    assert [each["name"] for each in facts["photographs"]][-1] == "batch 1"
    assert {preview.shape for preview in previews.values()} == {(6, 12)}
    assert facts["seen"] == len(previews)


@contextmanager
def looking(url: str, slow: float = 0.0, keys: bool = False) -> Iterator[list[np.ndarray]]:
    """Codes of a projector window that is slow at drawing, in which somebody may press keys."""
    shown: list[np.ndarray] = []

    def look() -> None:
        with Page(url) as page:
            page.send("projector")
            while True:
                try:
                    message = page.next()
                except Exception:  # noqa: BLE001 - the viewer has ended
                    return
                if message["do"] == "show":
                    time.sleep(slow)
                    shown.append(message["codes"])
                    page.send("projector")
                    if keys:
                        page.send("next")

    thread = threading.Thread(target=look)
    thread.start()
    yield shown
    thread.join(PATIENCE)


@pytest.mark.parametrize("advance", ["key", 0.2, "arrival"])
def test_patterns_come_one_after_the_other(tmp_path: Path, advance: Any) -> None:
    rig = FolderRig(tmp_path, (4, 6))
    patterns = [np.eye(4, 6), np.zeros((4, 6)), np.full((4, 6), 0.6)]
    rig.prepare([(pattern, 0.5) for pattern in patterns])

    def photograph(shot: Any, done: int, total: int) -> None:
        assert (shot.number, done, total) == (done + 1, done, 3)
        if advance == "arrival":
            images.write(tmp_path / f"{shot.save_as}.png", np.zeros((5, 5)))

    with (
        Window("patterns", open_browser=False) as window,
        looking(window.url, keys=advance == "key") as shown,
    ):
        assert rigs.show(tmp_path, window, advance, photograph) == 3
        window.wait(1.0)
        for do in ("result", "upload"):
            with Page(window.url) as page:
                page.send(do, name="report.json")
                with pytest.raises(ConnectionClosed, match="do is"):  # a window has neither
                    _ = [page.next() for _ in range(100)]
        window.close()
    for codes, pattern in zip(shown, patterns, strict=True):
        np.testing.assert_array_equal(codes[..., 0], np.rint(255 * pattern))


@pytest.mark.slow
@pytest.mark.parametrize("slow", [0.0, 0.15])
def test_a_film_is_compensated_frame_by_frame_and_never_late(
    device, tmp_path: Path, slow: float
) -> None:
    T = ltcl.scenes.dihedral(4, albedo=(0.7, 0.5, 0.3)).transport()
    film = [np.full((*T.grid, 3), 0.02 * (k + 1), np.float32) for k in range(20)]
    write_video(tmp_path / "film.mkv", film, 20.0)
    source = open_frames(tmp_path / "film.mkv")
    told: list[Any] = []
    pictures = [frame.picture() for frame in source]
    with Window("film", open_browser=False) as window, looking(window.url, slow) as shown:
        scene = ViewerScene(T, "T", {}, None)
        pace = play(scene, source, window, 0.5, lambda *what, detail: told.append(what), rtol=1e-4)
        window.close()
    expected = [
        scene.codes(ltcl.compensate(T, each, gain=0.5, rtol=1e-4).pattern, 1.0) for each in pictures
    ]
    numbers = [number - 1 for _, number, _ in told]
    assert pace.shown == len(numbers) == len(shown)
    assert pace.shown + pace.dropped == numbers[-1] + 1
    assert numbers == sorted({*numbers})
    for codes, number in zip(shown, numbers, strict=True):
        np.testing.assert_allclose(codes.astype(int), expected[number].astype(int), atol=1)
    # On a busy machine; were nothing dropped, it would add up to 2 s.
    assert pace.latency < slow + 1.0
    assert pace.dropped > 5 or not slow
    assert "dropped" in window.title
    # What computing takes is told with it.
    assert 0.0 < pace.computing_p50 <= pace.computing_p99
    assert window.title.endswith(f"p99 {1e3 * pace.computing_p99:.1f} ms")


def test_a_film_for_a_rectangular_T_keeps_to_the_bounds(device, tmp_path: Path) -> None:
    T = ltcl.Transport(random.random((20, 12), np.float32), (3, 4), camera_grid=(4, 5))
    images.write(tmp_path / "0.png", np.full((4, 5), 0.9))
    source = open_frames(tmp_path)
    scene = ViewerScene(T, "T", {}, None)
    with Window("film", open_browser=False) as window, looking(window.url) as shown:
        assert play(scene, source, window, 1.0, lambda *_, **__: None).shown
        window.close()
    (frame,) = source
    light = ltcl.compensate(T, frame.picture(), gain=1.0).pattern
    exact = np.atleast_3d(scene.codes(light, 1.0))
    np.testing.assert_allclose(shown[0].astype(int), exact.astype(int), atol=1)


@pytest.mark.parametrize("how", ["crop", "letterbox", "stretch"])
def test_a_film_of_other_proportions(device, tmp_path: Path, how: str) -> None:
    T = ltcl.scenes.dihedral(4, albedo=0.6).transport()
    images.write(tmp_path / "0.png", 0.3 + 0.2 * random.random((9, 7)))
    source = open_frames(tmp_path)
    scene = ViewerScene(T, "T", {}, None)
    with Window("film", open_browser=False) as window, looking(window.url) as shown:
        assert play(scene, source, window, 0.5, lambda *_, **__: None, how).shown
        window.close()
    (frame,) = source
    desired = images.resize(frame.picture(), T.camera_grid, how)
    light = ltcl.compensate(T, desired, gain=0.5, clamp=True).pattern
    exact = np.atleast_3d(scene.codes(light, 1.0))
    np.testing.assert_allclose(shown[0].astype(int), exact.astype(int), atol=1)


@pytest.mark.rare
@pytest.mark.parametrize("is_grey", [False, True])
def test_an_inverse_shows_what_compensate_would(device, tmp_path: Path, is_grey: bool) -> None:
    T = ltcl.scenes.dihedral(4, albedo=0.6 if is_grey else (0.7, 0.5, 0.3)).transport()
    for k in range(2):
        images.write(
            tmp_path / f"{k}.png", 0.3 + 0.2 * random.random((*T.grid, 3) if k else T.grid)
        )
    source = open_frames(tmp_path)
    channels = () if is_grey else (3,)
    background = np.full((*T.grid, *channels), 0.05, np.float32)
    rules: Any = {
        "inverse": ltcl.invert(T, 1e-4),
        "background": background,
        "rtol": 1e-3,
        "clamp": True,
    }
    with Window("film", open_browser=False) as window, looking(window.url) as shown:
        scene = ViewerScene(T, "T", {}, None)
        pace = play(scene, source, window, 0.5, lambda *_, **__: None, **rules)
        assert pace.shown == 2
        window.close()
    for codes, frame in zip(shown, source, strict=True):
        light = ltcl.compensate(T, frame.picture(), gain=0.5, **rules).pattern
        exact = np.atleast_3d(scene.codes(light, 1.0))
        np.testing.assert_allclose(codes.astype(int), exact.astype(int), atol=1)
    with pytest.raises(errors.InputError, match="inverse"):
        play(
            scene,
            source,
            window,
            0.5,
            print,
            inverse=ltcl.invert(ltcl.scenes.dihedral(5).transport()),
        )


def port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def test_pages_find_the_next_viewer_on_a_port_that_was_named(
    device, monkeypatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path))
    T, number = ltcl.Transport(np.eye(6) / 2, (2, 3)), port()

    def url(**address: Any) -> str:
        with ltcl.view(T, open_browser=False, **address) as viewer:
            return viewer.url

    first = url(port=number)
    assert url(port=number) == first
    assert url() != url()
    anywhere = url(port=number, host="0.0.0.0")  # noqa: S104 - whose token is not kept
    assert anywhere.split("/")[3] != first.split("/")[3]
    file = tuning.folder() / f"viewer-{number}"
    assert file.read_text() in first
    assert os.name != "posix" or file.stat().st_mode & 0o777 == 0o600
    os.utime(file, (0, 0))  # of another day
    assert url(port=number) != first
    if os.name == "posix":
        file.chmod(0o644)  # others may have read it
        with pytest.raises(errors.InputError, match="others can read it"):
            url(port=number)
        file.unlink()
        file.symlink_to(tmp_path / "elsewhere")
        with pytest.raises(errors.InputError, match="port"):
            url(port=number)
        assert not (tmp_path / "elsewhere").exists()


@contextmanager
def running(command: str, *arguments: Any, reports: list[Any] | None = None) -> Iterator[Any]:
    """A command in a process of its own, which has said its URL; what it prints is checked.

    Its report is appended to `reports`.
    """
    words = [sys.executable, "-m", "ltcl", command, *arguments, "--json"]
    pipes: dict[str, Any] = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, env=os.environ | {"BROWSER": "true"}, **pipes) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        yield process, process.stderr.readline().split()[0]
        assert process.wait(PATIENCE) == 0
        report = json.load(process.stdout)
        json_schema.check([command], report)
        if reports is not None:
            reports.append(report)


def film(folder: Path) -> Path:
    for k in range(3):
        images.write(folder / f"{k}.png", np.full((4, 6), 0.1 * k))
    return folder


@pytest.mark.rare
def test_play_and_show_run(tmp_path: Path) -> None:
    ltcl.save(tmp_path / "T.npz", ltcl.Transport(np.eye(24) / 2, (4, 6)))
    reports: list[Any] = []
    for command, *more in (["play", tmp_path / "T.npz", "--no-browser"], ["show", "--browser"]):
        with (
            running(command, film(tmp_path / "film"), *more, reports=reports) as (_, url),
            looking(url, keys=True) as shown,
        ):
            pass
        assert len(shown) >= 2
    played, _ = reports
    assert played["shown"] >= 2
    assert 0.0 < played["computing_p50"] <= played["computing_p99"]


@pytest.mark.slow
def test_view_combines_the_scans_of_several_projectors(room_of_two: Path, tmp_path: Path) -> None:
    images.write(tmp_path / "wanted.png", np.full((6, 12), 0.3))
    words = (room_of_two, tmp_path / "wanted.png", "--no-browser")
    with running("view", *words) as (process, url), Page(url) as page:
        assert [projector["name"] for projector in page.hello["projectors"]] == ["left", "right"]
        assert page.hello["grid"] == [6, 24]
        assert page.ask("pictures")["pictures"] == [{"picture": 1, "name": "wanted.png"}]
        process.send_signal(signal.SIGINT)


@pytest.mark.rare
def test_ctrl_c_ends_view_and_show(tmp_path: Path) -> None:
    project(tmp_path, BY_HAND)
    with running("view", tmp_path, "--no-browser") as (process, url), Page(url) as page:
        assert page.hello["scan"]
        process.send_signal(signal.SIGINT)
    with (
        running("show", film(tmp_path / "film"), "--browser") as (process, url),
        looking(url) as shown,
    ):
        while not shown:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
    assert len(shown) == 1


@pytest.mark.parametrize("command", ["acquire aim", "play", "show", "view"])
def test_ctrl_c_is_no_error_from_the_line_that_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """What is interrupted is the line itself, the earliest moment at which a user knows."""
    transport = tmp_path / "T.npz"
    ltcl.save(transport, ltcl.Transport(np.eye(24) / 2, (4, 6)))
    (tmp_path / "by_hand").mkdir()
    project(tmp_path / "by_hand", BY_HAND)
    frames = film(tmp_path / "film")
    module, words = {
        "acquire aim": ("aim", (tmp_path / "by_hand", "--no-browser")),
        "play": ("show", (frames, transport, "--no-browser")),
        "show": ("show", (frames, "--browser")),
        "view": ("view", (transport, "--no-browser")),
    }[command]
    lines = []

    def interrupted_line(text: str) -> None:
        lines.append(text)
        raise KeyboardInterrupt

    monkeypatch.setattr(f"ltcl.cli.{module}.print_line", interrupted_line)
    monkeypatch.setattr("webbrowser.open", lambda url: True)
    assert main([*command.split(), *map(str, words)]) == 0
    (line,) = lines
    assert line.endswith("Ctrl-C ends it")


def test_a_folder_that_holds_nothing_is_called_so(tmp_path: Path) -> None:
    with pytest.raises(errors.FileError, match=r"zarr\.json.*acquisition\.toml"):
        ltcl.load(tmp_path)
