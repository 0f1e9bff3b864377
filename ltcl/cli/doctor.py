# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl doctor`: everything ltcl needs, tried one by one, with a fix for what fails.

A check is a function that returns what it found, or raises; the device layer's own checks are in
`ltcl.cli.device_checks`.
"""

from __future__ import annotations

import importlib.metadata
import platform
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import typer

from ltcl import __version__
from ltcl.cli import console, device_checks, options
from ltcl.device import open_device
from ltcl.errors import FileError, LtclError

# What pyproject.toml asks for, where ltcl runs from a checkout and so has no metadata.
_DEPENDENCIES = """
    pyopencl numpy scipy PyWavelets opencv-contrib-python-headless OpenEXR zarr typer rich matplotlib
    platformdirs
"""

_HIDING = "update or remove that driver, or take a working one alone: OCL_ICD_VENDORS=FILE.icd"
_OPENING = "install a driver, or name one that 'ltcl devices' lists (--device, LTCL_DEVICE)"


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's table."""

    check: str
    passed: bool
    found: str
    fix: str = ""


def run(device: options.Device = None, json: options.Json = False) -> None:
    """Try everything ltcl needs: Python, drivers, kernels, results, cache; exit code 1 if something fails."""
    findings = []
    for finding in examine(device):
        findings.append(finding)
        if not json:
            _show(finding)
    failed = [finding for finding in findings if not finding.passed]
    if json:
        console.answer({"passed": not failed, "checks": findings})
    else:
        typer.echo("\n" + (f"{len(failed)} of {len(findings)} checks failed" if failed else "all is well"))
    if failed:
        raise typer.Exit(1)


def examine(device: str | None) -> Iterator[Finding]:
    """Every check in turn; those that need a device only where one opens."""
    yield attempt("ltcl and Python", _python, "pip install --upgrade ltcl")
    yield attempt("dependencies", _dependencies, "pip install --upgrade ltcl")
    yield attempt("cache folder", device_checks.cache_folder, _cache_fix)
    drivers = attempt("drivers", device_checks.drivers, _HIDING)
    yield drivers
    if not drivers.passed:  # what crashes a child would crash this process, too
        return
    opening = attempt("device", lambda: str(open_device(device)), _OPENING)
    yield opening
    if not opening.passed:
        return
    opened = open_device(device)
    update = f"update the driver {opened.driver}, or choose another device with LTCL_DEVICE"
    for check, action in device_checks.on_device(opened).items():
        yield attempt(check, action, update)
    yield attempt("tuning", device_checks.tuning, "make the cache folder writable, or set LTCL_CACHE")


def _cache_fix(error: Exception) -> str:
    """A mode can be changed; a read-only disk, or a file in the way, cannot."""
    elsewhere = "set LTCL_CACHE=DIR to a folder that can be written"
    changeable = isinstance(error, (FileError, PermissionError))
    return f"chmod 700 the folder, or {elsewhere}" if changeable else elsewhere


def attempt(check: str, action: Callable[[], str], fix: str | Callable[[Exception], str]) -> Finding:
    """Run one check. Whatever it raises is a finding: a doctor does not die of the disease."""
    try:
        return Finding(check, True, action())
    except (LtclError, OSError) as error:
        found, cause = _one_line(error), error
    except Exception as error:  # noqa: BLE001 - a broken driver may raise anything
        found, cause = f"{type(error).__name__}: {_one_line(error)}", error
    return Finding(check, False, found, fix if isinstance(fix, str) else fix(cause))


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _show(finding: Finding) -> None:
    mark = "ok    " if finding.passed else "FAILED"
    typer.echo(f"{mark}  {finding.check:<24}  {finding.found}")
    if not finding.passed:
        typer.echo(f"        {'':<24}  fix: {finding.fix}")


def _python() -> str:
    return f"ltcl {__version__}, Python {platform.python_version()}, {platform.platform()}"


def _dependencies() -> str:
    found, wrong = [], []
    for name, least in _wanted():
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            wrong.append(f"{name} is missing")
            continue
        found.append(f"{name} {version}")
        if _numbers(version) < _numbers(least):
            wrong.append(f"{name} is {version}, it must be at least {least}")
    if wrong:
        raise LtclError("; ".join(wrong))
    return ", ".join(found)


def _wanted() -> list[tuple[str, str]]:
    """Name and least version of each package that ltcl always needs."""
    try:
        lines = importlib.metadata.requires("ltcl") or []
    except importlib.metadata.PackageNotFoundError:
        lines = _DEPENDENCIES.split()
    wanted: dict[str, str] = {}
    for line in lines:
        requirement, _, marker = line.partition(";")
        found = re.match(r"\s*([\w.-]+)(?:\[[^]]*\])?\s*(?:>=\s*([\w.]+))?", requirement)
        if found is not None and "extra" not in marker:
            wanted[found[1]] = found[2] or "0"
    return list(wanted.items())


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])
