# SPDX-License-Identifier: BSD-3-Clause
"""A camera that is not aligned with the projector: accuracy of T, by size of its pixels and noise.

A corner of 16 x 16 projector pixels, each wall 16 x 8, has a known exact transport. A virtual
camera sees it askance; its pixels integrate over their area, straddle projector pixels, and miss
two or three of these at a corner of the picture. Gray code says which pixel sees which, the
camera's response comes from photographs, and T is scanned pixel by pixel. Then T p is compared for
held patterns of noise, of stripes and of smooth light, in the camera's own unit (its last code), on
all pixels that are not masked. Ten more cameras stand at random: 3 to 4.5 pixels to a projector
pixel's side, shifted by up to a projector pixel, every other one turned; they see the whole picture
and its rim, or a part of it.

With Mitsuba 3 a rendered corner of unlike albedos is acquired from a camera half a wall beside the
projector, and a picture on it is compensated. It is compared with pictures that were not scanned,
rendered from the projector's own place, where camera and projector pixels are the same: diffuse
walls are equally bright from there. Pixels with all neighbours well seen count; at the outline of
the walls a projector pixel is partly dark.

With `--photographs FOLDER` Gray code of a real set-up is decoded: 42 photographs, 1280 x 1024, of a
chessboard under Gray code for 1024 x 768, and the calibration that their authors found, who count a
step of the code as two projector pixels.
"""

from __future__ import annotations

import importlib.util
import itertools
from collections.abc import Callable
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
from acquire import CAMERAS, corner, held_patterns
from ltcl.acquisition import Calibration, MitsubaRig, Report, VirtualRig, acquire, camera_map
from ltcl.acquisition.geometry import decode
from ltcl.device import Device
from ltcl.images import to_srgb

N = 16
# Camera pixels to a projector pixel's side, and those whose accuracy is claimed.
SIZES = (1.5, 2.0, 3.0, 4.0)
CLAIMED_SIZES = (3.0, 4.0)
NOISE_SIZE = 3.0
# Electrons at full scale, and read noise.
NOISES = {
    "10000 electrons": (10000.0, 0.0005),
    "2000": (2000.0, 0.002),
    "500": (500.0, 0.005),
}
QUIET = "10000 electrons"
# Columns of the held patterns.
KINDS = {"noise": slice(0, 2), "stripes": slice(2, 3), "smooth": slice(3, 6)}
LINE_STYLES = {"noise": "-", "stripes": "--", "smooth": ":"}
# Cameras at random, and the range of their pixels to a side.
RANDOM_CAMERAS = 10
RANDOM_SIZES = (3.0, 4.5)
# Largest relative errors: askance, of the rendered corner, and of cameras at random.
LIMIT = 0.02
RENDERED_LIMIT = 0.04
RANDOM_LIMIT = 0.01
# Albedo of the rendered corner.
ALBEDO = [(0.8, 0.8, 0.8), (0.4, 0.4, 0.4)]
# Camera pixels to one of the projector's, distance in walls, and paths of the true renders.
RENDERED_SIZE = 3.5
BASELINE = 0.5
TRUE_SAMPLES = 512
# The real set-up: projector pixels, projector pixels of a step of the authors' code, and the codes
# that white shows more than black on a lit pixel.
BOARD_GRID = (768, 1024)
STEP = 2.0
LIT_DIFFERENCE = 30

ARGUMENTS = {"photographs": {"type": Path, "help": "folder of real photographs"}}

Points = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class View:
    """A camera of `grid` pixels, `size` to a projector pixel's side; `seed` is that of its noise.

    `place` maps camera coordinates (u, v) to coordinates on the projector's grid.
    """

    size: float
    place: Callable[[np.ndarray, np.ndarray], Points]
    grid: tuple[int, int]
    seed: int = 2


