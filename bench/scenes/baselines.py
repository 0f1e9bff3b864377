# SPDX-License-Identifier: BSD-3-Clause
"""Methods to compare with: `python bench/scenes/baselines.py NAME TRANSPORT TARGETS OUT`.

All solve S x = l, S = T diag(F)^-1 = I + R: the pattern of a target l is x / F, its bounces are b_0
= S^-1 l, l <- l - b_0, b_1 = S^-1 l, and so on (eq. 27). They differ in S^-1.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import gmres

import ltcl

RTOL, ITERATIONS, SHARE = 1e-3, 200, 0.05  # residual; at most; of the entries of R that are kept
Solver = tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]  # F (N,), and S^-1 l of l (N, K)


def iteration(T: np.ndarray, out: Path) -> Solver:
    """The paper's: x <- x + (l - S x), F from the diagonal; nothing else than products."""
    F = np.diagonal(T).copy()
    S = T / F

    def solve(l: np.ndarray) -> np.ndarray:
        x, off = l, 1.0
        for _ in range(ITERATIONS):
            residual = l - S @ x
            if (off := np.linalg.norm(residual) / np.linalg.norm(l)) <= RTOL:
                return x
            x = x + residual
        raise SystemExit(
            f"the iteration does not converge: {ITERATIONS} leave a residual of {off:.2g}"
        )

    return F, solve


def dense(T: np.ndarray, out: Path) -> Solver:
    """T^-1 as a matrix, whose diagonal also tells F where surfaces are matt: F_i = 1 / (T^-1)_ii."""
    inverse = np.linalg.inv(T.astype(np.float64))
    F = 1.0 / np.diagonal(inverse)
    return F, lambda l: F[:, None] * (inverse @ l)


def threshold(T: np.ndarray, out: Path) -> Solver:
    """The largest entries of R alone, as SciPy's sparse matrix, and its GMRES."""
    F = np.diagonal(T).copy()
    R = T / F - np.eye(len(T), dtype=T.dtype)
    least = np.partition(np.abs(R).ravel(), -int(SHARE * R.size))[-int(SHARE * R.size)]
    S = sparse.csr_array(np.where(np.abs(R) >= least, R, 0.0) + np.eye(len(T), dtype=T.dtype))
    sparse.save_npz(out / f"representation-{len(list(out.iterdir()))}.npz", S, compressed=False)
    return F, lambda l: np.stack([gmres(S, column, rtol=RTOL)[0] for column in l.T], axis=1)


def by_matrices(
    solver: Callable[[np.ndarray, Path], Solver], transport: Path, l: np.ndarray, out: Path
) -> None:
    """Patterns and bounces of targets l, colour by colour."""
    T, n = np.load(transport, allow_pickle=False)["T"], l.shape[1] * l.shape[2]
    light = np.moveaxis(l.reshape(len(l), n, -1), (1, 2), (1, 0))  # (channels, N, K)
    patterns, bounces = [], []
    for channel, columns in zip(T.reshape(-1, n, n), light, strict=True):
        F, solve = solver(channel, out)
        left, parts = columns, []
        for _ in range(4):
            parts.append(solve(left))
            left = left - parts[-1]
        patterns.append((parts[0] / F[:, None]).T)
        bounces.append(np.stack([part.T for part in parts], axis=1))  # (K, 4, N)
    np.save(out / "patterns.npy", np.stack(patterns, axis=-1).reshape(l.shape))
    np.save(out / "bounces.npy", np.stack(bounces, axis=-1).reshape(len(l), 4, *l.shape[1:]))


def by_ltcl(compress: bool, transport: Path, l: np.ndarray, out: Path) -> None:
    """The command line of ltcl; of F that an inverse tells, as `dense`."""

    def call(*arguments: object) -> None:
        command = [sys.executable, "-m", "ltcl", *map(str, arguments), "--quiet"]
        if code := subprocess.run(command, check=False).returncode:  # noqa: S603
            raise SystemExit(code)  # the command has said why

    pictures = [out / f"{k}.exr" for k in range(len(l))]
    for path, picture in zip(pictures, l, strict=True):
        ltcl.images.write(path, picture)
    exact: list[object] = ["--first-bounce", "exact"]
    options = [*exact, "--rtol", RTOL]
    if compress:
        call("compress", transport, "--rtol", "noise", "--out", out / "representation.npz", *exact)
        transport, options = out / "representation.npz", []  # to the error that it has
    call("compensate", transport, *pictures, "--out", out / "compensate", *options)
    call("separate", transport, *pictures, "--bounces", 3, "--out", out / "separate", *options)
    for end, name in (("", ""), ("_std", "_std")):
        parts = [f"{part}{end}.exr" for part in ("direct", "bounce_1", "bounce_2", "bounce_3")]
        shown = [out / "compensate" / f"{k}_pattern{end}.exr" for k in range(len(l))]
        split = [[out / "separate" / str(k) / part for part in parts] for k in range(len(l))]
        np.save(out / f"patterns{name}.npy", np.stack([ltcl.images.read(path) for path in shown]))
        np.save(
            out / f"bounces{name}.npy",
            [[ltcl.images.read(path) for path in each] for each in split],
        )


METHODS: dict[str, Callable[[Path, np.ndarray, Path], None]] = {
    "iteration": lambda *paths: by_matrices(iteration, *paths),
    "dense": lambda *paths: by_matrices(dense, *paths),
    "threshold": lambda *paths: by_matrices(threshold, *paths),
    "ltcl": lambda *paths: by_ltcl(False, *paths),
    "ltcl compressed": lambda *paths: by_ltcl(True, *paths),
}


if __name__ == "__main__":
    name, transport, targets, out = sys.argv[1:]
    METHODS[name](Path(transport), np.load(targets, allow_pickle=False), Path(out))
