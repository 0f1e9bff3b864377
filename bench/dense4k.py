# SPDX-License-Identifier: BSD-3-Clause
"""The paper's 4096 x 4096 case: the direct part of a picture, against dense inversion.

The paper reports 0.09 s against 4.6 s, 51 times. Here: an open box of four walls of 32 x 32 pixels,
its transport measured once and so already on the device; then, per picture, ours is one
`ltcl.solve` to 1 %, transfers included, and the competitor is `numpy.linalg.solve` on the same S
(which factorizes every time, as the paper's does). For the next picture a factorization may be
kept, in float32, or an inverse, S^-1 = I - A with a dense A: ours is one product then, as the
factors one pass over N^2 numbers. A `Compensator` clamps and encodes beside that product.

A frame of 32 x 64 through a T as `ltcl.acquire` stores it, sparse rows that are all but full, is
timed beside the same T as an array.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import scipy.linalg

import ltcl
from _coefficients import relative_error
from _harness import Options, Row, milliseconds, parse_options, report, seconds, triad
from ltcl.operators import Dense


def compare_files(options: Options) -> Row:
    """A frame through a T of a .zarr, beside the same T of a .npz."""
    n = 6 if options.smoke else 32
    scene = ltcl.scenes.box(n, sides=2, albedo=0.6)
    T = scene.transport(device=options.device)
    picture = 0.1 * (T @ np.random.default_rng(0).random(T.grid))
    frames: dict[str, Callable[[], object]] = {}
    with TemporaryDirectory() as folder:
        for suffix in ("npz", "zarr"):
            path = Path(folder) / f"T.{suffix}"
            ltcl.save(path, T)
            loaded = ltcl.load(path, device=options.device)
            frames[suffix] = lambda loaded=loaded: ltcl.compensate(loaded, picture)
        ms = milliseconds(frames, repeats=15)
    question = f"frame at N = {T.shape[0]}, T as acquire stores it"
    return Row.from_times(question, "T as .npz", ms["npz"], ms["zarr"], "ms", target=1.0)


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    n = 32
    if options.smoke:
        n = 6
    scene = ltcl.scenes.box(n, sides=4, albedo=0.45)
    T = scene.transport(device=options.device)
    S = T.systems[0]
    dense = S.to_dense()
    l_d = T.first_bounce * np.random.default_rng(0).random(T.shape[1])
    l_out = dense @ l_d
    l_out32 = l_out.astype(np.float32)
    factors32 = scipy.linalg.lu_factor(dense.astype(np.float32))
    A = np.eye(len(dense)) - np.linalg.inv(dense)
    inverse = ltcl.Inverse([Dense(options.device, A)], [1e-5], T.grid, T.first_bounce)
    prepared = ltcl.Compensator(T, inverse=inverse, decode="linear", encode="linear")
    picture = l_out.reshape(T.grid).astype(np.float32)
    solution = ltcl.solve(S, l_out, "chebyshev", rtol=1e-2)
    run_triad, triad_bytes = triad(options.device, options.smoke)
    actions = {
        "triad": run_triad,
        "ours": lambda: ltcl.solve(S, l_out, "chebyshev", rtol=1e-2),
        "float64": lambda: np.linalg.solve(dense, l_out),
        "kept32": lambda: scipy.linalg.lu_solve(factors32, l_out32),
        "inverse": lambda: inverse.solve(l_out),
        "prepared": lambda: prepared(picture),
    }
    times = seconds(actions, repeats=5)
    solved = Row.from_times(
        f"direct part at N = {T.shape[0]}",
        "numpy.linalg.solve, float64",
        times["float64"],
        times["ours"],
        "s",
        target=51.0,
    )
    rows = [solved]
    for name, key in (("direct part", "inverse"), ("a prepared frame", "prepared")):
        row = Row.from_times(
            f"{name} at N = {T.shape[0]}",
            "LU kept, float32 (ours: an inverse kept)",
            times["kept32"],
            times[key],
            "s",
            target=1.0,
        )
        rows.append(row)
    rows.append(compare_files(options))
    facts = {
        "pixels": T.shape[0],
        "rho(R)": ltcl.analyze(T).channels[0].spectral_radius,
        "products": solution.products,
        "relative error of the direct part": relative_error(solution.x, l_d),
        "and with the inverse": relative_error(inverse.solve(l_out).x, l_d),
        "GB/s of our products": solution.products * S.nbytes / times["ours"] / 1e9,
        "GB/s of our triad": triad_bytes / times["triad"] / 1e9,
    }
    title = "4096 x 4096: direct part against dense inversion"
    report(options, title, rows, facts)


if __name__ == "__main__":
    main()
