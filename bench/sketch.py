# SPDX-License-Identifier: BSD-3-Clause
"""A sketch of a transport: how many photographs give T p, and how well.

Virtual cameras photograph scenes whose transport is known: of 12 bits, and of 8 bits with another
curve. All photographs count: of the set-up, of the patterns, of the pictures that judge the sketch,
and after each batch. Then T p is compared with the truth, in the camera's unit of light (one scale
a channel), for pictures that no scan has seen:

    nature         four pictures with the spectrum 1 / f
    text           letters
    checkerboard   fields of about a ninth of the shorter side, as patterns have those of 2^k pixels
    patches        nine lit squares of an eighth of the shorter side

and a picture like nature is compensated and shown with the true T. Scenes are a corner of two walls
on the pixel grid, and five in perspective, as a projector sees them (`scenes.perspective`).

Of these, at 32 x 32 pixels, a picture like nature is separated into bounces, with T of a sketch of
100 photographs and of a scan one pixel at a time, and compared with the true bounces. The errors
with the true T are given, too: pixels are no points, and surfaces that the projector does not light
bounce light.
Scans of direct light alone are compared with the true one, as is the light that they say they left
out.

Baselines, on the corner of 64 x 64 pixels: scans that are adaptive, by S-matrices, and one pixel at
a time; pairs of pictures like nature with `ltcl.fit`, with linear regression of all of T on them
(least squares of least norm, with the best of some ridges), and with single lit pixels by the
kernel Nystroem method (Wang et al. 2009, rows by reciprocity, with the best of some powers).
The last three have the light itself, with noise of
0.2 % of white, and pay nothing for a set-up. Neither regression nor Nystroem can find the direct
light, which is of full rank: they are given the true diagonal of T, and find the rest.

Updates: a larger corner is scanned by a camera with three pixels to a side of one of the
projector's, whose geometry Gray code shows. Then the projector moves by 3.7 pixels, aslant and
across, its lamp loses 5 %, and 12 photographs carry the sketch over. T p is compared with the light
of the corner as it is then (`_moved_corner`), on pixels of which something is known.

By hand: the same camera, whose photographs cost a person time, so that the set-up takes few. T p is
compared in the same way.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _figures import Claim
from _harness import Options, parse_options
from _moved_corner import AMBIENT, MovedCornerRig
from acquire import ALBEDO, corner
from ltcl import Transport
from ltcl.acquisition import Calibration, Report, VirtualRig, acquire
from ltcl.acquisition.scanning.sketch import like_nature, text
from scenes.perspective import SCENES, PerspectiveTransport

# Response and bits of each camera.
CAMERAS = {"12 bits": ("linear", 12), "8 bits, film": ("film", 8)}
# Largest number of photographs, and largest errors of each kind of picture.
MAX_PHOTOGRAPHS = 100
# Photographs of a sketch that goes on in rounds.
LONGER_SCAN = 150
MAX_ERRORS = {
    "nature": 0.01,
    "text": 0.01,
    "checkerboard": 0.015,
    "patches": 0.015,
    "compensated": 0.01,
}
# Pixels along each side of scenes in perspective, and of those whose bounces are compared.
SIDE = 64
BOUNCES_SIDE = 32
SMOKE_SIDE = 8
# Bounces that are compared, and largest error relative to that with all of T.
BOUNCES = 3
MAX_BOUNCE_RATIO = 1.3
# Largest error of the direct light that a scan of it alone finds, and of the share it leaves out.
MAX_DIRECT_ERROR = 0.05
# Scans of other strategies, which are baselines.
OTHER_SCANS = {
    "adaptive scan": "adaptive",
    "S-matrices (Hadamard)": "hadamard",
    "one pixel at a time": "pixel",
}
# Noise of the pictures of the baselines, relative to white.
NOISE = 0.002
RIDGES = (1e-6, 1e-4, 1e-2, 1.0)
POWERS = (0.25, 0.5, 1.0)
# Rows and columns by which the projector moves, 3.7 pixels in all, and what its lamp keeps.
SHIFTS = {
    "aslant": (2.5, -2.73),
    "across the crease": (0.0, 3.7),
    "aslant, a place behind a mirror": (2.5, -2.73),
}
LAMP = 0.95
# Side of the place that a mirror turns, relative to the picture.
TURNED = {"aslant, a place behind a mirror": 0.25}
# Photographs of an update, also if a place is measured again; and its error relative to that of the
# scan, at most.
MAX_UPDATE_PHOTOGRAPHS = 12
MAX_PHOTOGRAPHS_AGAIN = 60
MAX_UPDATE_RATIO = 1.2
# Sides of the projectors of scans by hand, their photographs and the largest error of each kind.
HAND_SIDES = (16, 32, 64)
MAX_PHOTOGRAPHS_BY_HAND = 80
MAX_ERROR_BY_HAND = 0.015


def pictures(grid: tuple[int, int]) -> dict[str, np.ndarray]:
    """Pictures (k, h, w) of each kind, in [0, 1]."""
    random = np.random.default_rng(17)
    nature = []
    for _ in range(4):
        noise = like_nature(grid, random)
        nature.append((noise - noise.min()) / np.ptp(noise))
    height, width = grid
    side = max(min(grid) // 8, 1)
    # An odd number, for no pattern to be the same.
    field = max((min(grid) // 9) | 1, 3)
    row, column = np.indices(grid)
    patches = []
    for down in (0.15, 0.45, 0.8):
        for across in (0.1, 0.45, 0.75):
            top = round(down * (height - side))
            left = round(across * (width - side))
            is_lit = (row >= top) & (row < top + side) & (column >= left) & (column < left + side)
            patches.append(is_lit)
    return {
        "nature": np.array(nature),
        "text": text(grid)[None].astype(float),
        "checkerboard": ((row // field + column // field) % 2)[None].astype(float),
        "patches": np.array(patches, float),
    }


@dataclass(frozen=True, kw_only=True)
class Result:
    """A scan of a scene by a camera: photographs, seconds of computing, and errors.

    `errors` are those of each kind of picture, `bound` what the scan says that they are below.
    """

    name: str
    photographs: int
    seconds: float
    errors: dict[str, float]
    compensated: float
    judged: float
    bound: float


class CountingRig(VirtualRig):
    """A virtual camera that counts its photographs."""

    count = 0

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """Take a photograph, and count it."""
        self.count += 1
        return super().photograph(codes, seconds)


def shown(T: Transport, pattern: np.ndarray) -> np.ndarray:
    """T p of a grey pattern (h, w), (N, channels) float64."""
    light = pattern
    if T.channels == 3:
        light = np.repeat(pattern[..., None], 3, axis=-1)
    picture = np.asarray(T @ light.astype(np.float32), np.float64)
    return picture.reshape(-1, T.channels)


def unit(T: Transport, truth: Transport) -> np.ndarray:
    """The camera's unit of light in each channel, by white."""
    white = np.ones(truth.grid)
    ours = shown(T, white)
    exact = shown(truth, white)
    return (ours * exact).sum(axis=0) / (ours**2).sum(axis=0)


