# SPDX-License-Identifier: BSD-3-Clause
"""Trials of a device: calls that launch every kernel on it, whose results NumPy confirms.

Some drivers end the process that uses them, in one kernel out of thirty. So `ltcl doctor` runs this
module in a child process, which prints a line of JSON when a trial starts, and one when it ends.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse
import typer

from ltcl import scenes
from ltcl.cli.doctor import run_check
from ltcl.cli.reports.program import Check
from ltcl.device import Device, open_device
from ltcl.errors import DeviceError
from ltcl.operators import (
    CSR,
    Compressed,
    Dense,
    Hats,
    IdentityPlus,
    Operator,
    Pyramid,
    ScaledBasis,
    ScaledColumns,
    SubsetBasis,
    Tiles,
    Wavelet,
    block_diagonal,
    triangles,
)
from ltcl.operators.pyramid import hat_levels
from ltcl.operators.relaxation import entry_arguments
from ltcl.scenes.visibility import visibility
from ltcl.solvers.bounded import minimise
from ltcl.solvers.solve import METHODS, SAMPLED, solve
from ltcl.tasks.compensation import Compensator

# Relative errors; solves are to 1 %.
LIMITS = {"product": 1e-4, "solve": 0.02}
SAMPLES = 4096
# Right-hand sides: 4 in one launch, and 1.
COLUMNS = 5
# More pixels than a work-group transforms alone, by the largest groups.
LARGE_GRID = (256, 256)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A call on a device, and what NumPy says of it; `kind` has a limit in `LIMITS`."""

    kind: str
    name: str
    call: Callable[[], Any]
    truth: np.ndarray

    def check(self, fix: str) -> Check:
        """Run the call, and compare."""
        return run_check(f"{self.kind}, {self.name}", self._compare, fix)

    def _compare(self) -> str:
        result = self.call()
        # A solve returns a Solution.
        values = getattr(result, "x", result)
        error = np.linalg.norm(values - self.truth) / np.linalg.norm(self.truth)
        limit = LIMITS[self.kind]
        if not error < limit:
            raise DeviceError(f"differs from NumPy by {error:.1e}; it must be below {limit:g}")
        return f"agrees with NumPy to {error:.1e}"


def trials(device: Device) -> Iterator[Trial]:
    """All trials: products of each kind of operator, and solves by each method."""
    scene = scenes.dihedral(4, albedo=0.3)
    S = np.asarray(scene.transport(device=device).systems[0].to_dense())
    random = np.random.default_rng(0)
    x = random.random((len(S), COLUMNS))
    for name, (A, matrix) in _operators(device, scene, S).items():
        y = random.random((matrix.shape[0], COLUMNS))
        yield Trial(
            kind="product",
            name=name,
            call=partial(_both_products, A, x, y),
            truth=np.vstack([matrix @ x, matrix.T @ y]),
        )
    W = Wavelet(device, scene.grid, "db2")
    yield Trial(kind="product", name="wavelet", call=lambda: W.T @ (W @ x), truth=x)
    # A GPU makes large levels by kernels of their own.
    large = Wavelet(device, LARGE_GRID, "haar")
    picture = random.random((LARGE_GRID[0] * LARGE_GRID[1], COLUMNS))
    yield Trial(
        kind="product",
        name="wavelet of a large picture",
        call=lambda: large.T @ (large @ picture),
        truth=picture,
    )
    yield Trial(
        kind="product", name="visibility", call=partial(_visibility, device), truth=np.eye(2)
    )
    subset = SubsetBasis(device, scene.grid, [5, 0, 2], W)
    picked = np.asarray(W @ x)[[5, 0, 2]]
    expected = np.zeros(x.shape)
    expected[[5, 0, 2]] = picked
    yield Trial(
        kind="product",
        name="subset of wavelets",
        call=lambda: subset.T @ (subset @ x),
        truth=W.T @ expected,
    )
    cells = _cells(*scene.grid)[[5, 0, 2]]
    yield Trial(
        kind="product",
        name="subset of cells",
        call=partial(
            _both_products,
            SubsetBasis(device, scene.grid, [5, 0, 2], Pyramid(device, scene.grid)),
            x,
            x[:3],
        ),
        truth=np.vstack([cells @ x, cells.T @ x[:3]]),
    )
    yield Trial(
        kind="product",
        name="triangles",
        call=partial(_joined_triangles, device, S),
        truth=np.linalg.inv(np.tril(S)),
    )
    yield _colours_of_a_sketch(device, scene.grid)
    yield from _solves(device, S, x[:, 0])
    yield _frame(scene, device)


