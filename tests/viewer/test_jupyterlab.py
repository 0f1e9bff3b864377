# SPDX-License-Identifier: BSD-3-Clause
"""The widget in a real JupyterLab in Chromium: probe, bounces, compensate, two at once, saved."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.images import to_srgb

pytest.importorskip("playwright", reason='playwright is not installed: pip install "ltcl[test]"')
pytest.importorskip("jupyterlab", reason="jupyterlab is not installed: pip install jupyterlab")

from playwright.sync_api import Browser, Locator, Page

pytestmark = pytest.mark.slow
PATIENCE = 180.0  # seconds
TOKEN = "only-for-this-test"  # noqa: S105
ALBEDO = (0.8, 0.5, 0.3)
FIRST_CELL = f"""
import ltcl
corner = ltcl.scenes.dihedral(6, albedo={ALBEDO})
T = corner.transport(first_bounce=corner.first_bounce)
picture = 0.2 + 0.6 * corner.sample(ltcl.scenes.landscape(60, 60))
ltcl.view(T, {{"landscape": picture}}, title="first")
"""
SECOND_CELL = 'second = ltcl.view(T, title="second")\nsecond'
LAST_CELL = "second.close(); print('closed')"
# The prompt of a cell that runs or has run; of others it is "[ ]:", or empty until it is drawn.
RUN = re.compile(r"\[(\*|\d+)\]:")
IDLE = ".jp-Notebook-ExecutionIndicator[data-status=idle]"


class Lab:
    """A JupyterLab with a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.work = folder / "work"
        self.work.mkdir()
        names = ("CONFIG_DIR", "DATA_DIR", "RUNTIME_DIR")
        homes = {f"JUPYTER_{name}": str(folder / name) for name in names}
        root = str(Path(ltcl.__file__).parents[1])
        environment = {**os.environ, **homes, "IPYTHONDIR": str(folder), "PYTHONPATH": root}
        self._log = folder / "log"
        words = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root"]
        settings = {
            "ServerApp.ip": "127.0.0.1",
            "ServerApp.port": "0",
            "ServerApp.root_dir": str(self.work),
            "ServerApp.use_redirect_file": "False",
            "IdentityProvider.token": TOKEN,
        }
        words += [f"--{name}={value}" for name, value in settings.items()]
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(words, stdout=log, stderr=log, env=environment)
        self.url = self._find_url()

    def _find_url(self) -> str:
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end and self.process.poll() is None:
            found = re.search(r"http://127\.0\.0\.1:\d+/(?=lab)", self._log.read_text())
            if found:
                return found[0]
            time.sleep(0.1)
        raise AssertionError(self._log.read_text())

    def write(self, name: str, *cells: str) -> None:
        """Write a notebook of code."""
        entries = []
        for number, source in enumerate(cells):
            entry = {"cell_type": "code", "id": f"cell{number}", "source": source.strip()}
            entries.append({**entry, "metadata": {}, "outputs": [], "execution_count": None})
        spec = {"name": "python3", "display_name": "Python 3", "language": "python"}
        notebook = {"cells": entries, "metadata": {"kernelspec": spec}}
        text = json.dumps({**notebook, "nbformat": 4, "nbformat_minor": 5})
        (self.work / name).write_text(text)

    def end_kernels(self) -> None:
        """End all kernels, as a person does who comes back the next day."""
        query = f"?token={TOKEN}"
        with urllib.request.urlopen(f"{self.url}api/sessions{query}") as response:  # noqa: S310
            sessions = json.load(response)
        for session in sessions:
            address = f"{self.url}api/sessions/{session['id']}{query}"
            urllib.request.urlopen(urllib.request.Request(address, method="DELETE"))  # noqa: S310

    def close(self) -> None:
        """End JupyterLab, with force if it hangs: its kernels notice, and end as well."""
        self.process.terminate()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory, device: Any) -> Iterator[Lab]:
    lab = Lab(tmp_path_factory.mktemp("lab"))
    yield lab
    lab.close()


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    with browser.new_context(viewport={"width": 1280, "height": 1000}) as context:
        context.set_default_timeout(1000 * PATIENCE)
        page = context.new_page()
        wrong: list[str] = []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        yield page
        assert wrong == []


