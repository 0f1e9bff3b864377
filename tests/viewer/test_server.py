# SPDX-License-Identifier: BSD-3-Clause
"""The viewer against dense float64 results by its protocol; turns, windows, files, command."""

from __future__ import annotations

import asyncio
import io
import json
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from PIL import Image
from websockets.exceptions import ConnectionClosed

import ltcl
from ltcl import errors, images
from ltcl.viewer import answers, pictures
from tests.viewer.page import Page

ROUNDING = 2.0**-20  # of the largest value: float32 sums
random = np.random.default_rng(0)
MIXING = [[1.0, 0.2, 0.1], [0.3, 0.9, 0.0], [0.0, 0.4, 1.1]]


def compressed() -> ltcl.Transport:
    return ltcl.compress(ltcl.scenes.dihedral(8, albedo=(0.8, 0.6, 0.4)).transport(), rtol=1e-2)


TRANSPORTS = {
    "grey": lambda: ltcl.scenes.dihedral(6, albedo=0.7).transport(),
    "colour": lambda: ltcl.scenes.dihedral(6, albedo=(0.8, 0.6, 0.4)).transport(),
    "rectangular": lambda: ltcl.Transport(random.random((35, 12)), (3, 4), camera_grid=(5, 7)),
    "sparse": lambda: ltcl.Transport(
        scipy.sparse.random(30, 30, 0.3, "csr") + scipy.sparse.eye(30), (5, 6)
    ),
    "mixing": lambda: ltcl.Transport(
        random.random((3, 12, 12)) + np.eye(12), (3, 4), mixing=MIXING
    ),
    "blocks": lambda: ltcl.Transport(random.random((3, 3, 20, 12)), (3, 4), camera_grid=(4, 5)),
    "compressed": compressed,
}


@contextmanager
def viewing(T: ltcl.Transport, *arguments: Any, **settings: Any) -> Iterator[Page]:
    with (
        ltcl.view(T, *arguments, open_browser=False, **settings) as viewer,
        Page(viewer.url) as page,
    ):
        yield page


@pytest.fixture(scope="module", params=TRANSPORTS)
def shown(request, device) -> Iterator[tuple[ltcl.Transport, Page]]:
    T = TRANSPORTS[request.param]()
    with viewing(T) as page:
        yield T, page


@pytest.fixture(scope="module")
def colour(device) -> ltcl.Transport:
    return TRANSPORTS["colour"]()


def whole(T: ltcl.Transport) -> np.ndarray:
    """T as one matrix (3 M, 3 N) of pixels by channels in float64, or (M, N) of a grey one."""
    dense = T.to_numpy().astype(np.float64)
    if T.channels == 1:
        return dense
    blocks = dense if dense.ndim == 4 else np.einsum("cd,cij->cdij", np.eye(3), dense)
    if T.mixing is not None:
        blocks = np.einsum("cij,cd->cdij", dense, T.mixing)
    return blocks.transpose(2, 0, 3, 1).reshape(3 * T.shape[0], 3 * T.shape[1])


def near(picture: np.ndarray, exact: np.ndarray) -> None:
    assert picture.size == exact.size
    np.testing.assert_allclose(
        picture.ravel(), exact.ravel(), rtol=0, atol=ROUNDING * np.abs(exact).max()
    )


def test_hello_says_what_T_is(shown):
    T, page = shown
    facts = {
        "grid": list(T.grid),
        "camera_grid": list(T.camera_grid),
        "channels": T.channels,
        "scan": False,
    }
    facts |= {"square": T.is_square, "compressed": T.is_compressed, "error": T.error, "next": False}
    assert page.hello.items() >= {"do": "hello", **facts}.items()


def test_columns_and_rows_are_those_of_T(shown):
    T, page = shown
    A = whole(T)
    for ask, name, grid, matrix in (
        ("column", "picture", T.grid, A),
        ("row", "pattern", T.camera_grid, A.T),
    ):
        for pixel in ([0, 0], [grid[0] - 1, 1]):
            unit = np.zeros((*grid, T.channels))
            unit[tuple(pixel)] = 1
            near(page.ask(ask, pixel=pixel)[name], matrix @ unit.ravel())