def errors_of(product: Callable[[np.ndarray], np.ndarray], truth: Transport) -> dict[str, float]:
    """Relative errors of products T p for each kind of picture, root mean square."""
    errors = {}
    for kind, patterns in pictures(truth.grid).items():
        squares = []
        for pattern in patterns:
            exact = shown(truth, pattern)
            left = product(pattern) - exact
            squares.append((left**2).sum() / (exact**2).sum())
        errors[kind] = float(np.sqrt(np.mean(squares)))
    return errors


def compensated_error(T: Transport, truth: Transport, scale: np.ndarray) -> float:
    """Relative error of a picture like nature that is compensated with T and shown by the truth."""
    pattern = 0.2 + 0.5 * pictures(truth.grid)["nature"][0]
    desired = shown(truth, pattern)
    target = (desired / scale).reshape(*truth.grid, -1).astype(np.float32)
    if T.channels == 1:
        target = target[..., 0]
    found = ltcl.compensate(T, target, rtol=1e-3).pattern
    light = np.asarray(found, np.float32)
    picture = np.asarray(truth @ light, np.float64).reshape(-1, T.channels)
    return float(np.linalg.norm(picture - desired) / np.linalg.norm(desired))


def make_rig(truth: Transport, camera: str) -> CountingRig:
    """A camera before a scene."""
    response, bits = CAMERAS[camera]
    return CountingRig(truth, truth.grid, response=response, bits=bits, ambient=0.01, seed=2)