def visit(page: Page, lab: Lab, name: str) -> None:
    page.goto(f"{lab.url}doc/tree/{name}?token={TOKEN}")
    page.wait_for_selector(IDLE)


def run(page: Page, number: int) -> None:
    """Run a cell: the key is pressed until its number shows that it was taken."""
    cell = page.locator(".jp-Cell").nth(number)
    prompt = cell.locator(".jp-InputArea-prompt")
    end = time.monotonic() + PATIENCE
    while not RUN.match(prompt.inner_text()):
        assert time.monotonic() < end, "the cell does not run"
        cell.locator(".cm-content").click()
        page.keyboard.press("Shift+Enter")
        page.wait_for_timeout(1000)


def viewer(page: Page, title: str) -> Locator:
    """The viewer of that title, which is ready."""
    found = page.locator(".viewer", has=page.get_by_role("heading", name=title))
    found.and_(page.locator("[data-state=ready]")).wait_for()
    return found


def pixels(viewer: Locator, name: str) -> tuple[np.ndarray, float]:
    """Return the codes of a canvas, (h, w, 3), and the light that is shown as white."""
    codes, shape, white = viewer.locator(f"#{name}-canvas").evaluate(
        """(c) => { const image = c.getContext("2d").getImageData(0, 0, c.width, c.height);
        return [[...image.data], [c.height, c.width, 4], Number(c.dataset.white ?? 1)]; }"""
    )
    return np.array(codes, np.float64).reshape(shape)[..., :3], white


def shows(viewer: Locator, name: str, light: np.ndarray) -> None:
    """Wait until a canvas has these pixels, to a code; fail with the difference."""
    end = time.monotonic() + PATIENCE
    codes: Any = np.inf
    expected = np.zeros(1)
    while time.monotonic() < end:
        codes, white = pixels(viewer, name)
        expected = 255 * to_srgb(np.clip(light / white, 0, 1))
        if codes.shape == expected.shape and abs(codes - expected).max() <= 1.01:
            return
        time.sleep(0.05)
    np.testing.assert_allclose(codes, expected, atol=1.01)


def test_the_viewer_in_a_notebook(lab: Lab, page: Page) -> None:
    corner = ltcl.scenes.dihedral(6, albedo=ALBEDO)
    T = corner.transport(first_bounce=corner.first_bounce)
    picture = (0.2 + 0.6 * corner.sample(ltcl.scenes.landscape(60, 60))).astype(np.float32)
    lab.write("viewer.ipynb", FIRST_CELL, SECOND_CELL, LAST_CELL)
    visit(page, lab, "viewer.ipynb")
    run(page, 0)
    first = viewer(page, "first")

    # Probe, by keys that the notebook does not hear.
    canvas = first.locator("#probe-projector-canvas")
    canvas.focus()
    for key in ("ArrowRight", "ArrowDown", "b", "x", "l", "l"):
        page.keyboard.press(key)
    row, column = 4, 7
    first.get_by_text(f"row {row}, column {column}").first.wait_for()
    unit = np.zeros(T.grid, np.float32)
    unit[row, column] = 1.0
    shows(first, "probe-camera", T @ unit)
    assert page.locator(".jp-Cell").count() == 3

    first.locator("#tab-bounces").click()
    shows(first, "bounces-mix", picture)
    first.locator("#bounces-0").fill("0")
    separated = ltcl.separate(T, picture, 4)
    shows(first, "bounces-mix", picture - separated.direct)

    first.locator("#tab-compensate").click()
    shows(first, "compensate-pattern", ltcl.compensate(T, picture, gain="auto").pattern)
    with page.expect_download() as download:
        first.locator("#compensate-downloads button").last.click()
    report = json.loads(Path(download.value.path()).read_text())
    assert report["picture"] == "landscape"

    # Another one, which changes nothing in the first.
    before = pixels(first, "compensate-pattern")[0]
    run(page, 1)
    second = viewer(page, "second")
    second.locator("#logarithmic").click()
    second.locator("#tab-relight").click()
    second.locator("#relight-colour").fill("#ff0000")
    second.locator("#relight-fill").click()
    red = np.full((*T.grid, 3), (1.0, 0.0, 0.0), np.float32)
    second.locator("#logarithmic").click()
    shows(second, "relight-seen", T @ red)
    assert first.locator("#logarithmic").get_attribute("aria-pressed") == "false"
    np.testing.assert_array_equal(pixels(first, "compensate-pattern")[0], before)
    assert is_alone(page)

    run(page, 2)
    page.get_by_text("closed", exact=True).wait_for()
    second.wait_for(state="detached")
    page.keyboard.press("Control+s")
    page.wait_for_selector(IDLE)
    check_saved(lab, page)


