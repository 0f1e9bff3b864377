# SPDX-License-Identifier: BSD-3-Clause
"""A camera that is not aligned with the projector: how well T comes out, by size of its pixels and noise.

A corner of 16 x 16 projector pixels, each wall 16 x 8, of which the exact transport is known. A
virtual camera sees it askance; its pixels integrate over their area, straddle projector pixels, and
miss two or three of these at a corner of the picture. Which pixel sees which is found by Gray code,
the camera's response from photographs, and T is scanned pixel by pixel. Then T p is compared for
held patterns of noise, of stripes and of smooth light, in the camera's own unit (its last code), on
all pixels that are not masked. Ten more cameras stand at random: 3 to 4.5 pixels to a projector
pixel's side, shifted by up to a projector pixel, every other one turned; they see all of the
picture and its rim, or some of it.

With Mitsuba 3 a rendered corner of unlike albedos is acquired from a camera half a wall beside the
projector, and a picture on it is compensated. It is compared with pictures that nothing scanned,
rendered from the projector's own place, where camera and projector pixels are the same: diffuse
walls are as bright from there. Pixels with all neighbours well seen count; at the outline of the
walls a projector pixel is partly dark.

Where the photographs of a real set-up lie beside the checkout, their Gray code is decoded: 42
photographs, 1280 x 1024, of a chessboard under Gray code for 1024 x 768, and the calibration that
their authors found, who count a step of the code as two projector pixels.
"""

from __future__ import annotations

import importlib.util
import itertools
from collections import namedtuple
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import scipy.ndimage
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _coefficients import relative_error
from _figures import Claim
from _harness import parse_options
from acquire import CAMERAS, corner, held
from ltcl.acquisition import Calibration, MitsubaRig, Report, VirtualRig, acquire, camera_map
from ltcl.acquisition.geometry import decode
from ltcl.device import Device
from ltcl.images import to_srgb

N = 16
SIZES, CLAIMED = (1.5, 2.0, 3.0, 4.0), (3.0, 4.0)
NOISES = {"10000 electrons": (10000.0, 0.0005), "2000": (2000.0, 0.002), "500": (500.0, 0.005)}
KINDS = {"noise": slice(0, 2), "stripes": slice(2, 3), "smooth": slice(3, 6)}
PLACES, PLACED = 10, (3.0, 4.5)  # cameras at random, and camera pixels to a side
LIMIT, RENDERED, AT_RANDOM = 0.02, 0.04, 0.01
ALBEDO = [(0.8, 0.8, 0.8), (0.4, 0.4, 0.4)]  # of the rendered corner
SIZE, BASELINE, FINE = (
    3.5,
    0.5,
    512,
)  # camera pixels to one of the projector's; of walls; paths of the truth
FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "graycode-real"
BOARD_GRID, STEP = (768, 1024), 2.0
LIT = 30  # codes that white shows more than black


# A camera: pixels to a projector pixel's side, place on the projector's grid, (H, W), and its
# noise.
View = namedtuple("View", "size place grid seed", defaults=[2])


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
        return N * (1.123 * a + 0.054 * b - 0.043) / d - 0.9, N * (
            1.145 * b - 0.042 * a - 0.053
        ) / d - 0.5

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


def measured(device: Device, truth: np.ndarray, view: View, camera: str, noise: str) -> Found:
    (response, bits), (electrons, read) = CAMERAS[camera], NOISES[noise]
    C = camera_map(view.place, view.grid, (N, N), points=16)
    common: dict[str, Any] = {"response": response, "bits": bits, "gain": electrons, "read": read}
    common |= {"camera_grid": view.grid, "camera_map": C, "ambient": 0.01, "seed": view.seed}
    rig = VirtualRig(truth, (N, N), **common)
    with TemporaryDirectory() as folder:
        T = acquire(rig, strategy="pixel", store=Path(folder) / "T.zarr", device=device)
        P, seen = held(N), ~T.masked
        ours = np.asarray(T @ P.T.reshape(-1, N, N), np.float64).reshape(P.shape[1], -1).T[seen]
        white = np.asarray(T @ np.ones((N, N)), np.float64).ravel()[seen]
    theirs = truth.sum(axis=1)[seen]
    wanted = (truth @ P)[seen]
    ours *= (white @ theirs) / (white @ white)
    errors = {name: relative_error(ours[:, some], wanted[:, some]) for name, some in KINDS.items()}
    return Found(view.size, camera, noise, errors, int(np.count_nonzero(~seen)))


@dataclass(frozen=True)
class Loop:
    """Largest error of T p of held patterns; pictures of the camera (H, W), linear, 1 is the brightest."""

    error: float
    photographs: int
    decibels: list[float]
    before: np.ndarray
    after: np.ndarray
    desired: np.ndarray
    pattern: np.ndarray


