# SPDX-License-Identifier: BSD-3-Clause
"""Methods to compare with: `python bench/scenes/baselines.py NAME TRANSPORT TARGETS OUT`.

All solve S x = l, S = T diag(F)^-1 = I + R: the pattern of a target l is x / F, its bounces are b_0
= S^-1 l, l <- l - b_0, b_1 = S^-1 l, and so on (eq. 27). They differ in S^-1.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import gmres

import ltcl

# Relative residual of solves, and the most iterations.
RTOL = 1e-3
MAX_ITERATIONS = 200
# Share of the entries of R that `threshold` keeps.
KEPT_SHARE = 0.05
# Direct light, and bounces 1 to 3.
BOUNCES = 4
BOUNCE_NAMES = ("direct", "bounce_1", "bounce_2", "bounce_3")

# F (N,), and S^-1 l of l (N, K).
Solver = tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]


def iteration(T: np.ndarray, out: Path) -> Solver:
    """The paper's: x <- x + (l - S x), F from the diagonal; nothing else than products."""
    F = np.diagonal(T).copy()
    S = T / F

    def solve(l: np.ndarray) -> np.ndarray:
        x = l
        error = 1.0
        for _ in range(MAX_ITERATIONS):
            residual = l - S @ x
            error = np.linalg.norm(residual) / np.linalg.norm(l)
            if error <= RTOL:
                return x
            x = x + residual
        raise SystemExit(
            f"the iteration does not converge: {MAX_ITERATIONS} leave a residual of {error:.2g}"
        )

    return F, solve


def dense(T: np.ndarray, out: Path) -> Solver:
    """T^-1 as a matrix, whose diagonal also gives F for matt surfaces: F_i = 1 / (T^-1)_ii."""
    inverse = np.linalg.inv(T.astype(np.float64))
    F = 1.0 / np.diagonal(inverse)
    return F, lambda l: F[:, None] * (inverse @ l)


def threshold(T: np.ndarray, out: Path) -> Solver:
    """The largest entries of R alone, as SciPy's sparse matrix, and its GMRES."""
    F = np.diagonal(T).copy()
    identity = np.eye(len(T), dtype=T.dtype)
    R = T / F - identity
    magnitudes = np.abs(R)
    kept = int(KEPT_SHARE * R.size)
    least = np.partition(magnitudes.ravel(), -kept)[-kept]
    S = sparse.csr_array(np.where(magnitudes >= least, R, 0.0) + identity)
    # One file for each colour.
    number = len(list(out.iterdir()))
    sparse.save_npz(out / f"representation-{number}.npz", S, compressed=False)

    def solve(l: np.ndarray) -> np.ndarray:
        columns = [gmres(S, column, rtol=RTOL)[0] for column in l.T]
        return np.stack(columns, axis=1)

    return F, solve


def run_solver(
    make_solver: Callable[[np.ndarray, Path], Solver], transport: Path, l: np.ndarray, out: Path
) -> None:
    """Patterns and bounces of targets l, colour by colour."""
    n = l.shape[1] * l.shape[2]
    T = np.load(transport, allow_pickle=False)["T"].reshape(-1, n, n)
    # (channels, N, K)
    light = np.moveaxis(l.reshape(len(l), n, -1), (1, 2), (1, 0))
    patterns = []
    bounces = []
    for channel, columns in zip(T, light, strict=True):
        F, solve = make_solver(channel, out)
        remaining = columns
        parts = []
        for _ in range(BOUNCES):
            bounce = solve(remaining)
            remaining = remaining - bounce
            parts.append(bounce.T)
        patterns.append(parts[0] / F)
        # (K, BOUNCES, N)
        bounces.append(np.stack(parts, axis=1))
    bounces_shape = (len(l), BOUNCES, *l.shape[1:])
    np.save(out / "patterns.npy", np.stack(patterns, axis=-1).reshape(l.shape))
    np.save(out / "bounces.npy", np.stack(bounces, axis=-1).reshape(bounces_shape))


def call_ltcl(*arguments: object) -> None:
    """Run the command line of ltcl."""
    command = [sys.executable, "-m", "ltcl", *map(str, arguments), "--quiet"]
    run = subprocess.run(command, check=False)  # noqa: S603
    if run.returncode:
        # The command has said why.
        raise SystemExit(run.returncode)


def run_ltcl(compress: bool, transport: Path, l: np.ndarray, out: Path) -> None:
    """The command line of ltcl, with the F that an inverse gives, as `dense`."""
    pictures = []
    for k, picture in enumerate(l):
        path = out / f"{k}.exr"
        ltcl.images.write(path, picture)
        pictures.append(path)
    exact = ["--first-bounce", "exact"]
    options = [*exact, "--rtol", RTOL]
    if compress:
        representation = out / "representation.npz"
        call_ltcl("compress", transport, "--rtol", "noise", "--out", representation, *exact)
        # Solves go to the error that it has.
        transport = representation
        options = []
    compensated = out / "compensate"
    separated = out / "separate"
    call_ltcl("compensate", transport, *pictures, "--out", compensated, *options)
    call_ltcl("separate", transport, *pictures, "--bounces", 3, "--out", separated, *options)
    for suffix in ("", "_std"):
        patterns = []
        bounces = []
        for k in range(len(l)):
            patterns.append(ltcl.images.read(compensated / f"{k}_pattern{suffix}.exr"))
            folder = separated / str(k)
            parts = [ltcl.images.read(folder / f"{name}{suffix}.exr") for name in BOUNCE_NAMES]
            bounces.append(np.stack(parts))
        np.save(out / f"patterns{suffix}.npy", np.stack(patterns))
        np.save(out / f"bounces{suffix}.npy", np.stack(bounces))


METHODS: dict[str, Callable[[Path, np.ndarray, Path], None]] = {
    "iteration": partial(run_solver, iteration),
    "dense": partial(run_solver, dense),
    "threshold": partial(run_solver, threshold),
    "ltcl": partial(run_ltcl, False),
    "ltcl compressed": partial(run_ltcl, True),
}


def main() -> None:
    name, transport, targets, out = sys.argv[1:]
    l = np.load(targets, allow_pickle=False)
    METHODS[name](Path(transport), l, Path(out))


if __name__ == "__main__":
    main()
