# SPDX-License-Identifier: BSD-3-Clause
"""A camera that is not aligned with the projector: how well T comes out, by size of its pixels and noise.

A corner of 16 x 16 projector pixels, each wall 16 x 8, of which the exact transport is known. A virtual
camera sees it askance; its pixels integrate over their area, straddle projector pixels, and miss two or three
of these at a corner of the picture. Which pixel sees which is found by Gray code, the camera's response from
photographs, and T is scanned pixel by pixel. Then T p is compared for held patterns of noise, of stripes and
of smooth light, in the camera's own unit (its last code), on all pixels that are not masked. Ten more cameras
stand at random: 3 to 4.5 pixels to a projector pixel's side, shifted by up to a projector pixel, every other
one turned; they see all of the picture and its rim, or some of it.

With Mitsuba 3 a rendered corner is acquired from a camera beside the projector, and a picture on it is
compensated. Where the photographs of a real set-up lie beside the checkout, their Gray code is decoded.
"""

from __future__ import annotations

import importlib.util
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import _board as board
import _figures as figures
import _rendered as rendered
from _figures import Claim
from _harness import Options, options
from acquire import corner, held
from ltcl.acquisition import VirtualRig, acquire, camera_map
from ltcl.images import to_srgb

N = 16
SIZES, CLAIMED = (1.5, 2.0, 3.0, 4.0), (3.0, 4.0)
CAMERAS = {"srgb, 8 bits": ("srgb", 8), "film, 12 bits": ("film", 12)}
NOISES = {"10000 electrons": (10000.0, 0.0005), "2000": (2000.0, 0.002), "500": (500.0, 0.005)}
KINDS = {"noise": slice(0, 2), "stripes": slice(2, 3), "smooth": slice(3, 6)}
PLACES, PLACED = 10, (3.0, 4.5)  # cameras at random, and camera pixels to a side
LIMIT, RENDERED, AT_RANDOM = 0.02, 0.04, 0.01


@dataclass(frozen=True)
class View:
    """A camera: pixels to a projector pixel's side, place on the projector's grid, size, and its noise."""

    size: float
    place: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    grid: tuple[int, int]
    seed: int = 2


@dataclass(frozen=True)
class Found:
    """Largest relative error of T p of each kind of pattern, and projector pixels that are masked."""

    size: float
    camera: str
    noise: str
    errors: dict[str, float]
    masked: int

    def __str__(self) -> str:
        return ", ".join(f"{kind} {error:.2%}" for kind, error in self.errors.items())

    @property
    def worst(self) -> float:
        """Of all kinds."""
        return max(self.errors.values())


