# SPDX-License-Identifier: BSD-3-Clause
"""Run anybody's method on a scene, and judge its results; README.md states the contract.

Patterns are lit through the second measurement, which the method never saw, and compared with its
targets. Bounces are compared with those that the second measurement traced of the true patterns,
whose own noise is subtracted: a fifth of the variance between both measurements, as the second has
four times the paths. Errors are relative, ||found - true|| / ||true|| of a picture; a table shows
their medians over the targets.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from scenes.dataset import FILE_BOUNCES, Scene, relight

COLUMNS = ("compensation", *(f"bounce {k}" for k in range(FILE_BOUNCES)))
OTHERS = ("pattern in 1 / 2 std", "bounces in 1 / 2 std", "photographs", "seconds", "CPU s", "MB")
# Format of each number of a row.
NUMBER_FORMATS = {"photographs": "d", "seconds": ".1f", "CPU s": ".1f", "MB": ".3g"}
# Pixels of the mean that smooths the variance of the truth.
VARIANCE_WINDOW = 9


def relative(
    result: np.ndarray, true: np.ndarray, variance: np.ndarray | float = 0.0
) -> list[float]:
    """Relative error of each picture, the first axis; `variance` of `true` is subtracted."""
    squares = (result - true) ** 2 - variance
    error = picture_norms(squares) / picture_norms(true**2)
    return error.tolist()


def picture_norms(squares: np.ndarray) -> np.ndarray:
    """Root of the sum of squares of each picture, 0 if it is negative."""
    sums = squares.reshape(len(squares), -1).sum(axis=1)
    return np.sqrt(np.maximum(sums, 0.0))


def judge(scene: Scene, results: dict[str, np.ndarray]) -> dict[str, Any]:
    """Errors of each target, and shares of errors within 1 and 2 standard deviations if stated.

    `results` has "patterns" and perhaps "bounces", "patterns_std" and "bounces_std", as a method
    writes them.
    """
    data = scene.photographs
    lit = relight(scene.second, np.clip(results["patterns"], 0.0, 1.0))
    scores: dict[str, Any] = {"compensation": relative(lit, data["photographs"])}
    true, variance = scene.truth
    if "bounces" in results:
        for k in range(FILE_BOUNCES):
            bounce = results["bounces"][:, k]
            scores[f"bounce {k}"] = relative(bounce, true[:, k], variance[:, k])
    # A method that does not know its errors writes zeros.
    if np.any(results.get("patterns_std", 0.0)):
        errors = results["patterns"] - data["patterns"]
        scores["patterns within std"] = shares_within(errors, results["patterns_std"])
    if np.any(results.get("bounces_std", 0.0)):
        smooth = uniform_filter1d(variance, VARIANCE_WINDOW, axis=2)
        smooth = uniform_filter1d(smooth, VARIANCE_WINDOW, axis=3)
        errors = results["bounces"] - true
        scores["bounces within std"] = shares_within(errors, results["bounces_std"], smooth)
    return scores


def shares_within(
    errors: np.ndarray, std: np.ndarray, variance: np.ndarray | float = 0.0
) -> list[float]:
    """Shares of errors within 1 and 2 standard deviations, where one is stated.

    `variance` is that of the truth itself.
    """
    is_stated = std > 0.0
    total_variance = (std**2 + variance)[is_stated]
    ratios = np.abs(errors)[is_stated] / np.sqrt(total_variance)
    return [float(np.mean(ratios <= n)) for n in (1, 2)]


def run(command: str, scene: Scene, limit: float = 3600.0) -> dict[str, Any]:
    """Scores of a command, its seconds, bytes and photographs; or `failed`, why there are none."""
    try:
        outcome = run_method(command, scene, limit)
    except subprocess.CalledProcessError as error:
        return {"failed": describe_exit(error)}
    except subprocess.TimeoutExpired:
        return {"failed": f"it took longer than {limit:g} s"}
    except (OSError, ValueError, EOFError) as error:
        return {"failed": " ".join(str(error).split())}
    facts = {
        "photographs": outcome.photographs,
        "seconds": outcome.seconds,
        "MB": outcome.nbytes / 1e6,
        "CPU s": outcome.cpu_seconds,
    }
    return judge(scene, outcome.results) | facts


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Results of a method and their cost; `nbytes` is the size of its representation of T."""

    results: dict[str, np.ndarray]
    photographs: int
    seconds: float
    cpu_seconds: float
    nbytes: int


