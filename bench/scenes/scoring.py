# SPDX-License-Identifier: BSD-3-Clause
"""Run anybody's method on a scene, and judge what it writes; README.md tells the contract.

Patterns are lit through the second measurement, which the method never saw, and compared with its
targets. Bounces are compared with those that the second measurement traced of the true patterns,
whose own noise is taken off: a fifth of the variance between both measurements, as the second has
four times the paths. Errors are relative, ||found - true|| / ||true|| of a picture; a table shows
their medians over the targets.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from scenes.dataset import Scene, relight

COLUMNS = ("compensation", *(f"bounce {k}" for k in range(4)))
OTHERS = ("pattern in 1 / 2 std", "bounces in 1 / 2 std", "photographs", "seconds", "CPU s", "MB")


def relative(
    found: np.ndarray, true: np.ndarray, variance: np.ndarray | float = 0.0
) -> list[float]:
    """Of each picture, the first axis; `variance` of `true` is taken off."""
    squares = (found - true) ** 2 - variance, true**2
    off, size = (np.sqrt(np.maximum(x.reshape(len(x), -1).sum(axis=1), 0.0)) for x in squares)
    return (off / size).tolist()


def judge(scene: Scene, results: dict[str, np.ndarray]) -> dict[str, Any]:
    """Errors of each target, and shares of errors within 1 and 2 of the std that there are.

    `results` has "patterns" and perhaps "bounces", "patterns_std" and "bounces_std", as a method
    writes them.
    """
    data = scene.photographs
    lit = relight(scene.second, np.clip(results["patterns"], 0.0, 1.0))
    scores: dict[str, Any] = {"compensation": relative(lit, data["photographs"])}
    true, variance = scene.truth
    for k in range(4 if "bounces" in results else 0):
        scores[f"bounce {k}"] = relative(results["bounces"][:, k], true[:, k], variance[:, k])
    around = uniform_filter1d(
        uniform_filter1d(variance, 9, axis=2), 9, axis=3
    )  # a mean over pixels
    exact = {"patterns": (data["patterns"], 0.0), "bounces": (true, around)}
    for name, (value, own) in exact.items():
        if (std := results.get(f"{name}_std")) is not None:
            ratios = (np.abs(results[name] - value) / np.sqrt(std**2 + own + (std <= 0.0)))[
                std > 0.0
            ]
            scores[f"{name} within std"] = [float(np.mean(ratios <= n)) for n in (1, 2)]
    return scores


def run(command: str, scene: Scene, limit: float = 3600.0) -> dict[str, Any]:
    """Scores of a command, its seconds, bytes and photographs; or `failed`, why there are none."""
    targets = scene.photographs["photographs"]
    with TemporaryDirectory() as folder:
        asked, out, transport = (
            Path(folder, "targets.npy"),
            Path(folder, "out"),
            scene.folder / "first.npz",
        )
        out.mkdir()
        np.save(asked, targets)
        called = [*shlex.split(command), str(transport.resolve()), str(asked), str(out)]
        start, before = time.perf_counter(), os.times()
        try:
            subprocess.run(called, capture_output=True, check=True, timeout=limit)  # noqa: S603 - the user's own
            seconds, after = time.perf_counter() - start, os.times()
            results, photographs = _read(out, targets.shape)
        except subprocess.CalledProcessError as error:
            said = (error.stderr or error.stdout).decode(errors="replace").strip().splitlines() or [
                "nothing"
            ]
            return {"failed": f"exit status {error.returncode}, it said: {said[-1]:.200}"}
        except subprocess.TimeoutExpired:
            return {"failed": f"it took longer than {limit:g} s"}
        except (OSError, ValueError, EOFError) as error:
            return {"failed": " ".join(str(error).split())}
        kept = [path.stat().st_size for path in out.glob("representation*")] or [
            transport.stat().st_size
        ]
    facts = {"photographs": photographs, "seconds": seconds, "MB": sum(kept) / 1e6}
    facts["CPU s"] = sum(after[2:4]) - sum(before[2:4])  # of children that have ended
    return judge(scene, results) | facts


def traced(scene: Scene) -> dict[str, Any]:
    """Scores of the true patterns and of the first measurement's own bounces: what noise alone leaves."""
    p = scene.photographs["patterns"]
    return judge(scene, {"patterns": p, "bounces": scene.bounces("first", p)})


def _read(out: Path, shape: tuple[int, ...]) -> tuple[dict[str, np.ndarray], int]:
    """The arrays that a method wrote, and its photographs; ValueError where they are not of the contract."""
    results, shapes = {}, {"patterns": shape, "bounces": (shape[0], 4, *shape[1:])}
    for name, wanted in (shapes | {f"{name}_std": each for name, each in shapes.items()}).items():
        path = out / f"{name}.npy"
        if name != "patterns" and not path.exists():
            continue
        value = np.load(path, allow_pickle=False)
        if value.shape != wanted or value.dtype.kind != "f" or not np.isfinite(value).all():
            raise ValueError(
                f"{path.name} is {value.dtype} {value.shape}; it must be finite floats {wanted}"
            )
        results[name] = value
    path = out / "photographs.txt"
    return results, int(path.read_text("utf-8")) if path.exists() else shape[1] * shape[2]


def row(scores: dict[str, Any]) -> list[str]:
    """Cells of `COLUMNS` and `OTHERS`; of a method that failed one, why."""
    if "failed" in scores:
        return [f"failed: {scores['failed']}"]
    cells = [f"{np.median(scores[name]):.2%}" if name in scores else "" for name in COLUMNS]
    for name in ("patterns within std", "bounces within std"):
        cells.append(" / ".join(f"{share:.0%}" for share in scores.get(name, ())))
    numbers = {"photographs": "{:d}", "seconds": "{:.1f}", "CPU s": "{:.1f}", "MB": "{:.3g}"}
    return cells + [
        text.format(scores[name]) if name in scores else "" for name, text in numbers.items()
    ]


def markdown(results: dict[str, dict[str, dict[str, Any]]]) -> str:
    """The table of a page: scores of each method by its scene."""
    head = ("scene", "method", *COLUMNS, *OTHERS)
    lines = [head, ["---"] * len(head)]
    for scene, methods in results.items():
        for name, scores in methods.items():
            cells = [scene, name, *row(scores)]
            lines.append(cells + [""] * (len(head) - len(cells)))
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
