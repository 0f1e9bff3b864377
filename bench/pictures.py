# SPDX-License-Identifier: BSD-3-Clause
"""The pictures of README and viewer: a corner of 256 x 512 pixels, from photographs alone.

Two walls of different colours, with tiles and stains, meet in a corner. A virtual camera of 12
bits photographs them under the patterns of a sketch, which becomes T. With T a picture is
compensated; and the light of the same picture, projected as it is, is taken apart. What the walls
show is computed with their true transport.

`--plot` draws the walls, `--viewer` writes what Chromium shows of `ltcl view`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _corner import TexturedCorner
from _figures import Claim
from _harness import Options, parse_options
from ltcl import Transport, plots
from ltcl.acquisition import Report, acquire
from ltcl.files import replace_file
from ltcl.scenes import camera, dihedral, landscape
from sketch import CountingRig, unit
from viewer import OPEN_TAB, Chromium

# Rows of the walls, and pixels along a side of the cells between which light bounces.
ROWS = 256
SMOKE_ROWS = 16
CELL_SIDE = 2
# Albedo of the walls in red, green and blue, where their texture is brightest.
LEFT_ALBEDO = (0.95, 0.65, 0.5)
RIGHT_ALBEDO = (0.6, 0.8, 0.95)
# Light of the desired picture where the landscape is black: bounces reach every place.
DESIRED_BASE = 0.02
BOUNCES = 3
# Strength of bounces as they are drawn, relative to direct light.
BOUNCE_STRENGTH = 0.6
MAX_ERROR = 0.02
MIN_PLAIN_ERROR = 0.3
PAGE_WIDTH = 1400
# Pixels of a view of the walls along its longer side, before it is scaled to the page.
VIEW_SIZE = 800
# Pixels of the viewer's window, in which a pixel of the large picture takes 2 x 2.
WINDOW = (1525, 764)
JPEG_QUALITY = 88
VIEWER_READY = "#compensate-more:not([hidden])"


@dataclass(frozen=True, kw_only=True)
class Walls:
    """The walls under the picture as it is, and under the pattern of ltcl, (h, w, 3).

    `plain` and `seen` are the walls by their true transport, `parts` the direct light and the
    bounces of `plain`.
    """

    desired: np.ndarray
    plain: np.ndarray
    pattern: np.ndarray
    seen: np.ndarray
    parts: list[np.ndarray]
    gain: float


def coloured_corner(options: Options) -> Transport:
    """The true transport of the walls."""
    rows = SMOKE_ROWS if options.smoke else ROWS
    channels = []
    for channel, sides in enumerate(zip(LEFT_ALBEDO, RIGHT_ALBEDO, strict=True)):
        albedo = np.repeat(sides, rows)
        cells = rows // CELL_SIDE
        channels.append(TexturedCorner(cells, albedo, step=CELL_SIDE, seed=channel))
    direct = np.stack([channel.first_bounce for channel in channels])
    return Transport(channels, (rows, 2 * rows), first_bounce=direct, device=options.device)


def scan(truth: Transport, options: Options) -> tuple[Transport, dict[str, Any]]:
    """T of photographs, in the units of the truth, and facts of the scan."""
    rig = CountingRig(truth, truth.grid, response="linear", bits=12, ambient=0.01, seed=2)
    with TemporaryDirectory() as name:
        path = Path(name) / "T.zarr"
        start = time.perf_counter()
        T = acquire(rig, geometry="aligned", strategy="sketch", store=path, device=options.device)
        report = Report.of(path)
        facts = {
            "photographs": rig.count,
            "scan, s": time.perf_counter() - start,
            "bytes of T": T.nbytes,
            "error of T p that the scan states": report.judged_error,
            "the camera's unit of light": ", ".join(f"{scale:.4f}" for scale in unit(T, truth)),
        }
    return T, facts


def view(picture: np.ndarray) -> np.ndarray:
    """The walls as the viewer sees them, (H, W, 3)."""
    corner = dihedral(2)
    light = np.asarray(picture, np.float32)
    return camera.draw(corner.viewer, corner.walls, light, VIEW_SIZE, 2)


def wanted(grid: tuple[int, int]) -> np.ndarray:
    """The picture that looks flat to the viewer, (h, w, 3)."""
    corner = dihedral(2)
    flat = DESIRED_BASE + (1.0 - DESIRED_BASE) * landscape(640, 1024)
    return camera.read(corner.viewer, corner.walls, flat, grid)


def show(T: Transport, truth: Transport, facts: dict[str, Any]) -> Walls:
    """Compensate a picture and take its light apart, by T; look at the walls, by the truth."""
    desired = wanted(truth.grid)
    start = time.perf_counter()
    compensation = ltcl.compensate(T, desired, gain="auto")
    facts["compensation, s"] = time.perf_counter() - start
    facts["gain"] = compensation.gain
    facts["clipped"] = compensation.clipped
    plain = truth @ desired
    start = time.perf_counter()
    separation = ltcl.separate(T, plain, BOUNCES)
    facts["separation, s"] = time.perf_counter() - start
    return Walls(
        desired=desired,
        plain=plain,
        pattern=compensation.pattern,
        seen=truth @ compensation.pattern,
        parts=[separation.direct, *separation.bounces],
        gain=compensation.gain,
    )


def exposure(seen: np.ndarray, desired: np.ndarray) -> float:
    """The brightness at which what is seen comes closest to the desired picture."""
    return float(np.vdot(seen, desired) / np.vdot(seen, seen))


def error(seen: np.ndarray, desired: np.ndarray) -> float:
    """Relative error at the best exposure."""
    difference = exposure(seen, desired) * seen - desired
    return float(np.linalg.norm(difference) / np.linalg.norm(desired))


def draw(walls: Walls, facts: dict[str, Any]) -> Figure:
    """The desired picture, the walls without and with compensation, and the bounces."""
    desired = walls.desired
    plain_exposure = exposure(walls.plain, desired)
    seen_exposure = exposure(walls.seen, desired)
    plain_error = 100 * error(walls.plain, desired)
    seen_error = 100 * error(walls.seen, desired)
    plain_label = (
        f"Projected as it is\n{plain_error:.0f} % error: tiles, and light of the other wall"
    )
    pattern_label = f"The pattern that ltcl finds\nfrom {facts['photographs']} photographs"
    brightness = f"{100 * walls.gain:.0f} % of the brightness"
    seen_label = f"What the walls show then\n{seen_error:.1f} % error, {brightness}"
    first_row = {
        "Desired\na flat picture, on two walls of tiles": view(desired),
        plain_label: view(plain_exposure * walls.plain),
    }
    second_row = {
        pattern_label: view(walls.pattern),
        seen_label: view(seen_exposure * walls.seen),
    }
    direct_light = np.linalg.norm(walls.parts[0])
    bounces = {}
    for number, part in enumerate(walls.parts):
        if number == 0:
            label = "Direct light\nas bright as above"
            times = 1.0
        else:
            times = BOUNCE_STRENGTH * float(direct_light / np.linalg.norm(part))
            label = f"Bounce {number}\n{times:.0f} times as bright"
        bounces[label] = view(times * plain_exposure * part)
    h, w = desired.shape[:2]
    subtitle = (
        f"{h} x {w} pixels. Below: the light of the picture as it is, taken apart by how often it"
        " went from wall to wall."
    )
    return plots.pictures(
        first_row,
        second_row,
        bounces,
        title="A picture projected into a coloured corner",
        subtitle=subtitle,
        width=PAGE_WIDTH,
    )


def photograph_viewer(T: Transport, file: Path) -> None:
    """Write what Chromium shows of a compensation in the viewer, as JPEG."""
    pictures = {"landscape.jpg": landscape(*T.grid)}
    with (
        ltcl.view(T, pictures, open_browser=False, title="corner.npz") as viewer,
        Chromium() as page,
    ):
        page.resize(*WINDOW)
        page.open(viewer.url)
        page.evaluate(OPEN_TAB, "compensate")
        page.wait(VIEWER_READY, ".viewer[data-state=ready]")
        shot = page.screenshot(JPEG_QUALITY)
    with replace_file(file) as temporary:
        temporary.write_bytes(shot)


def claims(walls: Walls) -> list[Claim]:
    """Check that compensation helps."""
    plain = error(walls.plain, walls.desired)
    seen = error(walls.seen, walls.desired)
    return [
        Claim(
            "projected as it is",
            f"{plain:.1%}",
            f"above {MIN_PLAIN_ERROR:.0%}",
            plain > MIN_PLAIN_ERROR,
        ),
        Claim("compensated", f"{seen:.1%}", f"at most {MAX_ERROR:.0%}", seen <= MAX_ERROR),
    ]


def main() -> None:
    """Run the bench."""
    viewer_file = {"viewer": {"type": Path, "help": "write a picture of the viewer to this JPEG"}}
    options = parse_options(__doc__, viewer_file)
    truth = coloured_corner(options)
    T, facts = scan(truth, options)
    walls = show(T, truth, facts)
    if options.arguments.viewer is not None:
        photograph_viewer(T, options.arguments.viewer)
    checked = [] if options.smoke else claims(walls)
    figures.conclude(options, "A corner in pictures", checked, facts, lambda: draw(walls, facts))


if __name__ == "__main__":
    main()
