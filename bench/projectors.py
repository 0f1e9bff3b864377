# SPDX-License-Identifier: BSD-3-Clause
"""Several projectors as one on a corner: error, seams after a shift, gain, optimality and speed.

Virtual projectors of other brightness, blur and gamma light a corner and show codes of 8 bits. The
seam is the largest deviation of an even picture from its mean over 9 x 9 pixels, within 3 pixels of
a border that lies inside of the picture, after one projector has moved by half a pixel; beside it,
alpha ramps as open tools make them, once with the right gamma and once with 2.2 for all.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.ndimage
import scipy.sparse
from rich.table import Table
from scipy.optimize import lsq_linear

import ltcl
from _harness import Options, parse_options, publish
from _projectors import OVERSCAN, VirtualProjector, border_band, least_seam, tiled
from ltcl.operators import CSR, Dense, IdentityPlus, Product, ScaledColumns
from ltcl.scenes import dihedral, landscape

ALBEDO = 0.6
ROWS = 40
SMALL_ROWS = 8
GAIN_ROWS = 24
# Rows and columns of projectors, and the pixels of each.
LAYOUTS = {2: (1, 2, (40, 56)), 4: (2, 2, (26, 56)), 8: (2, 4, (26, 34))}
OVERLAP = 0.35
RTOL = 1e-3
SHIFT = 0.5
# Radiance of the even picture of the large corner.
EVEN = 0.25
BAND = 3
LOCAL = 9
# Targets of the issue.
MAX_ERROR_RATIO = 1.2
MAX_SEAM = 0.02
MIN_GAIN_RATIO = 1.8
MAX_EXCESS = 0.005
MAX_SECONDS = 3.0
MIN_FRAMES_PER_SECOND = 24.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Corner:
    """S between camera pixels in float64, and the camera's grid."""

    S: np.ndarray
    grid: tuple[int, int]

    def transport(self, projector: VirtualProjector, device: Any) -> ltcl.Transport:
        """T_k as a scan would give it, in float32."""
        matrix = self.S @ projector.direct(self.grid, ALBEDO).toarray()
        return ltcl.Transport(
            matrix.astype(np.float32), projector.grid, camera_grid=self.grid, device=device
        )

    def picture(self, projectors: list[VirtualProjector], patterns: Any) -> np.ndarray:
        """The picture under patterns, as codes of the projectors."""
        direct = np.zeros(self.S.shape[0])
        for projector, pattern in zip(projectors, patterns, strict=True):
            light = projector.shown(np.asarray(pattern, np.float64)).ravel()
            direct += projector.direct(self.grid, ALBEDO) @ light
        return (self.S @ direct).reshape(self.grid)


def corner(rows: int) -> Corner:
    scene = dihedral(rows, albedo=ALBEDO)
    T = scene.transport().to_numpy().astype(np.float64)
    return Corner(S=T / ALBEDO, grid=scene.grid)


def relative_error(picture: np.ndarray, target: np.ndarray) -> float:
    return float(np.linalg.norm(picture - target) / np.linalg.norm(target))


def seam(picture: np.ndarray, band: np.ndarray) -> float:
    """The largest deviation from the local mean in the band, over that mean."""
    local = scipy.ndimage.uniform_filter(picture, LOCAL, mode="nearest")
    return float(np.max(np.abs(picture / local - 1.0)[band]))


def alpha_ramps(
    grid: tuple[int, int], projectors: list[VirtualProjector], level: float, gamma: float | None
) -> list[np.ndarray]:
    """Patterns of an even picture by linear ramps in the overlap, each with its own brightness."""
    weights = []
    for projector in projectors:
        padded = np.pad(np.ones(projector.grid, bool), 1)
        distance = np.asarray(scipy.ndimage.distance_transform_edt(padded), np.float64)
        ramp = distance[1:-1, 1:-1].ravel() - 0.5
        F = projector.direct(grid)
        white = np.asarray(F.sum(axis=1)).ravel()
        weights.append(np.divide(F @ ramp, white, out=np.zeros_like(white), where=white > 0.0))
    total = np.sum(weights, axis=0)
    patterns = []
    for projector, weight in zip(projectors, weights, strict=True):
        F = projector.direct(grid)
        sums = np.asarray(F.sum(axis=0)).ravel()
        share = (F.T @ (weight / np.maximum(total, 1e-9))) / np.maximum(sums, 1e-9)
        light = level * share / (ALBEDO * projector.gain)
        if gamma is not None:
            # The tool's codes are for one gamma, and the projector has its own.
            light = light ** (projector.gamma / gamma)
        patterns.append(light.reshape(projector.grid))
    return patterns