def run_scan(
    name: str,
    truth: Transport,
    camera: str,
    strategy: str,
    options: Options,
    photographs: int | None = None,
) -> Result:
    """Scan a scene with a camera, and compare; a sketch may go on to so many photographs."""
    rig = make_rig(truth, camera)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "T.zarr"
        start = time.perf_counter()
        T = acquire(
            rig,
            geometry="aligned",
            strategy=strategy,
            store=path,
            photographs=photographs,
            device=options.device,
        )
        seconds = time.perf_counter() - start
        report = Report.of(path)
        scale = unit(T, truth)
        return Result(
            name=f"{name}, {camera}",
            photographs=rig.count,
            seconds=seconds,
            errors=errors_of(lambda pattern: scale * shown(T, pattern), truth),
            compensated=compensated_error(T, truth, scale),
            judged=report.judged_error,
            bound=report.judged_bound,
        )


def transport_of(scene: PerspectiveTransport, options: Options) -> Transport:
    """The true transport of a scene in perspective."""
    matrices = [scene.matrix(channel).astype(np.float32) for channel in range(scene.channels)]
    matrix = matrices if scene.channels == 3 else matrices[0]
    return Transport(matrix, scene.grid, device=options.device)


@dataclass(frozen=True, kw_only=True)
class BounceErrors:
    """Relative errors of direct light and bounces, (1 + BOUNCES,) each.

    `sketched` with T of a sketch, `scanned` of a scan one pixel at a time, `true` with the true T.
    """

    name: str
    sketched: np.ndarray
    scanned: np.ndarray
    true: np.ndarray


def compare_bounces(
    name: str, scene: PerspectiveTransport, truth: Transport, options: Options
) -> BounceErrors:
    """Separate a picture with measured transports, and compare with its true bounces."""
    pattern = pictures(truth.grid)["nature"][0]
    exact = scene.bounces(pattern, BOUNCES)
    picture = shown(truth, pattern)

    def errors(T: Transport) -> np.ndarray:
        scale = unit(T, truth)
        image = (picture / scale).reshape(*truth.grid, -1).astype(np.float32)
        if T.channels == 1:
            image = image[..., 0]
        separated = ltcl.separate(T, image, bounces=BOUNCES, rtol=1e-5)
        parts = np.stack([separated.direct, *separated.bounces]).reshape(exact.shape)
        left = np.linalg.norm(parts * scale - exact, axis=(1, 2))
        return left / np.linalg.norm(exact, axis=(1, 2))

    measured = {}
    for strategy, photographs in (("sketch", MAX_PHOTOGRAPHS), ("pixel", None)):
        rig = make_rig(truth, "12 bits")
        T = acquire(
            rig,
            geometry="aligned",
            strategy=strategy,
            photographs=photographs,
            device=options.device,
        )
        measured[strategy] = errors(T)
    return BounceErrors(
        name=name, sketched=measured["sketch"], scanned=measured["pixel"], true=errors(truth)
    )


