# SPDX-License-Identifier: BSD-3-Clause
"""The widget by its messages: questions over a kernel's channel, turns, parts, memory, pictures."""

from __future__ import annotations

import base64
import gc
import io
import json
import queue
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

import ltcl
from ltcl import errors
from ltcl.viewer import answers, kernel_pages, page_files
from ltcl.viewer.answers import ViewerScene
from ltcl.viewer.kernel_pages import KernelPages
from tests.viewer.page import answer, question

PATIENCE = 60.0  # seconds
ROUNDING = 2.0**-20
random = np.random.default_rng(0)


class FrontEnd:
    """The front end of a notebook, as far as one page of it goes."""

    def __init__(self, pages: KernelPages, heard: queue.Queue[Any], name: str = "page") -> None:
        self.pages = pages
        self.heard = heard
        self.name = name
        self.asked = 0
        pages.take({"page": name, "event": "open"}, [])

    def send(
        self, do: str, arrays: dict[str, np.ndarray] | None = None, part: int = 0, **fields: Any
    ) -> int:
        """Ask, in parts of so many bytes if `part` is given; return the number of the question."""
        self.asked += 1
        message = question({"id": self.asked, "do": do, **fields}, arrays or {})
        if isinstance(message, str):
            self.pages.take({"page": self.name, "text": message}, [])
            return self.asked
        step = part or len(message)
        for start in range(0, len(message), step):
            content = {"page": self.name, "more": start + step < len(message)}
            self.pages.take(content, [message[start : start + step]])
        return self.asked

    def next(self) -> dict[str, Any]:
        """Return the next message for this page."""
        while True:
            content, buffers = self.heard.get(timeout=PATIENCE)
            if content["page"] != self.name:
                continue
            if "text" in content:
                return answer(content["text"])
            return answer(buffers[0]) if buffers else content

    def ask(self, do: str, arrays: Any = None, **fields: Any) -> dict[str, Any]:
        number = self.send(do, arrays, **fields)
        while (found := self.next()).get("id") != number or found["do"] != do:
            pass
        return found

    def leave(self) -> None:
        self.pages.take({"page": self.name, "event": "close"}, [])


@pytest.fixture(scope="module")
def T(device: Any) -> ltcl.Transport:
    return ltcl.scenes.dihedral(6, albedo=(0.8, 0.5, 0.3)).transport()


@pytest.fixture
def heard() -> queue.Queue[Any]:
    return queue.Queue()


@pytest.fixture
def pages(T: ltcl.Transport, heard: queue.Queue[Any]) -> Iterator[KernelPages]:
    scene = ViewerScene(T, "corner", {"grey": np.full(T.grid, 0.4)}, None)
    pages = KernelPages(scene, lambda content, buffers: heard.put((content, buffers)))
    yield pages
    pages.close()


@pytest.fixture
def front_end(pages: KernelPages, heard: queue.Queue[Any]) -> FrontEnd:
    front_end = FrontEnd(pages, heard)
    assert front_end.next()["title"] == "corner"
    return front_end


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_questions_are_answered_as_by_the_server(front_end: FrontEnd, T: ltcl.Transport) -> None:
    unit = np.zeros(T.grid, np.float32)
    unit[2, 3] = 1.0
    probed = front_end.ask("column", pixel=[2, 3])["picture"]
    np.testing.assert_allclose(probed, T @ unit, atol=ROUNDING)
    light = front_end.ask("bounces", count=2)
    total = light["direct"] + light["bounce_1"] + light["bounce_2"] + light["rest"]
    np.testing.assert_allclose(total, T @ np.ones(T.grid), rtol=1e-4)
    compensated = front_end.ask("compensate", picture=1, gain="auto")
    expected = ltcl.compensate(T, np.full(T.grid, 0.4, np.float32), gain="auto")
    np.testing.assert_allclose(compensated["pattern"], expected.pattern, atol=1e-3)
    assert "picture is 7" in front_end.ask("compensate", picture=7)["error"]


@pytest.mark.parametrize("part", [0, 1000, 7])
def test_large_questions_come_in_parts(front_end: FrontEnd, T: ltcl.Transport, part: int) -> None:
    codes = random.integers(0, 256, (*T.grid, 3), dtype=np.uint8)
    number = front_end.send("relight", {"pattern": codes}, part)
    reply = front_end.next()
    assert reply["id"] == number
    light = ltcl.images.from_srgb(codes / 255.0)
    np.testing.assert_allclose(reply["picture"], T @ light, atol=1e-5)


