# SPDX-License-Identifier: BSD-3-Clause
"""Record what ltcl does, and compare two records: for a change that must change nothing.

usage: python .ci/behaviour.py record FOLDER     (FOLDER is made anew)
       python .ci/behaviour.py compare BEFORE AFTER

About 200 command lines run in FOLDER, one after the other, on files that the first ones make. Of
each the record keeps the exit code, standard output and error, and all files that it wrote; of the
public calls of the library it keeps the arrays that they return. Times, versions and addresses are
left out. `compare` prints what differs, arrays with their largest relative deviation, and ends with
exit code 1 where something does.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROUNDING = 1e-5  # relative deviation of arrays that counts as rounding
VARIABLE_FIELDS = re.compile(
    r"(seconds|time|date|speed|version|python|system|numpy|scipy|pyopencl|ltcl|rate|latency"
    r"|bandwidth|created|host|pid|memory|free|per_second|frames_per_second|flops|driver|path|cache)",
    re.IGNORECASE,
)
TRANSPORT_OPTIONS = ["--first-bounce", "--on-dark", "--dark", "--noise"]


def scene_commands() -> list[str]:
    """Make the scenes, their transports and pictures."""
    return [
        "simulate dihedral --size 4 --albedo 0.6 --out corner",
        "simulate trihedral --size 4 --out colour --seed 3",
        "simulate box --size 3 --out room --strategy pixel",
        "simulate dihedral --size 4 --out hadamard --strategy hadamard",
        "simulate dihedral --size 4 --out direct --strategy direct",
        "simulate dihedral --size 4 --out other-camera --camera-grid 12x20",
        "simulate dihedral --size 4 --out corner",
        "simulate nowhere --out x",
        "simulate dihedral --size 1 --out x",
        "simulate dihedral --bits 3 --out x",
        "simulate dihedral --albedo 1.5 --out x",
        "simulate corner.npz --out from-file",
        "acquire plan corner",
        "acquire plan corner --json",
        "acquire plan colour --json",
        "acquire plan other-camera --json",
        "acquire plan nowhere",
        "acquire run corner",
        "acquire run corner --json",
        "acquire run room --quiet",
        "acquire run colour --quiet",
        "acquire run hadamard --json",
        "acquire run direct --json",
        "acquire run other-camera",
        "acquire report corner",
        "acquire report corner --json",
        "acquire report room --json",
        "acquire report colour --json",
        "acquire report nowhere",
        "acquire run nowhere",
    ]


def transport_commands() -> list[str]:
    """Look at transports, convert, compress, invert and denoise them."""
    lines = []
    for name in ("corner.npz", "colour.npz", "sparse.npz", "camera.npz", "noisy.npz"):
        lines += [f"info {name}", f"info {name} --json"]
        lines += [f"analyze {name}", f"analyze {name} --json"]
    lines += [
        "info corner.npz colour.npz missing.npz",
        "info broken.npz",
        "info text.txt",
        "info corner/transport.zarr --json",
        "info corner.npz --show-dark dark.png",
        "analyze corner.npz --rtol 1e-4 --json",
        "analyze corner.npz --rtol 2",
        "analyze corner.npz --plot plot.png",
        "analyze corner.npz --first-bounce exact --json",
        "analyze corner.npz --first-bounce estimate --json",
        "analyze corner.npz --grid 3x3",
        "analyze corner.npz --noise second.npz --json",
        "analyze corner/transport.zarr --json",
        "convert corner.npz corner.npy",
        "convert corner.npz corner.mtx",
        "convert corner.npz corner.h5",
        "convert corner.npz corner.mat",
        "convert corner.npz corner.zarr --json",
        "convert colour.npz colour.zarr",
        "convert colour.npz colour2.mat",
        "convert corner.npy back.npz --grid 5x10",
        "convert corner.npy back.npz",
        "convert corner.mtx back2.npz --grid 5x10",
        "convert corner.npz corner.doc",
        "convert missing.npz x.npz",
        "info corner.npy corner.mtx corner.h5 corner.mat corner.zarr --json",
        "compress corner.npz --out small.npz",
        "compress corner.npz --out small2.npz --rtol 0.05 --json",
        "compress corner.npz --out small3.npz --norm worst --rtol 0.05 --json",
        "compress corner.npz --out small4.npz --basis haar --json",
        "compress corner.npz --out small5.npz --basis pixels --basis db2 --rtol 0.02 --json",
        "compress corner.npz --out small6.npz --budget 8kB --json",
        "compress corner.npz --out small7.npz --basis nothing",
        "compress corner.npz --out small8.npz --budget 10B",
        "compress colour.npz --out colour-small.npz --rtol 0.03 --json",
        "compress camera.npz --out x.npz",
        "compress noisy.npz --out noisy-small.npz --rtol noise --noise noisy2.npz --json",
        "info small.npz --json",
        "analyze small2.npz --json",
        "invert corner.npz --out inverse.npz --json",
        "invert corner.npz --out inverse2.npz --rtol 0.1 --basis haar --json",
        "invert small2.npz --out inverse3.npz --rtol 0.2 --json",
        "invert colour.npz --out colour-inverse.npz --rtol 0.05",
        "invert camera.npz --out x.npz",
        "invert corner.npz --out x.npz --rtol 0",
        "info inverse.npz --json",
        "denoise noisy.npz --out denoised.npz --json",
        "denoise noisy.npz --out denoised2.npz --noise noisy2.npz --json",
        "denoise camera.npz --out x.npz",
        "denoise small.npz --out x.npz",
    ]
    return lines


def compensate_commands() -> list[str]:
    """Compensate."""
    lines = []
    for method in ("jacobi", "richardson", "chebyshev", "gauss_seidel", "sor", "southwell", "cg"):
        lines.append(f"compensate corner.npz grey.png --method {method} --out m-{method} --json")
    for method in ("gmres", "bicgstab", "direct", "neumann", "block_gauss_seidel"):
        lines.append(f"compensate corner.npz grey.png --method {method} --out m-{method} --json")
    lines += [
        "compensate corner.npz grey.png --out c1",
        "compensate corner.npz grey.png --out c1 --json",
        "compensate corner.npz grey.png colour.png --out c2 --json",
        "compensate colour.npz colour-small.png --out c3 --json",
        "compensate corner.npz grey.png --gain auto --out c4 --json",
        "compensate corner.npz grey.png --gain 0.3 --out c5 --json",
        "compensate corner.npz grey.png --gain auto --loss 0.05 --out c6 --json",
        "compensate corner.npz grey.png --low 0.05 --high 0.8 --out c7 --json",
        "compensate corner.npz grey.png --clamp --out c8 --json",
        "compensate corner.npz grey.png --background background.exr --out c9 --json",
        "compensate corner.npz grey.png --weights weights.png --gain 1.5 --out c10 --json",
        "compensate camera.npz camera.png --out c11 --json",
        "compensate camera.npz camera.png --gain auto --out c12 --json",
        "compensate small2.npz grey.png --out c13 --json",
        "compensate small2.npz grey.png --exact corner.npz --rtol 1e-4 --out c14 --json",
        "compensate corner.npz grey.png --inverse inverse.npz --out c15 --json",
        "compensate colour.npz colour-small.png --inverse colour-inverse.npz --out c16 --json",
        "compensate corner/transport.zarr corner.png --gain auto --out c17 --json",
        "compensate corner.npz other.png --out c18",
        "compensate corner.npz other.png --resize --out c18 --json",
        "compensate corner.npz grey.png --encoding linear --out c19 --json",
        "compensate corner.npz missing.png --out c20",
        "compensate missing.npz grey.png --out c20",
        "compensate corner.npz grey.png --rtol 5 --out c20",
        "compensate corner.npz grey.png --method magic --out c20",
        "compensate corner.npz grey.png --gain -1 --out c20",
        "compensate corner.npz grey.png --low 2 --high 1 --out c20",
        "compensate corner.npz grey.png --noise second.npz --out c21 --json",
        "compensate noisy.npz grey.png --noise noisy2.npz --rtol noise --out c22 --json",
        "compensate corner.npz",
        "compensate corner.npz grey.png",
        "compensate small.npz grey.png --rtol 1e-6 --out c23",
        "compensate dark.npz grey.png --out c24 --json",
        "compensate dark.npz grey.png --on-dark raise --out c25",
    ]
    return lines


def light_commands() -> list[str]:
    """Separate, relight, and other programs than those for transports."""
    return [
        "separate corner.npz picture.exr --out s1",
        "separate corner.npz picture.exr --out s2 --bounces 2 --json",
        "separate corner.npz picture.exr --out s3 --bounces 0 --json",
        "separate corner.npz picture.exr --first-bounce exact --out s4 --json",
        "separate corner.npz picture.exr --first-bounce estimate --out s5 --json",
        "separate colour.npz colour-picture.exr --out s6 --json",
        "separate corner.npz picture.exr grey.png --out s7 --json",
        (
            "separate corner.npz picture.exr --method monte_carlo --samples 64 --seed 5 "
            "--out s8 --json"
        ),
        "separate corner.npz picture.exr --method hybrid --samples 16 --out s9 --json",
        "separate corner.npz picture.exr --inverse inverse.npz --out s10 --json",
        "separate small2.npz picture.exr --out s11 --json",
        "separate camera.npz picture.exr --out x",
        "separate corner.npz other.png --out x",
        "separate noisy.npz picture.exr --noise noisy2.npz --out s12 --json",
        "relight corner.npz c1/grey_pattern.exr --out r1",
        "relight corner.npz grey.png --out r2 --json",
        "relight colour.npz colour-small.png --out r3 --json",
        "relight camera.npz grey.png --out r4 --json",
        "relight small2.npz grey.png --out r5 --json",
        "relight corner.npz missing.png --out x",
        "relight corner.npz other.png --out x",
        "compensate corner.npz film --out f1 --json",
        "compensate corner.npz film --out f1 --resume --json",
        "compensate corner.npz film --out f2 --frames 2 --format exr --appearance --json",
        "compensate corner.npz film --out f3 --gain 0.5 --inverse inverse.npz --batch 2 --json",
        "compensate --transports *small2.npz grey.png --out f4 --json",
        "film corner.npz film --out f1b --json",
        "film corner.npz film --out f1b --resume --json",
        "film corner.npz film --out f2b --frames 2 --format exr --appearance --json",
        "film corner.npz film --out f3b --gain 0.5 --inverse inverse.npz --batch 2 --json",
        "show missing",
        "play missing.mp4 corner.npz",
        "view missing.npz",
        "devices",
        "devices --json",
        "doctor",
        "nothing",
        "--version",
    ]


def help_commands() -> list[str]:
    """Ask each command for its help."""
    import typer

    from ltcl.cli.main import build_program

    program: Any = typer.main.get_command(build_program())
    lines = ["--help", "acquire plan --help", "acquire run --help", "acquire report --help"]
    return lines + [f"{command} --help" for command in program.commands]


def make_inputs() -> None:
    """Small transports and pictures in the working folder."""
    import scipy.sparse

    import ltcl

    rng = np.random.default_rng(7)
    scene = ltcl.scenes.dihedral(5, albedo=0.6)
    T = scene.transport()
    matrix = T.to_numpy()
    h, w = T.grid
    ltcl.save("corner.npz", T)
    box = ltcl.scenes.trihedral(4)
    ltcl.save("colour.npz", box.transport())
    sparse = scipy.sparse.csr_array(np.where(matrix > np.quantile(matrix, 0.7), matrix, 0.0))
    ltcl.save("sparse.npz", ltcl.Transport(sparse, T.grid))
    camera = np.repeat(matrix, 2, axis=0)
    ltcl.save("camera.npz", ltcl.Transport(camera, T.grid, camera_grid=(h, 2 * w)))
    for name in ("noisy", "noisy2", "second"):
        noise = 1e-4 * matrix.max() * rng.standard_normal(matrix.shape)
        ltcl.save(f"{name}.npz", ltcl.Transport(matrix + noise, T.grid))
    dark = matrix.copy()
    dark[:, 3] = 0.0
    ltcl.save("dark.npz", ltcl.Transport(dark, T.grid))
    Path("broken.npz").write_bytes(b"PK\3\4 not a zip")
    Path("text.txt").write_text("no transport")

    y, x = np.mgrid[0:h, 0:w]
    picture = (0.2 + 0.1 * np.sin(x) + 0.02 * y).astype(np.float32)
    ltcl.images.write("grey.png", picture)
    ltcl.images.write("colour.png", np.stack([picture, 0.9 * picture, 0.7 * picture], axis=-1))
    ltcl.images.write("picture.exr", T @ picture)
    ltcl.images.write("background.exr", np.full(T.grid, 0.01, np.float32))
    ltcl.images.write("weights.png", 0.5 + picture)
    ltcl.images.write("camera.png", np.repeat(picture, 2, axis=1).reshape(h, 2 * w))
    ltcl.images.write("other.png", np.full((7, 9), 0.2, np.float32))
    colour_T = box.transport()
    light = np.full((*colour_T.grid, 3), 0.2, np.float32)
    light[..., 1] += 0.1 * rng.random(colour_T.grid, np.float32)
    ltcl.images.write("colour-small.png", light)
    ltcl.images.write("colour-picture.exr", colour_T @ light)
    ltcl.images.write("corner.png", np.full((4, 8), 0.2, np.float32))
    for number in range(4):
        ltcl.images.write(f"film/{number}.png", np.float32(0.5 + 0.1 * number) * picture)


def public_calls() -> dict[str, Any]:
    """Arrays that the library returns, by the names of calls."""
    import ltcl

    results: dict[str, Any] = {}
    for kind in ("grey", "colour"):
        scene = ltcl.scenes.dihedral(6) if kind == "grey" else ltcl.scenes.trihedral(5)
        T = scene.transport()
        shape = T.grid if kind == "grey" else (*T.grid, 3)
        light = np.random.default_rng(1).random(shape).astype(np.float32)
        picture = T @ light
        compensation = ltcl.compensate(T, 0.2 * light)
        automatic = ltcl.compensate(T, light, gain="auto")
        separation = ltcl.separate(T, picture, bounces=3)
        results |= {
            f"{kind} relight": picture,
            f"{kind} compensate": compensation.pattern,
            f"{kind} appearance": compensation.appearance,
            f"{kind} compensate auto": automatic.pattern,
            f"{kind} gain": automatic.gain,
            f"{kind} direct": separation.direct,
            f"{kind} bounces": separation.bounces,
            f"{kind} rest": separation.rest,
            f"{kind} std": separation.std.bounces if hasattr(separation.std, "bounces") else 0.0,
        }
    scene = ltcl.scenes.box(10, sides=3, albedo=0.5)
    T = scene.transport()
    S = T.interreflection
    b = np.random.default_rng(2).random(T.shape[0]).astype(np.float32)
    for method in ltcl.solvers.METHODS:
        options = {"seed": 1} if method in ("monte_carlo", "hybrid") else {}
        solution = ltcl.solve(S, b, method, rtol=1e-3, throw=False, **options)
        results[f"solve {method}"] = solution.x
        results[f"solve {method}, products"] = solution.products
        results[f"solve {method}, iterations"] = solution.iterations
    compressed = ltcl.compress(T, rtol=0.01)
    results["compressed bytes"] = compressed.nbytes
    results["compressed relight"] = compressed @ np.ones(T.grid)
    inverse = ltcl.invert(T, rtol=0.02)
    results["inverse pattern"] = inverse.pattern(0.1 * np.ones(T.grid))
    analysis = ltcl.analyze(T)
    results["spectral radius"] = analysis.channels[0].spectral_radius
    noisy = T.to_numpy() + 1e-4 * np.random.default_rng(3).standard_normal(T.shape)
    results["denoised"] = ltcl.denoise(ltcl.Transport(noisy, T.grid)).to_numpy()
    room = ltcl.scenes.dihedral(4)
    glossy = ltcl.scenes.glossy(room, 4, projector=(0.7, 0.7, 0.5), rays=8, directions=16)
    results["glossy"] = glossy.transport().to_numpy()
    return results


def run(line: str) -> dict[str, Any]:
    """Exit code, output and new files of one command line, run in this process."""
    from ltcl.cli.main import main as run_command_line

    before = {path: path.stat().st_mtime_ns for path in files()}
    out = io.StringIO()
    err = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = run_command_line(line.split())
        except SystemExit as end:
            code = end.code
    written = [path for path in files() if before.get(path) != path.stat().st_mtime_ns]
    return {
        "code": code,
        "out": plain_text(out.getvalue()),
        "err": plain_text(err.getvalue()),
        "files": {path.as_posix(): digest(path) for path in written},
    }


def files() -> Iterator[Path]:
    """Files below the working folder, without those of the record."""
    for path in sorted(Path().rglob("*")):
        if path.is_file() and not path.name.endswith((".lock", "record.json", "calls.npz")):
            yield path


def plain_text(text: str) -> Any:
    """Output without what changes from run to run; a JSON document as its fields."""
    text = text.replace(str(Path.cwd()), "FOLDER")
    try:
        return without_variable_fields(json.loads(text))
    except ValueError:
        text = re.sub(r"\d+(\.\d+)? (s|ms|seconds|minutes)\b", "TIME", text)
        return re.sub(r"127\.0\.0\.1:\d+\S*", "ADDRESS", text)


def without_variable_fields(value: Any) -> Any:
    """A JSON value without fields of times and versions, numbers with four digits."""
    if isinstance(value, dict):
        return {
            key: without_variable_fields(entry)
            for key, entry in value.items()
            if not VARIABLE_FIELDS.search(key)
        }
    if isinstance(value, list):
        return [without_variable_fields(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.4g}")
    return value


def digest(path: Path) -> Any:
    """Contents of a file: arrays as sums of numbers, JSON as its fields, all else as a hash."""
    if path.suffix == ".json":
        return plain_text(path.read_text("utf-8", errors="replace"))
    if path.suffix in (".npz", ".npy"):
        with contextlib.suppress(Exception):
            loaded = np.load(path)
            arrays = dict(loaded) if path.suffix == ".npz" else {"array": loaded}
            return {name: summary(array) for name, array in arrays.items()}
    if path.suffix in (".exr", ".png"):
        from ltcl import images

        with contextlib.suppress(Exception):
            return summary(images.read(path, encoding="linear"))
    if path.suffix in (".toml", ".log", ".csv", ".txt"):
        return plain_text(path.read_text("utf-8", errors="replace"))
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def summary(array: np.ndarray) -> Any:
    """Type, shape and moments of an array."""
    if array.dtype.kind not in "fiub":
        return str(array)[:200]
    values = array.astype(np.float64)
    moments = [float(np.sum(values)), float(np.sum(np.abs(values))), float(np.sum(values**2))]
    return [str(array.dtype), list(array.shape), *(float(f"{moment:.5g}") for moment in moments)]


def record(folder: Path) -> None:
    """Run all command lines and public calls, and write the record."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    os.chdir(folder)
    os.environ["COLUMNS"] = "100"
    os.environ["NO_COLOR"] = "1"
    make_inputs()
    runs = {}
    lines = [*scene_commands(), *transport_commands(), *compensate_commands()]
    lines += [*light_commands(), *help_commands()]
    for number, line in enumerate(lines):
        sys.stderr.write(f"\r{number + 1} of {len(lines)}: {line:60.60}")
        runs[f"{number}: {line}"] = run(line)
    Path("record.json").write_text(json.dumps(runs, indent=1), "utf-8")
    calls = {name: np.asarray(value) for name, value in public_calls().items()}
    np.savez("calls.npz", **calls)
    sys.stderr.write("\n")