def askance(size: float) -> View:
    """A camera with `size` pixels to one of the projector's, in perspective and turned."""
    H = W = int(np.ceil(1.12 * size * N))

    def place(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = (u + 0.5) / W, (v + 0.5) / H
        d = 1 + 0.15 * a - 0.09 * b
        return N * (1.123 * a + 0.054 * b - 0.043) / d - 0.9, N * (1.145 * b - 0.042 * a - 0.053) / d - 0.5

    return View(size, place, (H, W))


def at_random(seed: int) -> View:
    """A camera before the wall, of any size and place; turned if the seed is odd."""
    rng = np.random.default_rng(seed)
    size, (dx, dy) = rng.uniform(*PLACED), rng.uniform(-1, 1, 2)
    turn = rng.uniform(-0.1, 0.1) if seed % 2 else 0.0
    H = W = int(1.25 * size * N)
    middle, c, s = (N - 1) / 2, np.cos(turn) / size, np.sin(turn) / size

    def place(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = u - W / 2, v - H / 2
        return c * a + s * b + middle + dx, c * b - s * a + middle + dy

    return View(float(size), place, (H, W), seed)


def measured(given: Options, truth: np.ndarray, view: View, camera: str, noise: str) -> Found:
    """Acquire and compare."""
    (response, bits), (electrons, read) = CAMERAS[camera], NOISES[noise]
    C = camera_map(view.place, view.grid, (N, N), points=16)
    common: dict[str, Any] = {"response": response, "bits": bits, "gain": electrons, "read": read}
    common |= {"camera_grid": view.grid, "camera_map": C, "ambient": 0.01, "seed": view.seed}
    rig = VirtualRig(truth, (N, N), **common)
    with TemporaryDirectory() as folder:
        T = acquire(rig, strategy="pixel", store=Path(folder) / "T.zarr", device=given.device)
        P, seen = held(N), ~T.masked
        ours = np.asarray(T @ P.T.reshape(-1, N, N), np.float64).reshape(P.shape[1], -1).T[seen]
        white = np.asarray(T @ np.ones((N, N)), np.float64).ravel()[seen]
    theirs = truth.sum(axis=1)[seen]
    wanted = (truth @ P)[seen]
    off = np.linalg.norm((white @ theirs) / (white @ white) * ours - wanted, axis=0)
    relative = off / np.linalg.norm(wanted, axis=0)
    errors = {name: float(relative[part].max()) for name, part in KINDS.items()}
    return Found(view.size, camera, noise, errors, int(np.count_nonzero(~seen)))


def virtual(given: Options) -> list[Found]:
    """All sizes with the least noise, and more noise with three camera pixels to a projector pixel."""
    truth, quiet = corner(N), next(iter(NOISES))
    cameras = list(CAMERAS)[:1] if given.smoke else list(CAMERAS)
    sizes = CLAIMED[:1] if given.smoke else SIZES
    found = [measured(given, truth, askance(size), camera, quiet) for camera in cameras for size in sizes]
    louder = () if given.smoke else list(NOISES)[1:]
    return found + [measured(given, truth, askance(3.0), cameras[-1], noise) for noise in louder]


def placed(given: Options) -> list[Found]:
    """Cameras at random, of 12 bits and with the least noise."""
    truth, camera, quiet = corner(N), list(CAMERAS)[-1], next(iter(NOISES))
    seeds = range(2 if given.smoke else PLACES)
    return [measured(given, truth, at_random(seed), camera, quiet) for seed in seeds]


def claims(found: list[Found], cameras: list[Found], loop: rendered.Loop | None) -> list[Claim]:
    """What has to hold."""
    listed = []
    for one in found:
        if one.size in CLAIMED and one.noise == next(iter(NOISES)):
            text = f"T p of held patterns, {one.size:g} camera pixels to a side, {one.camera}"
            listed.append(Claim(text, str(one), "at most 2 %", one.worst <= LIMIT))
    worst = [one.worst for one in cameras]
    text = f"T p of held patterns, {len(cameras)} cameras at random, 3 to 4.5 camera pixels to a side"
    measured = f"median {np.median(worst):.2%}, worst {max(worst):.2%}"
    listed.append(Claim(text, measured, "at most 1 %, each", max(worst) <= AT_RANDOM))
    if loop is not None:
        (before, after), error = loop.decibels, float(loop.errors.max())
        text = "T p on a rendered corner, against renders from the projector's place"
        listed.append(Claim(text, f"{error:.2%}", "at most 4 %", error <= RENDERED))
        text = "a picture compensated on it comes nearer to what was asked for"
        measured = f"{before:.1f} dB, then {after:.1f} dB"
        listed.append(Claim(text, measured, "10 dB more", after >= before + 10))
    return listed


def facts(found: list[Found], cameras: list[Found], loop: rendered.Loop | None) -> dict[str, Any]:
    """A line for each acquisition, and the real photographs."""
    lines: dict[str, Any] = {"projector pixels": N * N}
    names = [f"{one.size:g} camera pixels, {one.camera}, {one.noise}" for one in found]
    names += [f"at random, seed {seed}, {one.size:.2f} camera pixels" for seed, one in enumerate(cameras)]
    lines |= {n: f"{o}; {o.masked} pixels masked" for n, o in zip(names, found + cameras, strict=True)}
    lines["rendered corner"] = "left out, mitsuba is not installed"
    if loop is not None:
        lines["rendered corner"] = f"{loop.pattern.shape}, {loop.photographs} photographs of the scan"
    return lines | board.facts()


def draw(found: list[Found], cameras: list[Found], loop: rendered.Loop | None) -> Figure:
    """Errors against the size of camera pixels and against noise; the rendered corner below."""
    figure = figures.page(
        430 if loop is None else 720,
        "A camera that is not aligned with the projector",
        "Above: largest error of T p over held patterns, of a corner with 16 x 16 projector pixels",
        "seen askance. Below: a rendered corner, by a camera half a wall beside the projector.",
    )
    styles, quiet = dict(zip(KINDS, ("-", "--", ":"), strict=True)), next(iter(NOISES))
    xlabel = "camera pixels to a projector pixel's side"
    axes = figures.graph(figure, (80, 140, 400, 220), "By size", xlabel, "")
    for (number, camera), (kind, style) in itertools.product(enumerate(CAMERAS), styles.items()):
        some = [one for one in found if one.camera == camera and one.noise == quiet]
        look: Any = {"color": f"C{number}", "marker": "o", "label": f"{camera}, {kind}"}
        axes.plot([one.size for one in some], [one.errors[kind] for one in some], style, **look)
    sizes, worst = [one.size for one in cameras], [one.worst for one in cameras]
    axes.plot(sizes, worst, "x", color=figures.FAINT, label=f"{len(cameras)} cameras at random, worst")
    _percent(axes)
    axes.legend(frameon=False, labelcolor=figures.FAINT, fontsize=8.5)
    title, xlabel = "By noise, 3 camera pixels", "electrons at full scale"
    axes = figures.graph(figure, (580, 140, 380, 220), title, xlabel, "")
    some = [one for one in found if one.size == 3.0 and one.camera == found[-1].camera]
    electrons = [NOISES[one.noise][0] for one in some]
    for kind, style in styles.items():
        errors = [one.errors[kind] for one in some]
        axes.plot(electrons, errors, style, color="C1", marker="o", label=kind)
    axes.set_xscale("log")
    axes.set_xticks(electrons, [f"{count:g}" for count in electrons])
    axes.minorticks_off()
    _percent(axes)
    if loop is not None:
        before, after = loop.decibels
        views = [
            (loop.desired, "asked for", "on the projector's pixels"),
            (loop.pattern, "pattern", "what the projector sends"),
            (loop.before, "before", f"the picture itself sent: {before:.1f} dB"),
            (loop.after, "after", f"the pattern sent: {after:.1f} dB"),
        ]
        figures.pictures(figure, 480, [(_grey(image), *text) for image, *text in views])
    return figure


def _grey(image: np.ndarray) -> np.ndarray:
    return np.repeat(to_srgb(np.clip(image / max(float(image.max()), 1e-9), 0, 1))[..., None], 3, -1)


def _percent(axes: Axes) -> None:
    """Errors in per cent, and a line at the limit."""
    ticks = [0.002, 0.005, 0.01, 0.02, 0.05, 0.1]
    axes.set_yticks(ticks, [f"{100 * tick:g} %" for tick in ticks])
    axes.minorticks_off()
    axes.axhline(LIMIT, color=figures.FAINT, lw=1)


def main() -> None:
    given = options(__doc__ or "")
    found, cameras, loop = virtual(given), placed(given), None
    if importlib.util.find_spec("mitsuba") is not None:
        n = 12 if given.smoke else 24
        patterns = held(n).T.reshape(-1, n, n)[:, : 3 * n // 4].astype(np.float32)
        loop = rendered.loop(n, 16 if given.smoke else 32, patterns, given.device)
    title, results = "A camera that is not aligned with the projector", (found, cameras, loop)
    figures.conclude(given, title, claims(*results), facts(*results), lambda: draw(*results))


if __name__ == "__main__":
    main()