@dataclass(frozen=True, kw_only=True)
class Scan:
    """Largest relative error of T p of each kind of pattern, and masked projector pixels."""

    size: float
    camera: str
    noise: str
    errors: dict[str, float]
    masked: int

    def __str__(self) -> str:
        return ", ".join(f"{kind} {error:.2%}" for kind, error in self.errors.items())

    @property
    def worst(self) -> float:
        """Largest error of all kinds."""
        return max(self.errors.values())


def askance(size: float) -> View:
    """A camera with `size` pixels to one of the projector's, in perspective and turned."""
    side = int(np.ceil(1.12 * size * N))

    def place(u: np.ndarray, v: np.ndarray) -> Points:
        a = (u + 0.5) / side
        b = (v + 0.5) / side
        d = 1 + 0.15 * a - 0.09 * b
        x = N * (1.123 * a + 0.054 * b - 0.043) / d - 0.9
        y = N * (1.145 * b - 0.042 * a - 0.053) / d - 0.5
        return x, y

    return View(size=size, place=place, grid=(side, side))


def random_view(seed: int) -> View:
    """A camera before the wall, of any size and place; turned if the seed is odd."""
    rng = np.random.default_rng(seed)
    size = rng.uniform(*RANDOM_SIZES)
    dx, dy = rng.uniform(-1, 1, 2)
    turn = 0.0
    if seed % 2:
        turn = rng.uniform(-0.1, 0.1)
    side = int(1.25 * size * N)
    middle = (N - 1) / 2
    c = np.cos(turn) / size
    s = np.sin(turn) / size

    def place(u: np.ndarray, v: np.ndarray) -> Points:
        a = u - side / 2
        b = v - side / 2
        x = c * a + s * b + middle + dx
        y = c * b - s * a + middle + dy
        return x, y

    return View(size=float(size), place=place, grid=(side, side), seed=seed)


def run_scan(device: Device, truth: np.ndarray, view: View, camera: str, noise: str) -> Scan:
    """Scan T by a camera, and compare it with the truth on held patterns."""
    response, bits = CAMERAS[camera]
    electrons, read = NOISES[noise]
    rig = VirtualRig(
        truth,
        (N, N),
        response=response,
        bits=bits,
        gain=electrons,
        read=read,
        camera_grid=view.grid,
        camera_map=camera_map(view.place, view.grid, (N, N), points=16),
        ambient=0.01,
        seed=view.seed,
    )
    patterns = held_patterns(N)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "T.zarr"
        T = acquire(rig, strategy="pixel", store=path, device=device)
        is_seen = ~T.masked
        pictures = np.asarray(T @ patterns.T.reshape(-1, N, N), np.float64)
        ours = pictures.reshape(patterns.shape[1], -1).T[is_seen]
        white = np.asarray(T @ np.ones((N, N)), np.float64).ravel()[is_seen]
    true_white = truth.sum(axis=1)[is_seen]
    exact = (truth @ patterns)[is_seen]
    # The camera's unit of light.
    ours *= (white @ true_white) / (white @ white)
    errors = {}
    for kind, columns in KINDS.items():
        errors[kind] = relative_error(ours[:, columns], exact[:, columns])
    return Scan(
        size=view.size,
        camera=camera,
        noise=noise,
        errors=errors,
        masked=int(np.count_nonzero(~is_seen)),
    )


@dataclass(frozen=True, kw_only=True)
class RenderedLoop:
    """Largest error of T p of held patterns, and a picture before and after compensation.

    Pictures of the camera (H, W) are linear; 1 is the brightest.
    """

    error: float
    photographs: int
    decibels_before: float
    decibels_after: float
    before: np.ndarray
    after: np.ndarray
    desired: np.ndarray
    pattern: np.ndarray