def _operators(device: Device, scene: Any, S: np.ndarray) -> dict[str, tuple[Operator, np.ndarray]]:
    """Operators of each format, and the matrices that they must agree with."""
    R = scipy.sparse.csr_array(S - np.eye(len(S)))
    scale = np.linspace(0.5, 1.0, len(S))
    order = np.arange(len(S))[::-2]
    operators: dict[str, tuple[Any, Any]] = {
        "sparse": (CSR(device, R), R.toarray()),
        "dense": (Dense(device, S), S),
        "pyramid": (Pyramid(device, scene.grid), _cells(*scene.grid)),
        "hats": (Hats(device, scene.grid), _hats(scene.grid)),
        "scaled columns": (ScaledColumns(CSR(device, R), scale, 1.0), R * scale - np.eye(len(S))),
        "subset": (SubsetBasis(device, scene.grid, order), np.eye(len(S))[order]),
    }
    patches = scenes.cut(scene.walls, 4)
    form_factor = scenes.FormFactor(patches, albedo=0.3, device=device)
    operators["form factor"] = (form_factor, scene.A)
    for width, precision in ((8, "float32"), (1, "float16"), (8, "int8")):
        tiles = Tiles(device, R, width, precision)
        operators[f"tiles of {width}, {precision}"] = (tiles, tiles.to_dense())
    return operators


def _colours_of_a_sketch(device: Device, grid: tuple[int, int]) -> Trial:
    """Products with the three colours of a sketch in one pass."""
    random = np.random.default_rng(1)
    W = Hats(device, grid)
    nodes, pixels = W.shape
    hats = _hats(grid)
    blocks = []
    matrices = []
    for _ in range(3):
        core = random.random((nodes, nodes)) / nodes
        w = random.random(pixels) + 0.5
        out = ScaledBasis(W, w)
        S = IdentityPlus(Compressed(CSR(device, scipy.sparse.csr_array(core)), out, W, 0.0))
        blocks.append(ScaledColumns(S, np.ones(pixels)))
        matrices.append(np.eye(pixels) + w[:, None] * (hats.T @ core @ hats))
    joined = block_diagonal(blocks)
    x = random.random(3 * pixels)
    planes = x.reshape(3, -1)
    forward = [matrix @ plane for matrix, plane in zip(matrices, planes, strict=True)]
    back = [matrix.T @ plane for matrix, plane in zip(matrices, planes, strict=True)]
    return Trial(
        kind="product",
        name="colours of a sketch",
        call=lambda: np.concatenate([joined @ x, joined.T @ x]),
        truth=np.concatenate(forward + back),
    )


def _frame(scene: Any, device: Device) -> Trial:
    """A frame of a prepared compensation, whose brightest light is at the bound."""
    T = scene.transport(device=device)
    pattern = np.linspace(0.1, 0.4, T.shape[1]).reshape(T.grid).astype(np.float32)
    compensator = Compensator(T, gain="follow", encode="linear", dtype="float32")
    return Trial(
        kind="solve",
        name="prepared frame",
        call=lambda: compensator(T @ pattern),
        truth=pattern / pattern.max(),
    )


