# SPDX-License-Identifier: BSD-3-Clause
"""Run anybody's method on a scene, and judge what it writes; README.md tells the contract.

Patterns are lit through the second measurement, which the method never saw, and compared with its targets.
Bounces are compared with those that the second measurement traced of the true patterns. Errors are relative,
||found - true|| / ||true|| of a picture; a table shows their medians over the targets.
"""

from __future__ import annotations

import shlex
import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from scenes.dataset import Scene, relight

COLUMNS = ("compensation", *(f"bounce {k}" for k in range(4)))
OTHERS = ("pattern in 1 / 2 std", "bounces in 1 / 2 std", "photographs", "seconds", "MB")


class MethodError(Exception):
    """What a method did not do, in one line."""


def relative(found: np.ndarray, true: np.ndarray) -> list[float]:
    """Of each picture, the first axis."""
    rows = found.reshape(len(found), -1) - true.reshape(len(true), -1)
    return [
        float(x) for x in np.linalg.norm(rows, axis=1) / np.linalg.norm(true.reshape(len(true), -1), axis=1)
    ]


def judge(scene: Scene, results: dict[str, np.ndarray]) -> dict[str, Any]:
    """Errors of each target, and shares of errors within 1 and 2 of the std that there are.

    `results` has "patterns" and perhaps "bounces", "patterns_std" and "bounces_std", as a method writes them.
    """
    data, second = scene.photographs, scene.transport("second")
    p, shown = data["patterns"], np.clip(results["patterns"], 0.0, 1.0)
    scores: dict[str, Any] = {"compensation": relative(relight(second, shown), data["photographs"])}
    true = {"patterns": p}
    if "bounces" in results:
        true["bounces"] = scene.bounces("second", p)
        for k in range(4):
            scores[f"bounce {k}"] = relative(results["bounces"][:, k], true["bounces"][:, k])
    for name, exact in true.items():
        if f"{name}_std" in results:
            std = results[f"{name}_std"]
            ratios = (np.abs(results[name] - exact) / np.where(std > 0.0, std, np.inf))[std > 0.0]
            scores[f"{name} within std"] = [float(np.mean(ratios <= n)) for n in (1, 2)]
    return scores


def run(command: str, scene: Scene, limit: float = 3600.0) -> dict[str, Any]:
    """Scores of a command, its seconds, bytes and photographs; or `failed`, why there are none."""
    targets = scene.photographs["photographs"]
    with TemporaryDirectory() as folder:
        asked, out = Path(folder, "targets.npy"), Path(folder, "out")
        out.mkdir()
        np.save(asked, targets)
        paths = [str(scene.folder.resolve() / "first.npz"), str(asked), str(out)]
        start = time.perf_counter()
        try:
            _call([*shlex.split(command), *paths], limit)
            seconds = time.perf_counter() - start
            results = _read(out, targets.shape)
            photographs = _photographs(out, targets.shape[1] * targets.shape[2])
        except MethodError as error:
            return {"failed": str(error)}
        kept = [path.stat().st_size for path in out.glob("representation*") if path.is_file()]
        size = sum(kept) if kept else Path(paths[0]).stat().st_size
        facts = {"photographs": photographs, "seconds": seconds, "MB": size / 1e6}
        return judge(scene, results) | facts


def traced(scene: Scene) -> dict[str, Any]:
    """Scores of the true patterns and of the first measurement's own bounces: what noise alone leaves."""
    p = scene.photographs["patterns"]
    return judge(scene, {"patterns": p, "bounces": scene.bounces("first", p)})


def _call(command: list[str], limit: float) -> None:
    try:
        ended = subprocess.run(  # noqa: S603 - the user's own command
            command, capture_output=True, text=True, check=False, timeout=limit, errors="replace"
        )
    except subprocess.TimeoutExpired:
        raise MethodError(f"took longer than {limit:g} s") from None
    except OSError as error:
        raise MethodError(f"{command[0]} cannot be run: {error.strerror}") from None
    if ended.returncode:
        lines = (ended.stderr.strip() or ended.stdout.strip() or "nothing said").splitlines()
        raise MethodError(f"exit status {ended.returncode}: {lines[-1]:.200}")


def _read(out: Path, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    results, shapes = {}, {"patterns": shape, "bounces": (shape[0], 4, *shape[1:])}
    shapes |= {f"{name}_std": each for name, each in shapes.items()}
    for name, wanted in shapes.items():
        path = out / f"{name}.npy"
        if not path.exists():
            continue
        try:
            value = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise MethodError(f"{path.name} cannot be read: {error}") from None
        if value.shape != wanted or value.dtype.kind not in "fiu" or not np.isfinite(value).all():
            raise MethodError(
                f"{path.name} is {value.dtype} {value.shape}; it must be finite floats {wanted}"
            )
        results[name] = value.astype(np.float64)
    if "patterns" not in results:
        raise MethodError("it wrote no patterns.npy")
    return results


def _photographs(out: Path, pixels: int) -> int:
    path = out / "photographs.txt"
    text = path.read_text(encoding="utf-8", errors="replace").strip() if path.exists() else str(pixels)
    if not text.isdecimal():
        raise MethodError(f"photographs.txt says {text[:40]!r}; it must be a whole number")
    return int(text)


def row(scores: dict[str, Any]) -> list[str]:
    """Cells of `COLUMNS` and `OTHERS`; of a method that failed one, why."""
    if "failed" in scores:
        return [f"failed: {scores['failed']}"]
    cells = [f"{np.median(scores[name]):.2%}" if name in scores else "" for name in COLUMNS]
    for name in ("patterns within std", "bounces within std"):
        cells.append(" / ".join(f"{share:.0%}" for share in scores.get(name, ())))
    numbers = {"photographs": "{:d}", "seconds": "{:.1f}", "MB": "{:.3g}"}
    return cells + [text.format(scores[name]) if name in scores else "" for name, text in numbers.items()]


def markdown(results: dict[str, dict[str, dict[str, Any]]]) -> str:
    """The table of a page: scores of each method by its scene."""
    head = ("scene", "method", *COLUMNS, *OTHERS)
    lines = [head, ["---"] * len(head)]
    for scene, methods in results.items():
        for name, scores in methods.items():
            cells = [scene, name, *row(scores)]
            lines.append(cells + [""] * (len(head) - len(cells)))
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