class RenderedCorner:
    """A rendered corner, its T by the scan, and renders from the projector's own place."""

    def __init__(self, grid: tuple[int, int], samples: int, path: Path, device: Device) -> None:
        h, w = grid
        self.grid = grid
        self.rig = MitsubaRig(
            "dihedral",
            grid,
            samples=samples,
            bits=12,
            camera_grid=(round(RENDERED_SIZE * h), round(RENDERED_SIZE * w)),
            baseline=BASELINE,
            channels=1,
            albedo=ALBEDO,
        )
        self.T = acquire(self.rig, strategy="pixel", store=path, device=device)
        self.photographs = Report.of(path).photographs
        calibration = Calibration.of(path)
        self.projector = calibration.projector
        self.truth = MitsubaRig(
            "dihedral",
            grid,
            samples=TRUE_SAMPLES,
            seed=9,
            projector_response="linear",
            sensitivity=self.rig.describe()["sensitivity"],
            channels=1,
            albedo=ALBEDO,
        )
        # Pixels all neighbours of which are well seen.
        is_covered = calibration.resampling.coverage > 0.8
        self.inner: Any = scipy.ndimage.binary_erosion(is_covered, np.ones((3, 3)))
        white = np.asarray(self.T @ np.ones(grid, np.float32), np.float64)
        self.white = white[self.inner]

    def true_picture(self, pattern: np.ndarray) -> np.ndarray:
        """Light on the inner pixels, rendered from the projector's place."""
        return self.truth.radiance(pattern)[self.inner]

    def pattern_error(self, patterns: np.ndarray) -> float:
        """Largest relative error of T p, in the camera's unit of light."""
        true_white = self.true_picture(np.ones(self.grid, np.float32))
        unit = self.white @ true_white / (self.white @ self.white)
        errors = []
        for pattern in patterns:
            picture = unit * np.asarray(self.T @ pattern)[self.inner]
            errors.append(relative_error(picture, self.true_picture(pattern)))
        return max(errors)

    def show(self, desired: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Patterns that show a picture: itself, as bright as its compensation, and the latter."""
        level = 0.7 * np.quantile(self.white, 0.05)
        target = (level * desired).astype(np.float32)
        pattern = ltcl.compensate(self.T, target, rtol=1e-3).pattern
        plain = desired * level / np.median(self.white)
        return plain, np.clip(np.asarray(pattern, np.float64), 0.0, 1.0)

    def photograph(self, pattern: np.ndarray) -> np.ndarray:
        """Light that the camera sees of a pattern."""
        return self.rig.radiance(self.projector.codes(pattern))

    def decibels(self, pattern: np.ndarray, desired: np.ndarray) -> float:
        """Peak signal over noise of the light of a pattern, at the best scale."""
        picture = self.true_picture(pattern)
        inner = desired[self.inner]
        scaled = picture * (picture @ inner) / (picture @ picture)
        squared_error = np.mean((scaled - inner) ** 2)
        return float(10 * np.log10(inner.max() ** 2 / squared_error))


def rendered_loop(n: int, samples: int, patterns: np.ndarray, device: Device) -> RenderedLoop:
    """Acquire a corner of 3 n / 4 x n pixels, and compensate a picture on it."""
    grid = (3 * n // 4, n)
    y, x = np.mgrid[: grid[0], :n] / n
    desired = 0.55 + 0.45 * np.sin(19 * np.hypot(x - 0.5, y - 0.37))
    with TemporaryDirectory() as folder:
        rendered = RenderedCorner(grid, samples, Path(folder) / "T.zarr", device)
        error = rendered.pattern_error(patterns)
        plain, pattern = rendered.show(desired)
    before = rendered.photograph(plain)
    after = rendered.photograph(pattern)
    brightest = max(np.quantile(before, 0.995), np.quantile(after, 0.995))
    return RenderedLoop(
        error=error,
        photographs=rendered.photographs,
        decibels_before=rendered.decibels(plain, desired),
        decibels_after=rendered.decibels(pattern, desired),
        before=before / brightest,
        after=after / brightest,
        desired=desired,
        pattern=pattern,
    )


def photographed(folder: Path) -> dict[str, float | str]:
    """Decoded pixels, flatness of the board, and agreement with the authors' calibration."""
    paths = sorted(folder.glob("graycode_*.png"))
    photographs = [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths]
    *_, white, black = photographs
    decoded = decode(photographs, BOARD_GRID)
    is_lit = white.astype(np.float32) - black > LIT_DIFFERENCE
    on_board = decoded.valid & _board(white)
    camera = np.stack(np.nonzero(on_board)[::-1], axis=1).astype(np.float64)
    places = [decoded.x[on_board], decoded.y[on_board]]
    projector = np.stack(places, axis=1).astype(np.float64)
    H, _ = cv2.findHomography(camera, projector, cv2.RANSAC, 1.0)
    mapped = cv2.perspectiveTransform(camera[:, None], H)[:, 0]
    distance = np.linalg.norm(mapped - projector, axis=1)
    some = slice(None, None, 20)
    in_projector, in_camera = _reprojected(camera[some], STEP * projector[some], folder)
    homography = "real, from a homography on the board"
    return {
        "real photographs, lit pixels decoded": float(decoded.valid[is_lit].mean()),
        f"{homography}, median of projector pixels": float(np.median(distance)),
        f"{homography}, rms": float(np.sqrt(np.mean(distance**2))),
        "real, reprojected by the authors' calibration, rms of projector pixels": in_projector,
        "real, and of camera pixels (its own residual is 0.86)": in_camera,
    }


def _board(white: np.ndarray) -> np.ndarray:
    """Camera pixels on the chessboard, a boolean array."""
    _, corners = cv2.findChessboardCorners(white, (7, 9))
    hull = cv2.convexHull(corners.astype(np.float32)).astype(np.int32)
    return cv2.fillConvexPoly(np.zeros(white.shape, np.uint8), hull, (1,)) > 0


def _reprojected(camera: np.ndarray, projector: np.ndarray, folder: Path) -> tuple[float, float]:
    """Triangulate points by the calibration; rms distances in the projector and in the camera."""
    path = str(folder / "calibration_result.xml")
    file = cv2.FileStorage(path, cv2.FILE_STORAGE_READ)
    camera_matrix = file.getNode("cam_int").mat()
    camera_distortion = file.getNode("cam_dist").mat()
    projector_matrix = file.getNode("proj_int").mat()
    projector_distortion = file.getNode("proj_dist").mat()
    # The file spells it so.
    R = file.getNode("roration").mat()
    t = file.getNode("translation").mat()
    camera_rays = cv2.undistortPoints(camera[:, None], camera_matrix, camera_distortion)[:, 0]
    projector_rays = cv2.undistortPoints(
        projector[:, None], projector_matrix, projector_distortion
    )[:, 0]
    pose = np.hstack([R, t.reshape(3, 1)])
    homogeneous = cv2.triangulatePoints(np.eye(3, 4), pose, camera_rays.T, projector_rays.T)
    X = (homogeneous[:3] / homogeneous[3]).T
    rotation, _ = cv2.Rodrigues(R)
    in_projector, _ = cv2.projectPoints(X, rotation, t, projector_matrix, projector_distortion)
    origin = np.zeros(3)
    in_camera, _ = cv2.projectPoints(X, origin, origin, camera_matrix, camera_distortion)
    return _rms(in_projector[:, 0] - projector), _rms(in_camera[:, 0] - camera)


def _rms(offsets: np.ndarray) -> float:
    """Root mean square length of offsets (points, 2)."""
    return float(np.sqrt(np.mean(np.sum(offsets**2, axis=1))))


@dataclass(frozen=True, kw_only=True)
class Results:
    """Scans askance by size and by noise, scans of cameras at random, and the rendered corner."""

    scans: list[Scan]
    at_random: list[Scan]
    loop: RenderedLoop | None
    photographs: Path | None

    def claims(self) -> list[Claim]:
        """Check the accuracy of T, and the gain of compensation."""
        result = []
        for scan in self.scans:
            if scan.size in CLAIMED_SIZES and scan.noise == QUIET:
                result.append(askance_claim(scan))
        result.append(random_claim(self.at_random))
        if self.loop is not None:
            result += loop_claims(self.loop)
        return result

    def facts(self) -> dict[str, Any]:
        """Errors of each scan, and facts of the rendered corner and of the real set-up."""
        facts: dict[str, Any] = {"projector pixels": N * N}
        for scan in self.scans:
            name = f"{scan.size:g} camera pixels, {scan.camera}, {scan.noise}"
            facts[name] = f"{scan}; {scan.masked} pixels masked"
        for seed, scan in enumerate(self.at_random):
            name = f"at random, seed {seed}, {scan.size:.2f} camera pixels"
            facts[name] = f"{scan}; {scan.masked} pixels masked"
        if self.loop is None:
            facts["rendered corner"] = "left out, mitsuba is not installed"
        else:
            shape = self.loop.pattern.shape
            facts["rendered corner"] = f"{shape}, {self.loop.photographs} photographs of the scan"
        if self.photographs is not None:
            facts |= photographed(self.photographs)
        return facts


def askance_claim(scan: Scan) -> Claim:
    """Check the accuracy of one scan askance."""
    size = f"{scan.size:g} camera pixels to a side"
    return Claim(
        text=f"T p of held patterns, {size}, {scan.camera}",
        measured=str(scan),
        wanted="at most 2 %",
        holds=scan.worst <= LIMIT,
    )


def random_claim(scans: list[Scan]) -> Claim:
    """Check the accuracy of all cameras at random."""
    errors = figures.values(scans, "worst")
    cameras = f"{len(scans)} cameras at random"
    return Claim(
        text=f"T p of held patterns, {cameras}, 3 to 4.5 camera pixels to a side",
        measured=f"median {np.median(errors):.2%}, worst {errors.max():.2%}",
        wanted="at most 1 %, each",
        holds=errors.max() <= RANDOM_LIMIT,
    )


def loop_claims(loop: RenderedLoop) -> list[Claim]:
    """Check the rendered corner."""
    accuracy = Claim(
        text="T p on a rendered corner, against renders from the projector's place",
        measured=f"{loop.error:.2%}",
        wanted="at most 4 %",
        holds=loop.error <= RENDERED_LIMIT,
    )
    gain = Claim(
        text="a picture compensated on it comes nearer to what was asked for",
        measured=f"{loop.decibels_before:.1f} dB, then {loop.decibels_after:.1f} dB",
        wanted="10 dB more",
        holds=loop.decibels_after >= loop.decibels_before + 10,
    )
    return [accuracy, gain]


def draw(results: Results) -> Figure:
    """Draw errors by size and by noise, and the rendered corner below."""
    height = 720
    if results.loop is None:
        height = 430
    figure = figures.page(
        height,
        "A camera that is not aligned with the projector",
        "Above: largest error of T p over held patterns, of a corner with 16 x 16",
        "projector pixels seen askance. Below: a rendered corner, by a camera half a wall beside.",
    )
    xlabel = "camera pixels to a projector pixel's side"
    box = (80, 140, 400, 220)
    by_size = figures.graph(figure, box, "By size", xlabel, "")
    plot_sizes(by_size, results)
    xlabel = "electrons at full scale"
    title = "By noise, 3 camera pixels"
    box = (580, 140, 380, 220)
    by_noise = figures.graph(figure, box, title, xlabel, "")
    plot_noises(by_noise, results.scans)
    if results.loop is not None:
        figures.pictures(figure, 480, loop_pictures(results.loop))
    return figure


def plot_sizes(axes: Axes, results: Results) -> None:
    """Plot errors of all cameras over the size of their pixels."""
    for number, camera in enumerate(CAMERAS):
        scans = [scan for scan in results.scans if (scan.camera, scan.noise) == (camera, QUIET)]
        sizes = figures.values(scans, "size")
        plot_errors(axes, sizes, scans, f"C{number}", f"{camera}, ")
    sizes = figures.values(results.at_random, "size")
    worst = figures.values(results.at_random, "worst")
    label = f"{len(sizes)} cameras at random, worst"
    axes.plot(sizes, worst, "x", color=figures.FAINT, label=label)
    _percent(axes)
    figures.legend(axes, 8.5, figures.FAINT)


def plot_noises(axes: Axes, scans: list[Scan]) -> None:
    """Plot errors of the last camera over the electrons at full scale."""
    camera = scans[-1].camera
    scans = [scan for scan in scans if (scan.camera, scan.size) == (camera, NOISE_SIZE)]
    electrons = [NOISES[scan.noise][0] for scan in scans]
    plot_errors(axes, electrons, scans, "C1", "")
    axes.set_xscale("log")
    axes.set_xticks(electrons, [f"{count:g}" for count in electrons])
    axes.minorticks_off()
    _percent(axes)


def plot_errors(axes: Axes, x: Any, scans: list[Scan], color: str, prefix: str) -> None:
    """Plot errors of scans over x, a curve for each kind of pattern."""
    for kind, style in LINE_STYLES.items():
        errors = [scan.errors[kind] for scan in scans]
        axes.plot(x, errors, style, color=color, marker="o", label=prefix + kind)


def loop_pictures(loop: RenderedLoop) -> list[tuple[np.ndarray, str, str]]:
    """Pictures of the rendered corner with their labels and notes."""
    sent_plain = f"the picture itself sent: {loop.decibels_before:.1f} dB"
    sent_pattern = f"the pattern sent: {loop.decibels_after:.1f} dB"
    return [
        (_grey(loop.desired), "asked for", "on the projector's pixels"),
        (_grey(loop.pattern), "pattern", "what the projector sends"),
        (_grey(loop.before), "before", sent_plain),
        (_grey(loop.after), "after", sent_pattern),
    ]


def _grey(image: np.ndarray) -> np.ndarray:
    """Linear light (h, w) as grey sRGB (h, w, 3); its brightest pixel is white."""
    brightest = max(float(image.max()), 1e-9)
    codes = to_srgb(np.clip(image / brightest, 0, 1))
    return np.repeat(codes[..., None], 3, -1)


def _percent(axes: Axes) -> None:
    """Label errors in per cent, and draw a line at the limit."""
    ticks = [0.002, 0.005, 0.01, 0.02, 0.05, 0.1]
    axes.set_yticks(ticks, [f"{100 * tick:g} %" for tick in ticks])
    axes.minorticks_off()
    axes.axhline(LIMIT, color=figures.FAINT, lw=1)


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__, ARGUMENTS)
    run = partial(run_scan, options.device, corner(N))
    cameras = list(CAMERAS)
    sizes = SIZES
    louder = [noise for noise in NOISES if noise != QUIET]
    random_cameras = RANDOM_CAMERAS
    n = 24
    samples = 32
    if options.smoke:
        cameras = cameras[:1]
        sizes = CLAIMED_SIZES[:1]
        louder = []
        random_cameras = 1
        n = 12
        samples = 16
    last_camera = list(CAMERAS)[-1]
    scans = []
    for camera, size in itertools.product(cameras, sizes):
        scans.append(run(askance(size), camera, QUIET))
    for noise in louder:
        scans.append(run(askance(NOISE_SIZE), last_camera, noise))
    at_random = []
    for seed in range(random_cameras):
        at_random.append(run(random_view(seed), last_camera, QUIET))
    loop = None
    if importlib.util.find_spec("mitsuba") is not None:
        squares = held_patterns(n).T.reshape(-1, n, n)
        patterns = squares[:, : 3 * n // 4].astype(np.float32)
        loop = rendered_loop(n, samples, patterns, options.device)
    folder = options.arguments.photographs
    results = Results(scans=scans, at_random=at_random, loop=loop, photographs=folder)
    title = "A camera that is not aligned with the projector"
    draw_results = partial(draw, results)
    figures.conclude(options, title, results.claims(), results.facts(), draw_results)


if __name__ == "__main__":
    main()