def rendered(n: int, samples: int, patterns: np.ndarray, device: Device) -> Loop:
    """Acquire a corner of 3 n / 4 x n pixels, and compensate a picture on it."""
    h, w = grid = patterns.shape[1:]
    common: dict[str, Any] = {"channels": 1, "albedo": ALBEDO}
    place = {"camera_grid": (round(SIZE * h), round(SIZE * n)), "baseline": BASELINE}
    rig = MitsubaRig("dihedral", grid, samples=samples, bits=12, **place, **common)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "T.zarr"
        T = acquire(rig, strategy="pixel", store=path, device=device)
        found, photographs = Calibration.of(path), Report.of(path).photographs
        linear = {"projector_response": "linear", "sensitivity": rig.describe()["sensitivity"]}
        truth = MitsubaRig("dihedral", grid, samples=FINE, seed=9, **linear, **common)
        inner: Any = scipy.ndimage.binary_erosion(found.resampling.coverage > 0.8, np.ones((3, 3)))
        white = np.ones(grid, np.float32)
        ours, theirs = np.asarray(T @ white, np.float64)[inner], truth.radiance(white)[inner]
        unit = ours @ theirs / (ours @ ours)
        errors = [
            relative_error(unit * np.asarray(T @ p)[inner], truth.radiance(p)[inner])
            for p in patterns
        ]
        y, x = np.mgrid[:h, :w] / w
        desired, level = (
            0.55 + 0.45 * np.sin(19 * np.hypot(x - 0.5, y - 0.37)),
            0.7 * np.quantile(ours, 0.05),
        )
        pattern = ltcl.compensate(T, (level * desired).astype(np.float32), rtol=1e-3).pattern
    both = desired * level / np.median(ours), np.clip(np.asarray(pattern, np.float64), 0.0, 1.0)
    decibels = [_decibels(truth.radiance(p)[inner], desired[inner]) for p in both]
    views = np.stack([rig.radiance(found.projector.codes(p)) for p in both])
    before, after = views / np.quantile(views, 0.995, axis=(1, 2)).max()
    return Loop(max(errors), photographs, decibels, before, after, desired, both[1])