def run_method(command: str, scene: Scene, limit: float) -> Outcome:
    """Run a command on the targets of a scene, and read its results."""
    targets = scene.photographs["photographs"]
    transport = scene.folder / "first.npz"
    with TemporaryDirectory() as folder:
        targets_file = Path(folder, "targets.npy")
        np.save(targets_file, targets)
        out = Path(folder, "out")
        out.mkdir()
        paths = [str(transport.resolve()), str(targets_file), str(out)]
        arguments = [*shlex.split(command), *paths]
        before = child_cpu_seconds()
        start = time.perf_counter()
        subprocess.run(  # noqa: S603 - the user's own
            arguments, capture_output=True, check=True, timeout=limit
        )
        seconds = time.perf_counter() - start
        cpu_seconds = child_cpu_seconds() - before
        return Outcome(
            results=read_results(out, targets.shape),
            photographs=read_photographs(out, targets.shape),
            seconds=seconds,
            cpu_seconds=cpu_seconds,
            nbytes=kept_nbytes(out, transport),
        )


def child_cpu_seconds() -> float:
    """Processor time of children that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def describe_exit(error: subprocess.CalledProcessError) -> str:
    """The exit status of a command, and the last line that it wrote."""
    output = error.stderr if error.stderr else error.stdout
    lines = output.decode(errors="replace").strip().splitlines()
    last = lines[-1] if lines else "nothing"
    return f"exit status {error.returncode}, it said: {last:.200}"


def kept_nbytes(out: Path, transport: Path) -> int:
    """Bytes of the representation that a method keeps, else of the transport."""
    sizes = [path.stat().st_size for path in out.glob("representation*")]
    return sum(sizes) if sizes else transport.stat().st_size


def traced(scene: Scene) -> dict[str, Any]:
    """Scores of the true patterns and of the first measurement's bounces: those of noise alone."""
    p = scene.photographs["patterns"]
    return judge(scene, {"patterns": p, "bounces": scene.bounces("first", p)})


def read_results(out: Path, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Read the arrays that a method wrote; all but the patterns are optional.

    Raises
    ------
    ValueError
        If an array does not keep the contract.
    """
    bounces_shape = (shape[0], FILE_BOUNCES, *shape[1:])
    shapes = {
        "patterns": shape,
        "bounces": bounces_shape,
        "patterns_std": shape,
        "bounces_std": bounces_shape,
    }
    results = {}
    for name, array_shape in shapes.items():
        path = out / f"{name}.npy"
        if name == "patterns" or path.exists():
            results[name] = read_array(path, array_shape)
    return results


def read_array(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    value = np.load(path, allow_pickle=False)
    if value.shape != shape or value.dtype.kind != "f" or not np.isfinite(value).all():
        raise ValueError(
            f"{path.name} is {value.dtype} {value.shape}; it must be finite floats {shape}"
        )
    return value


def read_photographs(out: Path, shape: tuple[int, ...]) -> int:
    """Photographs that a method states, else one a projector pixel."""
    path = out / "photographs.txt"
    if path.exists():
        return int(path.read_text("utf-8"))
    return shape[1] * shape[2]


def row(scores: dict[str, Any]) -> list[str]:
    """Cells of `COLUMNS` and `OTHERS`; if the method failed, one with the reason."""
    if "failed" in scores:
        return [f"failed: {scores['failed']}"]
    cells = []
    for name in COLUMNS:
        cells.append(f"{np.median(scores[name]):.2%}" if name in scores else "")
    for name in ("patterns within std", "bounces within std"):
        shares = [f"{share:.0%}" for share in scores.get(name, ())]
        cells.append(" / ".join(shares))
    for name, form in NUMBER_FORMATS.items():
        cells.append(f"{scores[name]:{form}}" if name in scores else "")
    return cells


def markdown(results: dict[str, dict[str, dict[str, Any]]]) -> str:
    """The table of a page: scores of each method by its scene."""
    head = ["scene", "method", *COLUMNS, *OTHERS]
    lines = [head, ["---"] * len(head)]
    for scene, methods in results.items():
        for name, scores in methods.items():
            cells = [scene, name, *row(scores)]
            padding = [""] * (len(head) - len(cells))
            lines.append(cells + padding)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