def differences(before: Any, after: Any, place: str) -> Iterator[str]:
    """Lines that name what differs between two JSON values."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted({*before, *after}):
            if key not in before:
                yield f"{place} {key}: new: {after[key]!r:.200}"
            elif key not in after:
                yield f"{place} {key}: gone, was {before[key]!r:.200}"
            else:
                yield from differences(before[key], after[key], f"{place} {key}")
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for number, (old, new) in enumerate(zip(before, after, strict=True)):
            yield from differences(old, new, f"{place}[{number}]")
    elif isinstance(before, float) and isinstance(after, (int, float)):
        if abs(before - after) > 2e-3 * max(abs(before), abs(after)) + 1e-12:
            yield f"{place}: {before} became {after}"
    elif before != after:
        yield f"{place}:\n    - {before!r:.700}\n    + {after!r:.700}"


def named_by_line(runs: dict[str, Any]) -> dict[str, Any]:
    """Name runs by their command lines, whose order may differ; the second of a line gets a 2."""
    named: dict[str, Any] = {}
    for key, value in runs.items():
        line = key.partition(": ")[2]
        repeated = sum(name.partition(" #")[0] == line for name in named)
        named[f"{line} #{repeated + 1}"] = value
    return named


def compare(before: Path, after: Path) -> int:
    """Print what differs between two records; 1 where something does."""
    count = 0
    old = json.loads((before / "record.json").read_text("utf-8"))
    new = json.loads((after / "record.json").read_text("utf-8"))
    old = named_by_line(old)
    new = named_by_line(new)
    for line in differences(old, new, ""):
        count += 1
        sys.stdout.write(f"{line}\n")
    with np.load(before / "calls.npz") as calls, np.load(after / "calls.npz") as others:
        for name in calls:
            if name not in others:
                sys.stdout.write(f"call {name}: gone\n")
                count += 1
                continue
            deviation = relative_deviation(calls[name], others[name])
            if deviation > 0.0:
                verdict = "rounding" if deviation <= ROUNDING else "DIFFERENT"
                sys.stdout.write(f"call {name}: deviates by {deviation:.2g}, {verdict}\n")
                count += deviation > ROUNDING
    sys.stdout.write(f"{count} differences\n")
    return int(count > 0)


def relative_deviation(before: np.ndarray, after: np.ndarray) -> float:
    """Largest deviation over the largest value."""
    if before.shape != after.shape:
        return np.inf
    difference = np.abs(before.astype(np.float64) - after.astype(np.float64))
    largest = np.abs(before.astype(np.float64)).max(initial=0.0)
    return (
        float(difference.max(initial=0.0) / largest)
        if largest
        else float(difference.max(initial=0.0))
    )


def main(arguments: list[str]) -> int:
    """Exit code of this program."""
    if len(arguments) == 2 and arguments[0] == "record":
        record(Path(arguments[1]).resolve())
        return 0
    if len(arguments) == 3 and arguments[0] == "compare":
        return compare(Path(arguments[1]), Path(arguments[2]))
    sys.exit(__doc__)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