def test_files_go_both_ways(front_end: FrontEnd) -> None:
    Image.fromarray(np.full((5, 9), 128, np.uint8)).save(file := io.BytesIO(), "PNG")
    content = np.frombuffer(file.getvalue(), np.uint8)
    front_end.send("upload", {"content": content}, part=50, name="grey.png")
    assert front_end.next()["shape"] == [5, 9, 1]
    assert front_end.ask("compensate", picture=2)["error"] < 1
    report = front_end.ask("result", name="report.json")["content"]
    assert json.loads(report)["picture"] == "grey.png"


def test_two_pages_get_their_own_answers(
    pages: KernelPages, heard: queue.Queue[Any], front_end: FrontEnd
) -> None:
    other = FrontEnd(pages, heard, "other")
    other.next()
    number = other.send("column", pixel=[0, 0])
    front_end.send("column", pixel=[5, 5])
    answers = {}
    for _ in range(2):
        content, buffers = heard.get(timeout=PATIENCE)
        answers[content["page"]] = answer(buffers[0])
    assert answers["other"]["id"] == number
    assert abs(answers["other"]["picture"] - answers["page"]["picture"]).max() > 0.1
    other.leave()
    wait_until(lambda: len(pages._clients) == 1)
    assert "picture" in front_end.ask("column", pixel=[0, 0])


def test_what_is_no_question_ends_its_page_alone(
    pages: KernelPages, heard: queue.Queue[Any], front_end: FrontEnd
) -> None:
    for content in (None, 5, {}, {"page": 5}, {"page": "x", "text": "{}"}, {"page": "page"}):
        pages.take(content, [])
    # The message without anything has ended this page.
    assert "lost" in front_end.next()
    for text in ("", "{", '{"id": 1, "do": "__init__"}'):
        other = FrontEnd(pages, heard, f"other{text}")
        assert "title" in other.next()
        pages.take({"page": other.name, "text": text}, [])
        assert "lost" in other.next()
    FrontEnd(pages, heard, "new").ask("column", pixel=[0, 0])


def test_parts_without_end_are_no_question(pages: KernelPages, front_end: FrontEnd) -> None:
    whole = bytes(1 << 22)
    for _ in range(20):
        pages.take({"page": "page", "more": True}, [whole])
    pages.take({"page": "page", "more": False}, [whole])
    assert "lost" in front_end.next()