@pytest.mark.slow
def test_relighting_with_codes(shown):
    T, page = shown
    for c in (1, 3):
        codes = random.integers(0, 256, (*T.grid, c), dtype=np.uint8)
        light = images.from_srgb(codes / 255.0)
        exact = T @ np.squeeze(light, -1) if c == 1 else T @ light
        if c == T.channels:
            near(exact, whole(T) @ light.ravel())
        near(page.ask("relight", {"pattern": codes})["picture"], exact)


def test_bounces_of_a_picture_and_of_the_pattern(colour):
    A = colour.to_numpy().astype(np.float64)
    F = np.einsum("cii->ci", A)
    codes = random.integers(0, 256, (*colour.grid, 3), dtype=np.uint8)
    light = images.from_srgb(codes / 255.0)
    with viewing(colour, colour @ light) as page:
        page.ask("relight", {"pattern": codes})
        for fields in ({"picture": 1}, {}):
            reply = page.ask("bounces", count=2, **fields)
            rest = np.einsum("cij,jc->ic", A, light.reshape(-1, 3))
            shares = []
            total = rest.sum()
            for name in ("direct", "bounce_1", "bounce_2"):
                b = np.stack([F[c] * np.linalg.solve(A[c], rest[:, c]) for c in range(3)], axis=1)
                np.testing.assert_allclose(
                    reply[name].reshape(-1, 3), b, rtol=0, atol=4e-3 * rest.max()
                )
                assert reply[f"{name}_std"].shape == reply[name].shape
                rest = rest - b
                shares.append(b.sum() / total)
            np.testing.assert_allclose(reply["shares"], [*shares, rest.sum() / total], atol=4e-3)


def test_a_compensation_and_its_downloads(colour, tmp_path):
    pattern = 0.2 + 0.6 * random.random((*colour.grid, 3))
    desired = (colour @ pattern).astype(np.float32)
    with viewing(colour, {"wanted": desired}) as page:
        assert "compensated" in page.ask("result", name="pattern.exr")["error"]
        reply = page.ask("compensate", picture=1)
        exact = np.linalg.solve(whole(colour), desired.ravel())
        np.testing.assert_allclose(reply["pattern"].ravel(), exact, atol=0.02)
        near(reply["target"], desired)
        np.testing.assert_allclose(
            reply["appearance"].ravel(), desired.ravel(), atol=0.02 * desired.max()
        )
        assert not reply["out_of_reach"].any()
        assert reply["gain"] == 1.0
        assert reply["clipped"] == 0.0
        assert reply["method"] == "direct"
        assert reply["products"] == 0
        assert reply["seconds"] > 0
        assert reply["residuals"][-1] <= 1e-2
        for name in (
            "pattern.exr",
            "appearance.exr",
            "target.exr",
            "pattern.png",
            "codes.png",
            "report.json",
        ):
            (tmp_path / name).write_bytes(page.ask("result", name=name)["content"])
        light = images.read(tmp_path / "pattern.exr")
        near(reply["pattern"], light)
        codes = np.rint(255 * images.to_srgb(light))
        np.testing.assert_array_equal(images.read_codes(tmp_path / "codes.png"), codes)
        np.testing.assert_array_equal(images.read_codes(tmp_path / "pattern.png"), codes)
        written = json.loads((tmp_path / "report.json").read_text())
        assert (
            written.items() >= {"picture": "wanted", "error": reply["error"], "gain": 1.0}.items()
        )

        brighter = page.ask("compensate", picture=1, gain="auto", bounds=[0, 2])
        assert brighter["gain"] > 1.9
        assert brighter["pattern"].max() <= 2.0
        too_bright = page.ask("compensate", picture=1, gain=5.0)
        assert too_bright["clipped"] > 0.1
        assert too_bright["out_of_reach"].max() > 0


def test_a_T_without_first_bounce_compensates_but_does_not_separate(device):
    T = TRANSPORTS["rectangular"]()
    with viewing(T, T @ np.full(T.grid, 0.5)) as page:
        assert "camera_grid" in page.ask("bounces")["error"]
        assert page.ask("compensate", picture=1)["error"] < 0.02


def png(codes: np.ndarray) -> bytes:
    Image.fromarray(codes).save(file := io.BytesIO(), "PNG")
    return file.getvalue()


