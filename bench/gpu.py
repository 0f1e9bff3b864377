# SPDX-License-Identifier: BSD-3-Clause
"""All that is to be measured on a GPU, in one command of at most 8 minutes.

    python bench/gpu.py --json bench/results/gpu-NAME.json

Its steps: what `ltcl doctor` says; tests; products, transforms, sweeps, solves and frames beside
the model of `bench/gpu_model.py`; sparse products beside CuPy's cuSPARSE, in CSR (CuPy has no
sliced ELL); frames a second; what several devices exchange. Kernels are tuned on the way, and the
variants that won are printed, and the share of copies in the time of frames and solves. A step that
fails or takes too long is named, and the others go on. `--smoke` runs on any device.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
# Seconds of all steps, and those that a step needs to be worth its start.
TOTAL_SECONDS = 480.0
MIN_SECONDS = 15.0
NVIDIA_LIBRARY = "libnvidia-opencl.so.1"
TESTS = ["tests/test_public_calls.py", "tests/operators/test_rows.py", "tests/device"]


@dataclass(frozen=True)
class Step:
    """A command of Python: its arguments, and the seconds that it may take.

    With `has_record` it takes --json and its record goes into that of this bench.
    """

    name: str
    arguments: list[str]
    seconds: float
    has_record: bool = False


def steps(smoke: bool) -> list[Step]:
    """All steps, those first that say most."""
    bench = ["--smoke"] if smoke else []
    tests = ["-m", "pytest", "-q", "-m", "", "-n", "4", "--maxfail", "8", *TESTS]
    if smoke:
        tests = ["-m", "pytest", "-q", "-m", "", "-n", "0", TESTS[0], "-k", "relight"]
    return [
        Step("doctor", ["-m", "ltcl", "doctor"], 60),
        Step("model", ["bench/gpu_model.py", *bench], 180, has_record=True),
        Step("products", ["bench/csr.py", *bench], 120, has_record=True),
        Step("tests", tests, 120),
        Step("video", ["bench/video.py", *bench], 60, has_record=True),
        Step("exchange", ["bench/exchange.py", *bench], 60, has_record=True),
    ]


def provide_driver(folder: Path) -> dict[str, str]:
    """Variables by which OpenCL finds NVIDIA's driver where a container brings no file for it."""
    vendors = Path("/etc/OpenCL/vendors")
    if "OCL_ICD_VENDORS" in os.environ or (vendors.is_dir() and any(vendors.glob("nvidia*.icd"))):
        return {}
    try:
        ctypes.CDLL(NVIDIA_LIBRARY)
    except OSError:
        return {}
    (folder / "nvidia.icd").write_text(f"{NVIDIA_LIBRARY}\n", encoding="utf-8")
    return {"OCL_ICD_VENDORS": str(folder)}


def run(step: Step, seconds: float, record: Path, environment: dict[str, str]) -> str:
    """Run one step, and say how it ended."""
    command = [sys.executable, *step.arguments]
    if step.has_record:
        command += ["--json", str(record)]
    try:
        outcome = subprocess.run(  # noqa: S603 - ours
            command, cwd=ROOT, env=environment, timeout=seconds, check=False
        )
    except subprocess.TimeoutExpired:
        return f"ended after {seconds:.0f} s"
    if outcome.returncode != 0:
        return f"FAILED with status {outcome.returncode}"
    return "passed"


def run_all(smoke: bool) -> dict[str, Any]:
    """Run the steps one after the other while there is time; outcomes and records by name."""
    end = time.monotonic() + TOTAL_SECONDS
    content: dict[str, Any] = {"title": "One visit to a GPU", "smoke": smoke, "steps": {}}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = os.environ | {"LTCL_CACHE": str(folder), "PYTHONPATH": str(ROOT)}
        environment |= provide_driver(folder)
        for step in steps(smoke):
            left = min(step.seconds, end - time.monotonic())
            print(f"\n==== {step.name} ====", flush=True)
            start = time.monotonic()
            outcome = "NOT MEASURED, for want of time"
            record = folder / f"{step.name}.json"
            if left >= MIN_SECONDS:
                outcome = run(step, left, record, environment)
            spent = round(time.monotonic() - start, 1)
            content["steps"][step.name] = {"outcome": outcome, "seconds": spent}
            if record.exists():
                content[step.name] = json.loads(record.read_text(encoding="utf-8"))
        tuning = folder / "tuning.json"
        if tuning.exists():
            content["tuning"] = json.loads(tuning.read_text(encoding="utf-8"))
    return content


def transfer_lines(content: dict[str, Any]) -> list[str]:
    """Shares of copies between host and device of the cases of the model, predicted and timed."""
    lines = []
    for row in content.get("model", {}).get("rows", []):
        if row["KB over the bus"]:
            predicted = row["H200"]["bus"] / row["H200"]["sum"]
            here = f"{row['copies here']:.0%} of the time on this device"
            lines.append(f"  {row['case']}: {predicted:.0%} by the model, {here}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, on any device")
    parser.add_argument("--json", type=Path, help="write all records to this file")
    options = parser.parse_args()
    content = run_all(options.smoke)
    print("\n==== variants that won ====")
    for key, name in content.get("tuning", {}).items():
        print(f"  {name}  {key}")
    print("\n==== copies between host and device ====")
    for line in transfer_lines(content):
        print(line)
    print("\n==== steps ====")
    for name, step in content["steps"].items():
        print(f"  {name}: {step['outcome']}, {step['seconds']} s")
    if options.json is not None:
        options.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    outcomes = [step["outcome"] for step in content["steps"].values()]
    if any(outcome.startswith("FAILED") for outcome in outcomes):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