def test_a_page_hears_that_an_answer_takes_its_time(
    front_end: FrontEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = threading.Event()
    go_on = threading.Event()

    def wait(*arguments: Any, **settings: Any) -> Any:
        begun.set()
        go_on.wait(PATIENCE)
        raise errors.ConvergenceError("the end")

    monkeypatch.setattr(answers, "separate", wait)
    monkeypatch.setattr(kernel_pages, "COMPUTING_SECONDS", 0.05)
    front_end.send("bounces")
    begun.wait(PATIENCE)
    assert front_end.next() == {"page": "page", "computing": True}
    go_on.set()
    assert front_end.next()["error"] == "the end"


def test_the_oldest_of_too_many_pages_gives_way(
    pages: KernelPages, heard: queue.Queue[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_pages, "MAX_PAGES", 3)
    for number in range(9):
        FrontEnd(pages, heard, f"page {number}").next()
    wait_until(lambda: len(pages._clients) == 3)
    assert [*pages._carriers] == ["page 6", "page 7", "page 8"]


def shown(own: ltcl.Transport, heard: queue.Queue[Any]) -> KernelPages:
    """Pages of a transport, with a prepared compensator."""
    scene = ViewerScene(own, "corner", {"grey": np.full(own.grid, 0.2)}, None)
    pages = KernelPages(scene, lambda content, buffers: heard.put((content, buffers)))
    front_end = FrontEnd(pages, heard)
    front_end.ask("compensate", picture=1)
    front_end.ask("adjust", picture=1, gain=0.5)
    return pages


def is_freed(reference: weakref.ref[Any]) -> bool:
    gc.collect()
    return reference() is None


def test_closing_frees_the_transport(heard: queue.Queue[Any], device: Any) -> None:
    own = ltcl.scenes.dihedral(4, albedo=0.5).transport()
    pages = shown(own, heard)
    references = [weakref.ref(own), weakref.ref(own.operators[0])]
    pages.close()
    pages.close()
    del own
    for reference in references:
        wait_until(lambda reference=reference: is_freed(reference))
    pages.take({"page": "page", "event": "open"}, [])  # a message on its way


def test_a_minute_without_a_page_frees_what_nobody_else_holds(
    heard: queue.Queue[Any], monkeypatch: pytest.MonkeyPatch, device: Any
) -> None:
    monkeypatch.setattr(kernel_pages, "IDLE_SECONDS", 0.05)
    own = ltcl.scenes.dihedral(4, albedo=0.5).transport()
    pages = shown(own, heard)
    reference = weakref.ref(own)
    pages.take({"page": "page", "event": "close"}, [])
    wait_until(lambda: pages._scene.T is None)
    # It is held here, so that the next page finds it.
    again = FrontEnd(pages, heard, "again")
    assert "picture" in again.ask("column", pixel=[0, 0])
    again.leave()
    del own
    wait_until(lambda: is_freed(reference))
    late = FrontEnd(pages, heard, "late")
    assert "run the cell again" in late.next()["lost"]
    pages.close()


def test_the_module_of_a_widget_is_whole() -> None:
    module = page_files.widget_module()
    assert not page_files.IMPORT.search(module)
    assert not page_files.EXPORT.search(module)
    assert module.count("export default") == 1
    for name in ("gl", "panel", "probe", "bounces", "relight", "compensate", "viewer"):
        assert module.count(f"const {name}_js = ") == 1


def test_the_page_of_a_server_has_the_same_markup() -> None:
    files = page_files.read_page()
    assert page_files.MARKUP not in files
    assert b'class="viewer"' in files["index.html"]
    assert page_files.PLACE_OF_MARKUP.encode() not in files["index.html"]


# ---- the widget itself


@pytest.fixture
def widget_class() -> Any:
    pytest.importorskip("anywidget", reason='pip install "ltcl[notebook]"')
    from ltcl.viewer.widget import ViewerWidget

    return ViewerWidget


def test_a_widget_shows_a_picture_where_it_is_not_alive(
    T: ltcl.Transport, widget_class: Any
) -> None:
    with ltcl.view(T, how="notebook", title="corner") as widget:
        data, _ = widget._repr_mimebundle_()
        assert data["application/vnd.jupyter.widget-view+json"]["model_id"] == widget.model_id
        picture = Image.open(io.BytesIO(base64.b64decode(data["image/png"])))
        assert picture.format == "PNG"
        codes = np.asarray(picture.convert("RGB")).astype(int)
        assert codes.max() == 255
        assert len(np.unique(codes.reshape(-1, 3), axis=0)) > 20
    assert widget.comm is None


def test_a_widget_takes_messages_and_sends_answers(
    T: ltcl.Transport, widget_class: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: queue.Queue[Any] = queue.Queue()
    with ltcl.view(T, how="notebook") as widget:
        monkeypatch.setattr(widget, "send", lambda *message: heard.put(message))

        def receive(content: Any, buffers: Any) -> None:
            widget._handle_custom_msg(content, [memoryview(part) for part in buffers])

        pages: Any = type("Pages", (), {"take": staticmethod(receive)})
        front_end = FrontEnd(pages, heard)
        codes = np.full((*T.grid, 1), 255, np.uint8)
        seen = front_end.ask("relight", {"pattern": codes})["picture"]
        np.testing.assert_allclose(seen, T @ np.ones(T.grid), rtol=1e-5)


def test_the_way_is_chosen_by_where_it_runs(
    T: ltcl.Transport, widget_class: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ltcl.view(T, open_browser=False) as viewer:
        assert viewer.url
    shell: Any = SimpleNamespace(kernel=object())
    ipython: Any = SimpleNamespace(get_ipython=lambda: shell)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    with ltcl.view(T) as widget:
        assert isinstance(widget, widget_class)
    with ltcl.view(T, open_browser=False) as viewer:
        assert viewer.url
    with ltcl.view(T, how="browser", open_browser=False) as viewer:
        assert viewer.url
    shell.kernel = None
    with ltcl.view(T, open_browser=False) as viewer:
        assert viewer.url


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"how": "frame"}, "how"),
        ({"how": "notebook", "port": 8123}, "port"),
        ({"how": "notebook", "origin": "http://localhost:9000"}, "origin"),
        ({"how": "notebook", "open_browser": False}, "open_browser"),
    ],
)
def test_what_does_not_go_together_is_refused(
    T: ltcl.Transport, settings: dict[str, Any], name: str
) -> None:
    with pytest.raises(errors.InputError, match=f"{name} is"):
        ltcl.view(T, **settings)


@pytest.mark.slow
def test_without_the_extra_one_line_says_how_to_get_it() -> None:
    code = "import sys; sys.modules['anywidget'] = None; import ltcl, numpy; "
    code += "ltcl.view(ltcl.Transport(numpy.eye(2), (1, 2)), how='notebook')"
    folder = Path(ltcl.__file__).parents[1]
    words = [sys.executable, "-c", code]
    run = subprocess.run(words, capture_output=True, text=True, cwd=folder)
    assert run.stderr.splitlines()[-1].endswith('pip install "ltcl[notebook]"')