def test_uploads_are_relit_and_wrong_ones_refused(colour):
    codes = random.integers(0, 256, (*colour.grid, 3), dtype=np.uint8)
    with viewing(colour) as page:
        told = page.upload("a b.png", png(codes))
        assert told == {"picture": 1, "name": "a b.png", "shape": [*codes.shape]}
        assert page.ask("pictures")["pictures"] == [{"picture": 1, "name": "a b.png"}]
        near(
            page.ask("relight", picture=1)["picture"],
            whole(colour) @ images.from_srgb(codes / 255.0).ravel(),
        )
        assert page.upload("large.png", png(np.zeros((40, 50), np.uint8)))["shape"] == [40, 50, 1]
        assert page.ask("relight", picture=2)["picture"].max() == 0
        for name, content in {
            "a.txt": b"text",
            "a.png": b"text",
            "a.exr": b"text",
            "": b"x",
        }.items():
            (wrong,) = page.upload(name, content).items()
            assert wrong[0] == "error"
            assert " object at " not in wrong[1]
        for number in range(3, 25):
            page.upload(f"{number}.png", png(codes))
        kept = page.ask("pictures")["pictures"]
        assert [each["picture"] for each in kept] == list(range(25 - pictures.MAX_UPLOADS, 25))


def test_pictures_of_other_proportions_are_cropped_letterboxed_or_stretched(colour):
    h, w = colour.grid
    codes = random.integers(0, 256, (h, 2 * w, 3), dtype=np.uint8)
    light = images.from_srgb(codes / 255.0)
    halves = light.reshape(h, w, 2, 3).mean(axis=2)
    between_bars = np.zeros((h, w, 3))
    quarters = halves.reshape(h // 2, 2, w, 3).mean(axis=1)
    between_bars[h // 4 : h // 4 + h // 2] = quarters
    expected = {"crop": light[:, w // 2 : w // 2 + w], "letterbox": between_bars, "stretch": halves}
    with viewing(colour) as page:
        page.upload("wide.png", png(codes))
        for how, on_grid in expected.items():
            reply = page.ask("relight", picture=1, resize=how)
            near(reply["pattern"], on_grid)
            near(reply["picture"], whole(colour) @ on_grid.ravel())
            compensation = page.ask("compensate", picture=1, resize=how)
            near(compensation["target"], on_grid)
            content = page.ask("result", name="report.json")["content"]
            assert json.loads(content)["resize"] == how
            parts = page.ask("bounces", picture=1, resize=how, count=1)
            near(parts["direct"] + parts["bounce_1"] + parts["rest"], on_grid)
        near(page.ask("relight", picture=1)["pattern"], expected["crop"])


def test_projector_windows_show_what_is_relit_and_compensated(colour):
    codes = random.integers(0, 256, (*colour.grid, 3), dtype=np.uint8)
    with viewing(colour, colour @ np.full(colour.grid, 0.5)) as page, Page(page.url) as window:
        assert window.ask("projector")["do"] == "projector"
        np.testing.assert_array_equal(window.next()["codes"], np.full((*colour.grid, 1), 255))
        page.ask("relight", {"pattern": codes})
        np.testing.assert_array_equal(window.next()["codes"], codes)
        reply = page.ask("compensate", picture=1, bounds=[0, 2])
        pushed = window.next()
        assert pushed["do"] == "show"
        np.testing.assert_allclose(
            pushed["codes"], 255 * images.to_srgb(reply["pattern"] / 2), atol=0.6
        )


@pytest.mark.slow
def test_a_measured_T_shows_the_codes_of_its_projector(device, tmp_path):
    from ltcl.acquisition import Setup, VirtualRig

    rig = VirtualRig(np.eye(64) / 2, (8, 8), ambient=0.1)
    T = ltcl.acquire(rig, geometry="aligned", store=tmp_path / "T.zarr")
    setup = Setup.of(tmp_path / "T.zarr")
    codes = random.integers(0, 256, T.grid, dtype=np.uint8)
    light = images.from_srgb(codes / 255.0)
    with viewing(T, setup=setup) as page:
        page.ask("relight", {"pattern": codes[..., None]})
        page.send("projector")
        while (pushed := page.next())["do"] != "show":
            pass
        np.testing.assert_array_equal(pushed["codes"][..., 0], np.rint(255 * setup.codes(light)))


@pytest.mark.parametrize(
    ("do", "fields", "word"),
    [
        ("column", {"pixel": [6, 0]}, "pixel"),
        ("column", {"pixel": [-1, 0]}, "pixel"),
        ("row", {"pixel": [0.5, 0]}, "pixel"),
        ("row", {"pixel": [True, 0]}, "pixel"),
        ("row", {"pixel": "00"}, "pixel"),
        ("row", {}, "pixel"),
        ("row", {"pixel": [0, 0], "more": 1}, "more"),
        ("relight", {"pattern": [[1, 2]]}, "pattern"),
        ("bounces", {"count": 17}, "count"),
        ("bounces", {"picture": 2}, "picture"),
        ("bounces", {"picture": 1, "resize": ["crop"]}, "resize"),
        ("relight", {"picture": 1, "resize": "fill"}, "resize"),
        ("compensate", {"picture": 1, "resize": None}, "resize"),
        ("bounces", {"callback": 1}, "callback"),
        ("compensate", {"picture": 7}, "picture"),
        ("compensate", {"picture": 1, "bounds": [1, 0]}, "bounds"),
        ("compensate", {"picture": 1, "bounds": [0, float("nan")]}, "bounds"),
        ("compensate", {"picture": 1, "gain": "most"}, "gain"),
        ("compensate", {"picture": 1, "more": "magic"}, "more"),
    ],
)
def test_wrong_questions_get_one_line_and_the_next_one_is_answered(colour, do, fields, word):
    with viewing(colour, np.ones(colour.grid)) as page:
        line = page.ask(do, **fields)["error"]
        assert word in line
        assert "\n" not in line
        assert "internal" not in line
        assert "picture" in page.ask("column", pixel=[0, 0])


def test_light_beyond_what_numbers_hold_is_refused(device):
    with viewing(ltcl.Transport(np.full((4, 4), 2e38), (2, 2), np.ones(4))) as page:
        bright, dim = (np.full((2, 2, 1), code, np.uint8) for code in (255, 1))
        assert "picture has 4 NaN or infinite" in page.ask("relight", {"pattern": bright})["error"]
        assert "picture" in page.ask("relight", {"pattern": dim})


class Slow:
    """A stand-in for `separate`: 500 steps of 10 ms."""

    def __init__(self) -> None:
        self.steps = 0
        self.begun = threading.Event()

    def __call__(self, T: Any, image: Any, count: int, callback: Any) -> Any:
        for step in range(500):
            self.steps += 1
            self.begun.set()
            time.sleep(0.01)
            callback(step, 1.0)
        raise errors.ConvergenceError("the end")


@pytest.fixture
def slow(monkeypatch) -> Slow:
    monkeypatch.setattr(answers, "separate", slow := Slow())
    return slow


def test_a_long_solve_lets_others_by_and_tells_how_far_it_is(colour, slow):
    with viewing(colour) as page, Page(page.url) as other:
        number = page.send("bounces")
        slow.begun.wait()
        for _ in range(5):
            assert "picture" in other.ask("column", pixel=[0, 0])
            assert "picture" in page.ask("column", pixel=[0, 0])
        told = page.next()
        assert told.items() >= {"do": "progress", "id": number, "step": "bounces"}.items()
        assert slow.steps < 500


def test_what_is_asked_again_takes_the_place_of_what_waits_or_runs(colour, slow):
    with viewing(colour) as page:
        page.send("bounces")
        slow.begun.wait()
        page.send("bounces", count=3)
        last = page.send("bounces", picture=7)
        while (reply := page.next())["do"] == "progress":
            pass
        assert reply.items() >= {"id": last, "do": "bounces"}.items()
        assert slow.steps < 500


def test_nothing_is_computed_for_who_has_gone(colour, slow):
    with viewing(colour) as page:
        with Page(page.url) as other:
            other.send("bounces")
            slow.begun.wait()
        assert "picture" in page.ask("column", pixel=[0, 0])
        time.sleep(0.2)
        steps = slow.steps
        time.sleep(0.2)
        assert slow.steps == steps


def test_painting_never_queues(colour):
    codes = random.integers(0, 256, (*colour.grid, 3), dtype=np.uint8)
    with viewing(colour) as page:
        last = [page.send("relight", {"pattern": codes}) for _ in range(500)][-1]
        count = 1
        while page.next()["id"] != last:
            count += 1
        assert count < 500


def test_close_ends_it_also_amid_a_solve(colour, slow):
    with ltcl.view(colour, open_browser=False) as viewer:
        page = Page(viewer.url)
        page.send("bounces")
        slow.begun.wait()
        start = time.monotonic()
    assert time.monotonic() - start < 4
    with pytest.raises(ConnectionClosed):  # behind what was said before
        _ = [page.next() for _ in range(100)]
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(viewer.url)  # noqa: S310


def test_a_viewer_in_a_notebook_is_a_frame(colour):
    async def cell() -> None:
        with ltcl.view(colour, open_browser=False) as viewer:
            assert f'src="{viewer.url}"' in viewer._repr_html_()
            assert viewer.url in repr(viewer)

    # A browser of another test may have left an event loop in this thread.
    with ThreadPoolExecutor(1) as other_thread:
        other_thread.submit(lambda: asyncio.run(cell())).result()


def test_an_address_that_cannot_be_had_is_refused(colour):
    with ltcl.view(colour, open_browser=False) as viewer:
        port = int(viewer.url.split(":")[2].split("/")[0])
        own = [("127.0.0.1", wrong) for wrong in (port, -1, 1 << 17)]
        for host, wrong in (*own, ("256.1.1.1", 0), ("", 0)):
            with pytest.raises(errors.InputError, match="port"):
                ltcl.view(colour, host=host, port=wrong, open_browser=False)


@pytest.mark.skipif(not socket.has_ipv6, reason="this machine has no IPv6")
def test_an_address_of_ipv6(colour):
    with ltcl.view(colour, host="::1", open_browser=False) as viewer:
        assert viewer.url.startswith("http://[::1]:")
        assert urllib.request.urlopen(viewer.url).status == 200  # noqa: S310


@pytest.mark.slow
def test_the_command_runs_until_ctrl_c(tmp_path):
    ltcl.save(tmp_path / "T.npz", ltcl.Transport(np.eye(6) / 2, (2, 3)))
    images.write(tmp_path / "wanted.png", np.full((2, 3), 0.3))
    words = [
        sys.executable,
        "-m",
        "ltcl",
        "view",
        tmp_path / "T.npz",
        tmp_path / "wanted.png",
        "--no-browser",
    ]
    with subprocess.Popen(
        words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        url = process.stderr.readline().split()[0]
        with Page(url) as page:
            assert page.hello["title"] == "T.npz"
            assert page.ask("pictures")["pictures"] == [{"picture": 1, "name": "wanted.png"}]
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0


@pytest.mark.slow
def test_the_command_names_the_address_behind_a_proxy(tmp_path):
    ltcl.save(tmp_path / "T.npz", ltcl.Transport(np.eye(6) / 2, (2, 3)))
    words = [sys.executable, "-m", "ltcl", "view", tmp_path / "T.npz", "--no-browser"]
    words += ["--origin", "http://localhost:9000"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("http://localhost:9000/")
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


@pytest.mark.slow
def test_without_the_extra_ltcl_imports_and_says_how_to_get_it():
    code = "import sys; sys.modules['starlette'] = None; import ltcl, numpy; "
    code += "ltcl.view(ltcl.Transport(numpy.eye(2), (1, 2)))"
    words = [sys.executable, "-c", code]
    folder = Path(ltcl.__file__).parents[1]
    run = subprocess.run(words, capture_output=True, text=True, cwd=folder)
    assert run.stderr.splitlines()[-1].endswith('pip install "ltcl[view]"')


def test_pattern_while_a_slider_moves(device) -> None:
    """It is that of the whole compensation, with its times, and made anew for other bounds."""
    T = ltcl.scenes.dihedral(4, albedo=(0.6, 0.5, 0.3)).transport()
    picture = np.full((*T.grid, 3), 0.2, np.float32)
    scene = answers.ViewerScene(T, "corner", {"grey": picture}, None)
    (number,) = [entry["picture"] for entry in scene.pictures()[0]["pictures"]]
    for gain, bounds in ((0.5, (0, 1)), (0.7, (0, 1)), (0.7, (0, 0.2))):
        facts, pictures = scene.adjust(number, gain, bounds)
        expected = ltcl.compensate(T, picture, gain=gain, bounds=bounds, rtol=1e-2)
        np.testing.assert_allclose(pictures["appearance"], expected.appearance, atol=5e-3)
        assert facts["error"] <= expected.error + 0.01
        assert facts["clipped"] == pytest.approx(expected.clipped, abs=0.05)
        assert 0.0 < facts["p50"] <= facts["p99"]
        assert scene.pattern is pictures["pattern"]
    with pytest.raises(errors.InputError, match="gain"):
        scene.adjust(number, 0.0)