def direct_claims(
    name: str, scene: PerspectiveTransport, truth: Transport, options: Options
) -> list[Claim]:
    """Check a scan of direct light alone."""
    white = np.ones(truth.grid)
    exact = scene.bounces(white, 0)[0]
    left_out = float(np.median(1.0 - exact.sum(axis=1) / shown(truth, white).sum(axis=1)))
    rig = make_rig(truth, "12 bits")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "T.zarr"
        T = acquire(rig, geometry="aligned", strategy="direct", store=path, device=options.device)
        report = Report.of(path)
        own = np.atleast_2d(T.first_bounce).T
    # The camera's unit of light in each channel.
    scale = (own * exact).sum(axis=0) / (own**2).sum(axis=0)
    error = float(np.linalg.norm(own * scale - exact) / np.linalg.norm(exact))
    size = f"{BOUNCES_SIDE} x {BOUNCES_SIDE}"
    return [
        Claim(
            text=f"{name}, {size}: direct light, {rig.count} photographs",
            measured=f"{error:.2%}, stated {report.judged_error:.2%}",
            wanted=f"at most {MAX_DIRECT_ERROR:.0%}",
            holds=error <= MAX_DIRECT_ERROR,
        ),
        Claim(
            text=f"{name}, {size}: indirect light that a scan of direct light says it left out",
            measured=f"{report.left_out:.1%}, true {left_out:.1%}",
            wanted=f"within {MAX_DIRECT_ERROR:.0%}",
            holds=abs(report.left_out - left_out) <= MAX_DIRECT_ERROR,
        ),
    ]


def bounce_claims(errors: BounceErrors) -> list[Claim]:
    """Check the bounces of a sketch."""
    checked = []
    for bounce, (ours, all_of_T) in enumerate(zip(errors.sketched, errors.scanned, strict=True)):
        ratio = ours / all_of_T
        checked.append(
            Claim(
                text=f"{errors.name}, {BOUNCES_SIDE} x {BOUNCES_SIDE}: bounce {bounce}",
                measured=f"{ours:.2%}, with all of T {all_of_T:.2%}: {ratio:.2f}",
                wanted=f"at most {MAX_BOUNCE_RATIO:g} times",
                holds=ratio <= MAX_BOUNCE_RATIO,
            )
        )
    return checked