def measure_layout(count: int, rows: int, options: Options) -> dict[str, Any]:
    """Error beside one projector, and seams."""
    scene = corner(rows)
    projector_rows, projector_columns, grid = LAYOUTS[count]
    grid = (round(grid[0] * rows / ROWS), round(grid[1] * rows / ROWS))
    projectors = tiled(projector_rows, projector_columns, grid, OVERLAP)
    T = ltcl.combine([scene.transport(projector, options.device) for projector in projectors])
    reach = (-OVERSCAN, 1.0 + OVERSCAN)
    single = VirtualProjector(grid=(round(1.1 * rows), round(2.2 * rows)), window=(*reach, *reach))
    one = scene.transport(single, options.device)
    H, W = scene.grid
    desired = 0.2 + 0.15 * scipy.ndimage.gaussian_filter(landscape(H, W)[..., 1], 0.7)
    c = ltcl.compensate(T, desired, rtol=RTOL)
    reference = ltcl.compensate(one, desired, rtol=RTOL)
    error = relative_error(scene.picture(projectors, c.patterns), desired)
    one_error = relative_error(scene.picture([single], [reference.pattern]), desired)

    even = np.full(scene.grid, 0.3)
    shown = ltcl.compensate(T, even, rtol=RTOL)
    band = border_band(projectors, scene.grid, BAND)
    moved = [projectors[0].moved(SHIFT, SHIFT), *projectors[1:]]
    seams = {"before": seam(scene.picture(projectors, shown.patterns), band)}
    seams["after"] = seam(scene.picture(moved, shown.patterns), band)
    shown_by_one = ltcl.compensate(one, even, rtol=RTOL)
    after = scene.picture([single.moved(SHIFT, SHIFT)], [shown_by_one.pattern])
    seams["one projector"] = seam(after, band)
    for blend in ("smooth", "linear"):
        blended = ltcl.combine(list(T.transports), blend=blend)
        shown = ltcl.compensate(blended, even, rtol=RTOL)
        seams[blend] = seam(scene.picture(moved, shown.patterns), band)
    near = least_seam(projectors, scene.grid, SHIFT, BAND, LOCAL)
    anywhere = least_seam(projectors, scene.grid, SHIFT, rows, LOCAL)
    seams["least of any weights"] = near
    seams["least of any weights, away from borders, too"] = anywhere
    for name, gamma in (("ramps", None), ("ramps of gamma 2.2", 2.2)):
        patterns = alpha_ramps(scene.grid, projectors, 0.25, gamma)
        seams[name] = seam(scene.picture(moved, patterns), band)
    return {
        "projectors": count,
        "pixels of each": list(grid),
        "camera": list(scene.grid),
        "error": error,
        "error of one": one_error,
        "error ratio": error / one_error,
        "clipped": c.clipped,
        "seams": seams,
    }


def measure_gain(rows: int, options: Options) -> dict[str, float]:
    """The largest gain of two projectors over that of one: stacked, and where two overlap."""
    scene = corner(rows)
    stacked = [
        VirtualProjector(grid=(rows, 2 * rows), window=(-0.02, 1.02, -0.03, 1.02)),
        VirtualProjector(grid=(rows, 2 * rows), window=(-0.03, 1.02, -0.02, 1.03), blur=0.7),
    ]
    transports = [scene.transport(projector, options.device) for projector in stacked]
    desired = np.full(scene.grid, 0.5)
    both = ltcl.compensate(ltcl.combine(transports), desired, gain="auto").gain
    alone = [ltcl.compensate(T, desired, gain="auto").gain for T in transports]
    found = {"stacked": both / max(alone)}
    side = [
        VirtualProjector(grid=(rows, 2 * rows), window=(0.0, 1.0, 0.0, 0.7)),
        VirtualProjector(grid=(rows, 2 * rows), window=(0.0, 1.0, 0.3, 1.0), blur=0.7),
    ]
    transports = [scene.transport(projector, options.device) for projector in side]
    T = ltcl.combine(transports)
    is_shared = np.all([share.relative >= T.balance for share in T.shares], axis=0)
    inside = scipy.ndimage.binary_erosion(is_shared.reshape(scene.grid), iterations=1)
    weights = np.where(inside, 1.0, 0.0)
    both = ltcl.compensate(T, desired, gain="auto", weights=weights, loss=0.01).gain
    alone = []
    for member in transports:
        alone.append(ltcl.compensate(member, desired, gain="auto", weights=weights, loss=0.01).gain)
    found["side by side, where both give their full light"] = both / max(alone)
    return found