def is_alone(page: Page) -> bool:
    """True if the notebook's own text looks as without a viewer."""
    return page.locator(".jp-InputArea-editor").first.evaluate(
        """(editor) => {
        const host = document.querySelector("div[class^=ltcl-]"), parent = host.parentElement;
        const look = (element) => {
          const { fontFamily, fontSize, color, colorScheme } = getComputedStyle(element);
          return [fontFamily, fontSize, color, colorScheme];
        };
        const before = String([look(editor), look(parent)]);
        host.remove();
        const after = String([look(editor), look(parent)]);
        parent.append(host);
        return before === after;
        }"""
    )


def check_saved(lab: Lab, page: Page) -> None:
    """The saved notebook has pictures, and shows them where no kernel is."""
    end = time.monotonic() + PATIENCE
    kinds: set[str] = set()
    while "image/png" not in kinds and time.monotonic() < end:
        time.sleep(0.1)
        try:
            notebook = json.loads((lab.work / "viewer.ipynb").read_text())
        except json.JSONDecodeError:  # it is being written
            continue
        outputs = [output for cell in notebook["cells"] for output in cell["outputs"]]
        kinds = {kind for output in outputs for kind in output.get("data", {})}
    assert {"image/png", "application/vnd.jupyter.widget-view+json"} <= kinds
    page.goto("about:blank")
    lab.end_kernels()
    visit(page, lab, "viewer.ipynb")
    pictures = page.locator("img[class^=ltcl-]")
    pictures.first.wait_for()
    assert pictures.count() == 2
    for picture in pictures.all():
        picture.wait_for()
        assert picture.evaluate("(image) => image.naturalWidth") > 300
    assert page.get_by_text("model not found").first.is_hidden()


def test_nothing_serious_stands_in_the_way_of_access(lab: Lab, page: Page) -> None:
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason='pip install "ltcl[test]"'
    ).Axe()
    lab.write("access.ipynb", FIRST_CELL)
    visit(page, lab, "access.ipynb")
    run(page, 0)
    first = viewer(page, "first")
    for view in ("probe", "bounces", "relight", "compensate"):
        first.locator(f"#tab-{view}").click()
        viewer(page, "first")
        # The rest of the page is JupyterLab's.
        response = axe.run(page, context="div[class^=ltcl-]").response
        assert len(response["passes"]) > 10
        violations = response["violations"]
        serious = [each["id"] for each in violations if each["impact"] in ("serious", "critical")]
        assert serious == [], view


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")
def test_nothing_listens_beyond_this_machine(lab: Lab, page: Page) -> None:
    lab.write("ports.ipynb", FIRST_CELL, "import os; print('pid', os.getpid())")
    visit(page, lab, "ports.ipynb")
    run(page, 0)
    viewer(page, "first")
    run(page, 1)
    text = page.get_by_text(re.compile(r"^pid \d+")).inner_text()
    addresses = set(listening(int(text.split()[1])))
    assert addresses  # those of the kernel itself
    assert {address.split(".")[0] for address in addresses} == {"127"}


def listening(pid: int) -> Iterator[str]:
    """Addresses at which a process listens."""
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        inodes.add(link.readlink().name)
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    for line in lines:
        fields = line.split()
        if fields[3] == "0A" and f"socket:[{fields[9]}]" in inodes:
            packed = bytes.fromhex(fields[1].split(":")[0])[::-1]
            yield socket.inet_ntoa(packed)