def like_nature_pairs(truth: Transport, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pictures like nature, (count, h, w), and noisy photographs of them."""
    random = np.random.default_rng(5)
    patterns = []
    for _ in range(count):
        noise = like_nature(truth.grid, random)
        patterns.append(np.clip(0.5 + 0.25 * noise / noise.std(), 0.0, 1.0))
    light = np.array(patterns)
    seen = np.stack([shown(truth, pattern)[:, 0] for pattern in light])
    white = shown(truth, np.ones(truth.grid)).mean()
    seen += NOISE * white * random.standard_normal(seen.shape)
    return light, seen.reshape(light.shape)


def best(truth: Transport, products: list[Callable[[np.ndarray], np.ndarray]]) -> dict[str, float]:
    """The errors of the product that has the least one for nature."""
    return min((errors_of(product, truth) for product in products), key=lambda e: e["nature"])


def fitted(truth: Transport, light: np.ndarray, seen: np.ndarray) -> dict[str, float]:
    """Errors of `ltcl.fit`."""
    T = ltcl.fit(light, seen, device=truth.device).transport
    return errors_of(partial(shown, T), truth)


def diagonal(truth: Transport) -> np.ndarray:
    """The true diagonal of T, (N,)."""
    return np.diagonal(np.asarray(truth.matrices[0], np.float64))


def regressed(truth: Transport, light: np.ndarray, seen: np.ndarray) -> dict[str, float]:
    """Errors of linear regression of T less its diagonal."""
    D = diagonal(truth)
    P = light.reshape(len(light), -1)
    Y = seen.reshape(len(seen), -1) - P * D
    products_of_patterns = P @ P.T
    size = np.trace(products_of_patterns) / len(P)

    def product(ridge: float, pattern: np.ndarray) -> np.ndarray:
        system = products_of_patterns + ridge * size * np.eye(len(P))
        rest = np.linalg.solve(system, P @ pattern.ravel()) @ Y
        return (D * pattern.ravel() + rest)[:, None]

    return best(truth, [partial(product, ridge) for ridge in RIDGES])


def nystroem(truth: Transport, count: int) -> dict[str, float]:
    """Errors of the kernel Nystroem method for T less its diagonal, from columns at random."""
    D = diagonal(truth)
    random = np.random.default_rng(7)
    N = truth.grid[0] * truth.grid[1]
    chosen = np.sort(random.choice(N, count, replace=False))
    columns = np.zeros((N, count))
    for place, pixel in enumerate(chosen):
        lit = np.zeros(N)
        lit[pixel] = 1.0
        columns[:, place] = shown(truth, lit.reshape(truth.grid))[:, 0] - D * lit
    columns += NOISE * D.max() * random.standard_normal(columns.shape) / np.sqrt(N)

    def product(power: float, pattern: np.ndarray) -> np.ndarray:
        C = np.sign(columns) * np.abs(columns) ** power
        core = np.linalg.pinv(C[chosen], rcond=1e-3)
        dense = C @ core @ C.T
        rest = np.sign(dense) * np.abs(dense) ** (1.0 / power) @ pattern.ravel()
        return (D * pattern.ravel() + rest)[:, None]

    return best(truth, [partial(product, power) for power in POWERS])


def scan_with_cameras(name: str, truth: Transport, options: Options) -> list[Result]:
    """Sketches of a scene by all cameras; by one if it is but shown that the bench runs."""
    cameras = list(CAMERAS)
    if options.smoke:
        cameras = cameras[:1]
    return [run_scan(name, truth, camera, "sketch", options) for camera in cameras]


def other_scans(truth: Transport, options: Options) -> dict[str, Result]:
    """Scans of a scene by other strategies."""
    scans = {}
    for name, strategy in OTHER_SCANS.items():
        scans[name] = run_scan(name, truth, "12 bits", strategy, options)
    return scans


def all_hand_claims(options: Options) -> list[Claim]:
    """Check scans by hand; of the smallest projector if it is but shown that the bench runs."""
    sides = HAND_SIDES
    if options.smoke:
        sides = sides[:1]
    checked = []
    for side in sides:
        checked += hand_claims(side, options)
    return checked


@dataclass(frozen=True, kw_only=True)
class Updated:
    """A scan that was carried over: photographs, seconds, and errors of T p for all pictures.

    `allowed` is the number of photographs at most.
    `still` is the error of the old transport in the new place, `judged` what the update states,
    `bound` what others are below.
    """

    name: str
    photographs: int
    allowed: int
    seconds: float
    errors: dict[str, float]
    old_errors: dict[str, float]
    still: float
    judged: float
    bound: float
    masked: int

    @property
    def ratio(self) -> float:
        """Error of the update relative to that of the scan, root mean squares of all kinds."""
        return root_mean_square(self.errors) / root_mean_square(self.old_errors)


def root_mean_square(errors: dict[str, float]) -> float:
    """Root mean square of the errors of all kinds of pictures."""
    return float(np.sqrt(np.mean(np.square(list(errors.values())))))


def errors_on_camera(store: Path, T: Transport, rig: MovedCornerRig) -> dict[str, float]:
    """Errors of T p for each kind of picture, in light that the camera sees, on known pixels."""
    resampling = Calibration.of(store).resampling
    known = ~T.masked
    white = resampling.apply(rig.light(np.ones(T.grid)) - AMBIENT).ravel()[known]
    ours = shown(T, np.ones(T.grid))[known, 0]
    scale = float(ours @ white / (ours @ ours))
    errors = {}
    for kind, patterns in pictures(T.grid).items():
        squares = []
        for pattern in patterns:
            seen = resampling.apply(rig.light(pattern) - AMBIENT).ravel()[known]
            left = scale * shown(T, pattern)[known, 0] - seen
            squares.append((left @ left) / (seen @ seen))
        errors[kind] = float(np.sqrt(np.mean(squares)))
    return errors


def run_updates(side: int, options: Options) -> list[Updated]:
    """Scan a corner, move the projector, and update, in each direction."""
    sensor = {"response": "linear", "bits": 12}
    updates = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "T.zarr"
        before = MovedCornerRig(side, ALBEDO, seed=2, **sensor)
        T = acquire(before, strategy="sketch", store=path, device=options.device)
        old_errors = errors_on_camera(path, T, before)
        for name, shift in SHIFTS.items():
            if options.smoke:
                shift = (0.25 * shift[0], 0.25 * shift[1])
            turned = round(TURNED.get(name, 0.0) * side)
            now = MovedCornerRig(
                side, ALBEDO, shift=shift, lamp=LAMP, turned=turned, seed=9, **sensor
            )
            store = Path(folder) / f"{name}.zarr"
            most = MAX_UPDATE_PHOTOGRAPHS
            if name in TURNED:
                most = MAX_PHOTOGRAPHS_AGAIN
            start = time.perf_counter()
            update = ltcl.update(now, path, store=store, photographs=most, device=options.device)
            seconds = time.perf_counter() - start
            updated = Updated(
                name=f"update, moved {name}",
                photographs=now.count,
                allowed=most,
                seconds=seconds,
                errors=errors_on_camera(store, update.transport, now),
                old_errors=old_errors,
                still=root_mean_square(errors_on_camera(path, T, now)),
                judged=update.error,
                bound=update.bound,
                masked=update.masked,
            )
            updates.append(updated)
    return updates


class HandRig(MovedCornerRig):
    """A camera that a person operates: each photograph takes long."""

    keeps_photographs = True


def hand_claims(side: int, options: Options) -> list[Claim]:
    """Check a scan by hand of a corner."""
    rig = HandRig(side, ALBEDO, seed=2, response="srgb", bits=12)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "T.zarr"
        T = acquire(rig, strategy="sketch", store=path, device=options.device)
        errors = errors_on_camera(path, T, rig)
    name = f"by hand, {side} x {side}"
    limits = dict.fromkeys(errors, MAX_ERROR_BY_HAND)
    return budget_claims(f"{name}: ", rig.count, MAX_PHOTOGRAPHS_BY_HAND, errors, limits)


def update_claims(updated: Updated) -> list[Claim]:
    """Check an update."""
    error = root_mean_square(updated.errors)
    old_error = root_mean_square(updated.old_errors)
    return [
        Claim(
            text=f"{updated.name} by 3.7 pixels, 5 % less light: photographs",
            measured=str(updated.photographs),
            wanted=f"at most {updated.allowed}",
            holds=updated.photographs <= updated.allowed,
        ),
        Claim(
            text=f"{updated.name}: error relative to that of the scan",
            measured=f"{updated.ratio:.2f}: {error:.2%}, {old_error:.2%} in the scan",
            wanted=f"at most {MAX_UPDATE_RATIO:.1f}",
            holds=updated.ratio <= MAX_UPDATE_RATIO,
        ),
        Claim(
            text=f"{updated.name}: its error is within what is stated",
            measured=f"{error:.2%}, stated {updated.judged:.2%}, at most {updated.bound:.2%}",
            wanted="below the bound",
            holds=error <= updated.bound,
        ),
    ]


def budget_claims(
    prefix: str,
    photographs: int,
    most: int,
    errors: dict[str, float],
    limits: dict[str, float] = MAX_ERRORS,
) -> list[Claim]:
    """Check the photographs of a sketch, and its errors."""
    checked = [
        Claim(
            text=f"{prefix}photographs",
            measured=str(photographs),
            wanted=f"at most {most}",
            holds=photographs <= most,
        )
    ]
    for kind, error in errors.items():
        checked.append(
            Claim(
                text=f"{prefix}{kind}",
                measured=f"{error:.2%}",
                wanted=f"at most {limits[kind]:.1%}",
                holds=error <= limits[kind],
            )
        )
    return checked


def claims(result: Result) -> list[Claim]:
    """Check a sketch."""
    checked = budget_claims(
        f"{result.name}: ",
        result.photographs,
        MAX_PHOTOGRAPHS,
        result.errors | {"compensated": result.compensated},
    )
    nature = result.errors["nature"]
    checked.append(
        Claim(
            text=f"{result.name}: nature is within the error that is stated",
            measured=f"{nature:.2%}, stated {result.judged:.2%}, at most {result.bound:.2%}",
            wanted="below the bound",
            holds=nature <= result.bound,
        )
    )
    return checked


def error_facts(name: str, photographs: int, errors: dict[str, float]) -> dict[str, float]:
    """Name the errors of each kind of picture by the method and its photographs."""
    facts = {}
    for kind, error in errors.items():
        facts[f"{name}, {photographs} photographs, {kind}"] = error
    return facts


def draw(curves: dict[str, list[tuple[int, float]]]) -> Figure:
    """Draw the error of pictures like nature over photographs."""
    figure = figures.page(
        460,
        "How many photographs?",
        "Error of T p for pictures like nature, of a corner. Scans with all photographs of their",
        "set-up; fit, regression and Nystroem are given the light itself, "
        "the last two the direct part of T.",
    )
    axes = figures.graph(figure, (80, 150, 820, 250), "error of T p", "photographs", "")
    for name, points in curves.items():
        photographs, errors = zip(*sorted(points), strict=True)
        axes.plot(photographs, errors, "o-", ms=5, lw=1.5, label=name)
    axes.set_xscale("log")
    axes.axhline(MAX_ERRORS["nature"], color=figures.FAINT, lw=1, ls="--")
    figures.legend(axes, 10)
    return figure


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    # A noisy T warns.
    logging.getLogger("ltcl").setLevel(logging.ERROR)
    side = SMOKE_SIDE if options.smoke else SIDE
    bounces_side = SMOKE_SIDE if options.smoke else BOUNCES_SIDE
    counts = (20,) if options.smoke else (25, 50, 100, 200)
    square = Transport(corner(side), (side, side), device=options.device)
    results = scan_with_cameras(f"corner {side} x {side}", square, options)
    bounces = []
    direct: list[Claim] = []
    names = list(SCENES)
    if options.smoke:
        names = names[:2]
    for name in names:
        truth = transport_of(PerspectiveTransport(name, (side, side)), options)
        results += scan_with_cameras(name, truth, options)
        smaller = PerspectiveTransport(name, (bounces_side, bounces_side))
        truth = transport_of(smaller, options)
        bounces.append(compare_bounces(name, smaller, truth, options))
        direct += direct_claims(name, smaller, truth, options)

    scans = other_scans(square, options)
    longer = run_scan(
        f"corner {side} x {side}, rounds", square, "12 bits", "sketch", options, LONGER_SCAN
    )
    curves = {
        "sketch": [(scan.photographs, scan.errors["nature"]) for scan in (results[0], longer)],
        "fit": [],
        "linear regression": [],
        "kernel Nystroem": [],
    }
    facts: dict[str, Any] = {}
    for name, scan in scans.items():
        curves[name] = [(scan.photographs, scan.errors["nature"])]
        facts |= error_facts(name, scan.photographs, scan.errors)
    for count in counts:
        light, seen = like_nature_pairs(square, count)
        baselines = {
            "fit": fitted(square, light, seen),
            "linear regression": regressed(square, light, seen),
            "kernel Nystroem": nystroem(square, min(count, side * side // 2)),
        }
        for name, errors in baselines.items():
            curves[name].append((count, errors["nature"]))
            facts |= error_facts(name, count, errors)
    facts |= error_facts("sketch in rounds", longer.photographs, longer.errors)
    checked = []
    for result in results:
        facts[f"{result.name}, seconds"] = result.seconds
        checked += claims(result)
    for errors in bounces:
        listed = ", ".join(f"{error:.2%}" for error in errors.true)
        facts[f"{errors.name}: bounces 0 to {BOUNCES} with the true T, off"] = listed
        checked += bounce_claims(errors)
    checked += direct
    for updated in run_updates(2 * side if options.smoke else side, options):
        facts[f"{updated.name}, seconds"] = updated.seconds
        facts[f"{updated.name}, error without an update"] = updated.still
        facts[f"{updated.name}, masked pixels"] = updated.masked
        for kind, error in updated.errors.items():
            facts[f"{updated.name}, {kind}"] = error
            facts[f"{updated.name}, {kind} in the scan"] = updated.old_errors[kind]
        checked += update_claims(updated)
    checked += all_hand_claims(options)
    if options.smoke:
        # So few pixels show that it runs, not how few photographs a larger scene takes.
        checked = []
    figures.conclude(options, "A sketch of a transport", checked, facts, partial(draw, curves))


if __name__ == "__main__":
    main()