def measure_optimality(options: Options) -> list[dict[str, float]]:
    """Errors beside those of SciPy, where much is clipped."""
    scene = corner(SMALL_ROWS)
    found = []
    for balance in (0.0, 0.5, 1.0):
        projectors = tiled(1, 2, (8, 10), OVERLAP)
        transports = [scene.transport(projector, options.device) for projector in projectors]
        T = ltcl.combine(transports, balance=balance)
        picture = 0.2 + 0.8 * landscape(*scene.grid)[..., 1]
        for gain in (0.8, 1.5):
            c = ltcl.compensate(T, picture, gain=gain, rtol=1e-3)
            matrix = T.to_numpy().astype(np.float64)
            upper = np.maximum(np.asarray(T.ceilings, np.float64), 1e-9)
            target = gain * picture.ravel()
            best = lsq_linear(matrix, target, (0.0, upper), method="bvls", tol=1e-12)
            least = float(np.sqrt(2.0 * best.cost) / np.linalg.norm(target))
            found.append(
                {
                    "balance": balance,
                    "gain": gain,
                    "error": c.error,
                    "least": least,
                    "excess": c.error - least,
                    "clipped": c.clipped,
                }
            )
    return found


def large_corner(rows: int, small_rows: int, device: Any) -> ltcl.Transport:
    """S in colour between rows x 2 rows pixels, whose bounces are those of a smaller corner."""
    factor = rows // small_rows
    up, down = _resampling(small_rows, factor)
    matrices = []
    for albedo in (0.7, 0.6, 0.5):
        small = dihedral(small_rows, albedo=albedo).transport().to_numpy()
        R = np.asarray(small / albedo, np.float64)
        R[np.diag_indices(len(R))] -= 1.0
        core = Product(Dense(device, R.astype(np.float32)), CSR(device, down))
        S = IdentityPlus(Product(CSR(device, up), core))
        matrices.append(ScaledColumns(S, np.full(up.shape[0], albedo)))
    grid = (rows, 2 * rows)
    first_bounce = np.stack([matrix.d for matrix in matrices])
    return ltcl.Transport(matrices, grid, first_bounce)


def _resampling(rows: int, factor: int) -> tuple[Any, Any]:
    """Pixels from those `factor` times as large, linear in between, and weighted means."""
    parts = []
    # Nothing is interpolated across the crease.
    for count, walls in ((rows, 1), (rows, 2)):
        place = (np.arange(factor * count) + 0.5) / factor - 0.5
        place = np.clip(place, 0.0, count - 1.0)
        low = np.minimum(place.astype(int), count - 2)
        share = place - low
        at = np.arange(len(place))
        weights = scipy.sparse.csr_array(
            (np.r_[1.0 - share, share], (np.r_[at, at], np.r_[low, low + 1])), (len(place), count)
        )
        parts.append(scipy.sparse.kron(scipy.sparse.eye_array(walls), weights))
    up = scipy.sparse.csr_array(scipy.sparse.kron(parts[0], parts[1]))
    sums = np.asarray(up.sum(axis=0)).ravel()
    return up, scipy.sparse.csr_array(scipy.sparse.diags_array(1.0 / sums) @ up.T)


def seams_of_large(
    T: ltcl.CombinedTransport, scene: ltcl.Transport, projectors: list[VirtualProjector]
) -> dict[str, float]:
    """Seams of projectors of realistic size, in the green channel."""
    shown = ltcl.compensate(T, np.full((*scene.grid, 3), EVEN, np.float32), rtol=RTOL).patterns
    moved = [projectors[0].moved(SHIFT, SHIFT), *projectors[1:]]
    band = border_band(projectors, scene.grid, BAND)

    def picture(shown_by: list[VirtualProjector], patterns: Any) -> np.ndarray:
        direct = np.zeros(scene.shape[0])
        for projector, pattern in zip(shown_by, patterns, strict=True):
            light = projector.shown(np.asarray(pattern, np.float64)).ravel()
            direct += projector.direct(scene.grid, ALBEDO) @ light
        return np.asarray(scene.systems[1] @ direct, np.float64).reshape(scene.grid)

    green = [pattern[..., 1] for pattern in shown]
    ramps = alpha_ramps(scene.grid, projectors, EVEN, None)
    wrong = alpha_ramps(scene.grid, projectors, EVEN, 2.2)
    return {
        "before": seam(picture(projectors, green), band),
        "after": seam(picture(moved, green), band),
        "ramps": seam(picture(moved, ramps), band),
        "ramps of gamma 2.2": seam(picture(moved, wrong), band),
    }