def _decibels(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal b over noise of a, at the best scale."""
    return float(10 * np.log10(b.max() ** 2 / np.mean((a * (a @ b) / (a @ a) - b) ** 2)))


def photographed(folder: Path = FOLDER) -> dict[str, float | str]:
    """What is decoded, how flat the board is, and whether the authors' calibration agrees."""
    if not folder.is_dir():
        return {"real photographs": f"left out, {folder.name} is not beside the checkout"}
    paths = sorted(folder.glob("graycode_*.png"))
    photographs = [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths]
    found, white = decode(photographs, BOARD_GRID), photographs[-2]
    lit = white.astype(np.float32) - photographs[-1] > LIT
    _, corners = cv2.findChessboardCorners(white, (7, 9))
    hull = cv2.convexHull(corners.astype(np.float32)).astype(np.int32)
    board = found.valid & (cv2.fillConvexPoly(np.zeros(white.shape, np.uint8), hull, (1,)) > 0)
    camera = np.stack(np.nonzero(board)[::-1], axis=1).astype(np.float64)
    projector = np.stack([found.x[board], found.y[board]], axis=1).astype(np.float64)
    H, _ = cv2.findHomography(camera, projector, cv2.RANSAC, 1.0)
    distance = np.linalg.norm(
        cv2.perspectiveTransform(camera[:, None], H)[:, 0] - projector, axis=1
    )
    back, ahead = _reprojected(camera[::20], STEP * projector[::20], folder)
    return {
        "real photographs, lit pixels decoded": float(found.valid[lit].mean()),
        "real, from a homography on the board, median of projector pixels": float(
            np.median(distance)
        ),
        "real, from a homography on the board, rms": float(np.sqrt(np.mean(distance**2))),
        "real, reprojected by the authors' calibration, rms of projector pixels": back,
        "real, and of camera pixels (its own residual is 0.86)": ahead,
    }


def _reprojected(camera: np.ndarray, projector: np.ndarray, folder: Path) -> list[float]:
    """Points triangulated by the calibration, back in the projector and in the camera: rms distances."""
    file = cv2.FileStorage(str(folder / "calibration_result.xml"), cv2.FILE_STORAGE_READ)
    names = ("cam_int", "cam_dist", "proj_int", "proj_dist", "roration", "translation")
    K, D, P, E, R, t = (file.getNode(name).mat() for name in names)
    lenses = ((camera, (K, D)), (projector, (P, E)))
    rays = [cv2.undistortPoints(seen[:, None], *lens)[:, 0] for seen, lens in lenses]
    X = cv2.triangulatePoints(np.eye(3, 4), np.hstack([R, t.reshape(3, 1)]), rays[0].T, rays[1].T)
    X, still = (X[:3] / X[3]).T, np.zeros(3)
    off = (
        cv2.projectPoints(X, cv2.Rodrigues(R)[0], t, P, E)[0][:, 0] - projector,
        cv2.projectPoints(X, still, still, K, D)[0][:, 0] - camera,
    )
    return [float(np.sqrt(np.mean(np.sum(distance**2, axis=1)))) for distance in off]


def claims(found: list[Found], cameras: list[Found], loop: Loop | None) -> list[Claim]:
    listed = []
    for one in found:
        if one.size in CLAIMED and one.noise == next(iter(NOISES)):
            text = f"T p of held patterns, {one.size:g} camera pixels to a side, {one.camera}"
            listed.append(Claim(text, str(one), "at most 2 %", one.worst <= LIMIT))
    worst = [one.worst for one in cameras]
    text = (
        f"T p of held patterns, {len(cameras)} cameras at random, 3 to 4.5 camera pixels to a side"
    )
    measured = f"median {np.median(worst):.2%}, worst {max(worst):.2%}"
    listed.append(Claim(text, measured, "at most 1 %, each", max(worst) <= AT_RANDOM))
    if loop is not None:
        (before, after), error = loop.decibels, loop.error
        text = "T p on a rendered corner, against renders from the projector's place"
        listed.append(Claim(text, f"{error:.2%}", "at most 4 %", error <= RENDERED))
        text = "a picture compensated on it comes nearer to what was asked for"
        measured = f"{before:.1f} dB, then {after:.1f} dB"
        listed.append(Claim(text, measured, "10 dB more", after >= before + 10))
    return listed


def facts(found: list[Found], cameras: list[Found], loop: Loop | None) -> dict[str, Any]:
    lines: dict[str, Any] = {"projector pixels": N * N}
    names = [f"{one.size:g} camera pixels, {one.camera}, {one.noise}" for one in found]
    names += [
        f"at random, seed {seed}, {one.size:.2f} camera pixels" for seed, one in enumerate(cameras)
    ]
    lines |= {
        n: f"{o}; {o.masked} pixels masked" for n, o in zip(names, found + cameras, strict=True)
    }
    lines["rendered corner"] = "left out, mitsuba is not installed"
    if loop is not None:
        lines["rendered corner"] = (
            f"{loop.pattern.shape}, {loop.photographs} photographs of the scan"
        )
    return lines | photographed()


def draw(found: list[Found], cameras: list[Found], loop: Loop | None) -> Figure:
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
    axes.plot(
        sizes, worst, "x", color=figures.FAINT, label=f"{len(cameras)} cameras at random, worst"
    )
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
        views: list[tuple[Any, ...]] = [
            (loop.desired, "asked for", "on the projector's pixels"),
            (loop.pattern, "pattern", "what the projector sends"),
            (loop.before, "before", f"the picture itself sent: {before:.1f} dB"),
            (loop.after, "after", f"the pattern sent: {after:.1f} dB"),
        ]
        for k, (image, *text) in enumerate(views):
            codes = to_srgb(np.clip(image / max(float(image.max()), 1e-9), 0, 1))
            views[k] = np.repeat(codes[..., None], 3, -1), *text
        figures.pictures(figure, 480, views)
    return figure


def _percent(axes: Axes) -> None:
    """Errors in per cent, and a line at the limit."""
    ticks = [0.002, 0.005, 0.01, 0.02, 0.05, 0.1]
    axes.set_yticks(ticks, [f"{100 * tick:g} %" for tick in ticks])
    axes.minorticks_off()
    axes.axhline(LIMIT, color=figures.FAINT, lw=1)


def main() -> None:
    given = parse_options(__doc__ or "")
    run, loop = partial(measured, given.device, corner(N)), None
    kinds, quiet = list(CAMERAS), next(iter(NOISES))
    seen, sizes, louder, seeds = kinds, SIZES, list(NOISES)[1:], range(PLACES)
    if given.smoke:
        seen, sizes, louder, seeds = kinds[:1], CLAIMED[:1], (), range(1)
    found = [run(askance(size), camera, quiet) for camera in seen for size in sizes]
    found += [run(askance(3.0), kinds[-1], noise) for noise in louder]
    cameras = [run(at_random(seed), kinds[-1], quiet) for seed in seeds]
    if importlib.util.find_spec("mitsuba") is not None:
        n = 12 if given.smoke else 24
        patterns = held(n).T.reshape(-1, n, n)[:, : 3 * n // 4].astype(np.float32)
        loop = rendered(n, 16 if given.smoke else 32, patterns, given.device)
    title, results = "A camera that is not aligned with the projector", (found, cameras, loop)
    figures.conclude(given, title, claims(*results), facts(*results), lambda: draw(*results))


if __name__ == "__main__":
    main()