def _cells(height: int, width: int) -> np.ndarray:
    """The matrix of `Pyramid`, for sides that are powers of two."""
    levels = []
    size = 1
    while size < 2 * max(height, width):
        rows = np.kron(np.eye(max(height // size, 1)), np.ones(min(size, height)))
        columns = np.kron(np.eye(max(width // size, 1)), np.ones(min(size, width)))
        levels.append(np.kron(rows, columns))
        size *= 2
    return np.vstack(levels)


def _hats(grid: tuple[int, int]) -> np.ndarray:
    """The matrix of `Hats`."""
    levels = []
    for level, (height, width) in enumerate(hat_levels(grid)):
        scale = 2.0**level
        sides = []
        for pixels, nodes in zip(grid, (height, width), strict=True):
            distances = np.abs(np.arange(pixels) / scale - np.arange(nodes)[:, None])
            sides.append(np.maximum(1.0 - distances, 0.0))
        levels.append(np.kron(*sides))
    return np.vstack(levels)


def _both_products(A: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.vstack([A @ x, A.T @ y])


def _joined_triangles(device: Device, S: np.ndarray) -> np.ndarray:
    """The inverse of the lower triangle of S, joined from those of two halves."""
    half = len(S) // 2
    P = np.tril(S)
    halves = np.vstack([np.linalg.inv(P[:half, :half]), np.linalg.inv(P[half:, half:])])
    M = CSR(device, scipy.sparse.csr_array(S))
    inverses = device.upload(halves)
    entries = [entry_arguments(slab, inverses) for slab in M.slabs]
    return triangles.join(inverses, len(S), M.slabs, entries, 1.0, is_dense=False).get()


def _visibility(device: Device) -> np.ndarray:
    """Light that two opposite walls exchange past a screen."""
    walls = scenes.box(1, sides=6).walls
    screen = [[(0.4, -1, -1), (0.6, 2, 2)]]
    return visibility(scenes.cut((walls[1], walls[5]), 1), screen, device)


def _solves(device: Device, S: np.ndarray, x: np.ndarray) -> Iterator[Trial]:
    """Solves of S x = b by each method, and by variants that have kernels of their own."""
    R = scipy.sparse.csr_array(S - np.eye(len(S)))
    sparse = IdentityPlus(CSR(device, R))
    dense = IdentityPlus(Dense(device, R.toarray()))
    # A format that has no kernel for a step of an iteration.
    composed = IdentityPlus(Compressed(CSR(device, R), None, None))
    b = S @ x
    for method in METHODS:
        options = {"samples": SAMPLES} if method in SAMPLED else {}
        yield _solve_trial(method, sparse, b, x, method, **options)
    for method in ("gauss_seidel", "southwell"):
        yield _solve_trial(f"{method}, dense", dense, b, x, method)
    yield _solve_trial("richardson, composed", composed, b, x, "richardson")
    yield _solve_trial(
        "monte_carlo, adjoint", sparse, b, x, "monte_carlo", samples=SAMPLES, adjoint=True
    )
    colours = np.stack([x, 2.0 * x, 3.0 * x])
    yield _solve_trial(
        "hybrid, colours", [sparse] * 3, colours @ S.T, colours, "hybrid", samples=SAMPLES
    )
    yield Trial(kind="solve", name="bounded", call=partial(_bounded, dense, b), truth=x[:, None])


def _solve_trial(
    name: str, system: Any, b: np.ndarray, x: np.ndarray, method: str, **options: Any
) -> Trial:
    call = partial(solve, system, b, method, rtol=1e-2, **options)
    return Trial(kind="solve", name=name, call=call, truth=x)


def _bounded(system: Operator, b: np.ndarray) -> Any:
    n = len(b)
    return minimise(system, b[:, None], np.zeros(n), np.ones(n), np.zeros((n, 1)))


def main(index: str, fix: str) -> None:
    """Run all trials on the device of this index, and print them as lines of JSON."""
    device = open_device(index)
    for trial in trials(device):
        typer.echo(json.dumps({"started": f"{trial.kind}, {trial.name}"}))
        typer.echo(json.dumps(asdict(trial.check(fix))))


if __name__ == "__main__":
    main(*sys.argv[1:])