def measure_large(rows: int, options: Options) -> dict[str, Any]:
    """Seconds of a picture by 8 projectors in colour, frames a second of a Compensator, seams."""
    device = options.device
    scene = large_corner(rows, rows // 8, device)
    grid = (rows // 2, rows)
    projectors = tiled(2, 4, grid, 0.25)
    start = time.perf_counter()
    transports = []
    for projector in projectors:
        channels = [projector.direct(scene.grid, albedo) for albedo in (0.7, 0.6, 0.5)]
        channels = [part.astype(np.float32) for part in channels]
        transports.append(ltcl.Transport(channels, grid, camera_grid=scene.grid, device=device))
    made = time.perf_counter()
    T = ltcl.combine(transports, scene=scene)
    combined = time.perf_counter()
    H, W = scene.grid
    desired = (0.15 + 0.2 * landscape(H, W)).astype(np.float32)
    first = ltcl.compensate(T, desired)
    prepared = time.perf_counter()
    seconds = []
    c = first
    for _ in range(3):
        begin = time.perf_counter()
        c = ltcl.compensate(T, desired)
        seconds.append(time.perf_counter() - begin)
    codes = [
        np.rint(255.0 * np.roll(desired, 8 * step, axis=1)).astype(np.uint8) for step in range(8)
    ]
    rates = {}
    for name in ("clamped", "bounded"):
        with ltcl.Compensator(T, decode="linear", clamp=name == "clamped") as compensator:
            compensator(codes[0])
            begin = time.perf_counter()
            for frame in codes:
                compensator(frame)
            spent = time.perf_counter() - begin
            rates[name] = (len(codes) / spent, compensator.judge().error)
    return {
        "camera pixels": H * W,
        "projector pixels": T.shape[1],
        "seconds to make": made - start,
        "seconds to combine": combined - made,
        "seconds of the first picture": prepared - combined,
        "seconds of a picture": float(np.median(seconds)),
        "error": c.error,
        "error of the first": first.error,
        "frames a second": rates["clamped"][0],
        "error of a frame": rates["clamped"][1],
        "frames a second within the bounds": rates["bounded"][0],
        "error of a frame within the bounds": rates["bounded"][1],
        "seams": seams_of_large(T, scene, projectors),
    }


def main() -> None:
    options = parse_options(__doc__)
    rows = 16 if options.smoke else ROWS
    table = Table("question", "measured", "beside", "target", "")
    layouts = []
    missed = 0

    def add(question: str, measured: float, beside: str, target: float, is_hit: bool) -> None:
        nonlocal missed
        missed += not is_hit
        verdict = "" if options.smoke else ("hit" if is_hit else "MISS")
        table.add_row(question, f"{measured:.4g}", beside, f"{target:g}", verdict)

    for count in LAYOUTS:
        found = measure_layout(count, rows, options)
        layouts.append(found)
        ratio = found["error ratio"]
        beside = f"{found['error']:.2%} by all, {found['error of one']:.2%} by one"
        add(f"{count}: error", ratio, beside, MAX_ERROR_RATIO, ratio <= MAX_ERROR_RATIO)
        seams = found["seams"]
        beside = ", ".join(f"{name} {value:.2%}" for name, value in seams.items())
        add(f"{count}: seam", seams["after"], beside, MAX_SEAM, seams["after"] <= MAX_SEAM)
    gains = measure_gain(GAIN_ROWS, options)
    for name, ratio in gains.items():
        add(f"gain, {name}", ratio, "", MIN_GAIN_RATIO, ratio >= MIN_GAIN_RATIO)
    cases = measure_optimality(options)
    for case in cases:
        name = f"balance {case['balance']}, gain {case['gain']}"
        beside = f"{case['error']:.4f}, SciPy {case['least']:.4f}, {case['clipped']:.0%} clipped"
        add(f"excess, {name}", case["excess"], beside, MAX_EXCESS, case["excess"] <= MAX_EXCESS)
    large = measure_large(64 if options.smoke else 256, options)
    spent = large["seconds of a picture"]
    beside = f"error {large['error']:.2%}"
    add("seconds, 8 of 256 x 128 in colour", spent, beside, MAX_SECONDS, spent <= MAX_SECONDS)
    rate = large["frames a second"]
    beside = f"error {large['error of a frame']:.2%}"
    add("frames a second", rate, beside, MIN_FRAMES_PER_SECOND, rate >= MIN_FRAMES_PER_SECOND)
    seams = large["seams"]
    beside = ", ".join(f"{name} {value:.2%}" for name, value in seams.items())
    add("8 of 256 x 128: seam", seams["after"], beside, MAX_SEAM, seams["after"] <= MAX_SEAM)
    facts = {"missed": missed, "camera": f"{rows} x {2 * rows}", "shift in pixels": SHIFT}
    content = {"layouts": layouts, "gains": gains, "optimality": cases, "large": large}
    publish(options, "Several projectors as one, on a corner", facts, table, content)


if __name__ == "__main__":
    main()
