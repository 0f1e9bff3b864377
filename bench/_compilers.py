# SPDX-License-Identifier: BSD-3-Clause
"""Offline compilers for GPUs that are not here: NVIDIA's PTX and ptxas, AMD's gfx906, SPIR-V.

clang 19 with libclc makes PTX and AMD's code; clang 22, the first in Debian with SPIR-V of its own,
makes SPIR-V, of programs in the launch shape of a GPU only: from some of those for a CPU it makes
vectors of seven, which SPIR-V does not have. Registers differ by version, so the record keeps it.
A driver's own compiler may choose other numbers; these show what a change of a kernel does.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from ltcl.device import sources

Figures = dict[str, dict[str, float]]

NVIDIA_CLANG = "clang-19"
SPIRV_CLANG = "clang-22"
NVIDIA_ARCHITECTURE = "sm_90"
AMD_ARCHITECTURE = "gfx906"
LIBCLC = Path("/usr/lib/clc")
NVIDIA_LIBRARY = LIBCLC / "nvptx64--nvidiacl.bc"
AMD_LIBRARY = LIBCLC / f"{AMD_ARCHITECTURE}-amdgcn-mesa-mesa3d.bc"

# A multiprocessor of an H100: registers of 32 bits, warps at most, items of a warp. Registers are
# given to an item by eights, and warps are spread over four schedulers.
SM_REGISTERS = 65536
SM_WARPS = 64
WARP = 32
REGISTER_STEP = 8
SM_SCHEDULERS = 4
# Waves at most on a SIMD of gfx906.
SIMD_WAVES = 10


class CompileError(Exception):
    """A compiler refuses a program, in its own words."""


@dataclass(frozen=True, order=True)
class Program:
    """A file of `kernels/` with its defines, as they stand on the command line of a compiler."""

    file: str
    defines: tuple[tuple[str, str], ...]

    @property
    def options(self) -> list[str]:
        """Options of its compilation that all compilers share."""
        options = [option for option in sources.OPTIONS if option != "-cl-kernel-arg-info"]
        for name, value in self.defines:
            options.append(f"-D{name}={value}")
        return options

    @property
    def path(self) -> str:
        """The file of its source."""
        return str(sources.folder() / f"{self.file}.cl")

    def __str__(self) -> str:
        defines = " ".join(f"-D{name}={value}" for name, value in self.defines)
        return f"kernels/{self.file}.cl {defines}".rstrip()


@dataclass(frozen=True)
class NvidiaFigures:
    """Figures of a kernel on an H100; bytes are those of an item.

    `occupancy` is the share of all warps that registers allow; `loads` and `wide_loads` are the
    instructions that load one number, or two or four, from global memory.
    """

    registers: int
    spilled_bytes: int
    stack_bytes: int
    occupancy: float
    loads: int
    wide_loads: int


@dataclass(frozen=True)
class AmdFigures:
    """Figures of a kernel on gfx906; `occupancy` is the share of all waves that it allows."""

    registers: int
    spilled_registers: int
    stack_bytes: int
    occupancy: float


@dataclass(frozen=True)
class Target:
    """What programs are compiled for: the tools it needs, and what it tells of each kernel.

    `compile` takes a program and an empty folder. `version` is None if a tool is missing; `shapes`
    are the launch shapes whose programs it takes.
    """

    name: str
    version: str | None
    needs: str
    compile: Callable[[Program, Path], Figures]
    shapes: frozenset[str] = frozenset({"cpu", "gpu"})


def targets() -> list[Target]:
    """All targets, also those whose tools are missing."""
    nvidia = Target(
        "nvidia", _nvidia_version(), "clang-19, libclc-19 and ptxas", _compile_for_nvidia
    )
    amd = Target("amd", _amd_version(), "clang-19 and libclc-19", _compile_for_amd)
    spirv = Target(
        "spirv",
        _spirv_version(),
        "clang-22 and spirv-val",
        _compile_to_spirv,
        shapes=frozenset({"gpu"}),
    )
    return [nvidia, amd, spirv]


def _run(*command: str) -> str:
    """Output and messages of a command; what it says is raised if it fails."""
    run = subprocess.run(  # noqa: S603 - compilers of this machine
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    if run.returncode != 0:
        raise CompileError(f"{Path(command[0]).name}: {(run.stderr + run.stdout).strip()[:2000]}")
    return run.stdout + run.stderr


def ptxas() -> str | None:
    """NVIDIA's assembler: that of the wheel nvidia-cuda-nvcc, else that of the path."""
    package = importlib.util.find_spec("nvidia")
    if package is not None and package.submodule_search_locations is not None:
        for folder in package.submodule_search_locations:
            for path in sorted(Path(folder).glob("*/bin/ptxas")):
                return str(path)
    return shutil.which("ptxas")


def _version(command: str | None, pattern: str) -> str | None:
    """The version that a tool tells, or None if it is missing."""
    if command is None or shutil.which(command) is None:
        return None
    found = re.search(pattern, _run(command, "--version"))
    return found[1] if found else None


def _nvidia_version() -> str | None:
    clang = _version(NVIDIA_CLANG, r"version (\d+\.\d+\.\d+)")
    assembler = _version(ptxas(), r"V(\d+\.\d+\.\d+)")
    if clang is None or assembler is None or not NVIDIA_LIBRARY.exists():
        return None
    return f"clang {clang}, ptxas {assembler}, {NVIDIA_ARCHITECTURE}"


def _amd_version() -> str | None:
    clang = _version(NVIDIA_CLANG, r"version (\d+\.\d+\.\d+)")
    if clang is None or not AMD_LIBRARY.exists():
        return None
    return f"clang {clang}, {AMD_ARCHITECTURE}"


def _spirv_version() -> str | None:
    clang = _version(SPIRV_CLANG, r"version (\d+\.\d+\.\d+)")
    if clang is None or shutil.which("spirv-val") is None:
        return None
    return f"clang {clang}"


def _clang(program: Program, clang: str, output: Path, *options: str) -> str:
    """Compile a program to `output`, with options of a target."""
    return _run(
        clang, "-x", "cl", "-O2", *options, *program.options, program.path, "-o", str(output)
    )


def _linked(library: Path) -> list[str]:
    """Options that link a library of libclc."""
    return ["-Xclang", "-mlink-builtin-bitcode", "-Xclang", str(library)]


def _compile_for_nvidia(program: Program, folder: Path) -> Figures:
    assembler = ptxas()
    if assembler is None:
        raise CompileError("ptxas is missing")
    ptx = folder / "program.ptx"
    target = ["-target", "nvptx64-nvidia-nvcl", f"-march={NVIDIA_ARCHITECTURE}", "-S"]
    _clang(program, NVIDIA_CLANG, ptx, *target, *_linked(NVIDIA_LIBRARY))
    output = str(folder / "program.cubin")
    report = _run(assembler, "-v", "-arch", NVIDIA_ARCHITECTURE, str(ptx), "-o", output)
    loads = _loads(ptx.read_text(encoding="utf-8"))
    figures: Figures = {}
    for part in report.split("Compiling entry function '")[1:]:
        kernel = part.partition("'")[0]
        registers = _number(r"Used (\d+) registers", part)
        scalar, wide = loads[kernel]
        nvidia = NvidiaFigures(
            registers=registers,
            spilled_bytes=_number(r"(\d+) bytes spill stores", part),
            stack_bytes=_number(r"(\d+) bytes stack frame", part),
            occupancy=sm_occupancy(registers),
            loads=scalar,
            wide_loads=wide,
        )
        figures[kernel] = asdict(nvidia)
    return figures


def _loads(ptx: str) -> dict[str, tuple[int, int]]:
    """Scalar and wide loads from global memory in each kernel of a PTX file."""
    loads = {}
    for part in re.split(r"\.entry\s+", ptx)[1:]:
        kernel = part.partition("(")[0].strip()
        found = re.findall(r"\bld\.global[.\w]*", part)
        wide = [load for load in found if re.search(r"\.v[248]\b", load)]
        loads[kernel] = len(found) - len(wide), len(wide)
    return loads


def _number(pattern: str, text: str) -> int:
    """The first number of a pattern in a report."""
    found = re.search(pattern, text)
    if found is None:
        raise CompileError(f"no {pattern} in: {text[:500]}")
    return int(found[1])


def sm_occupancy(registers: int) -> float:
    """Share of the warps of a multiprocessor that fit with so many registers an item."""
    rounded = -(-registers // REGISTER_STEP) * REGISTER_STEP
    warps = SM_REGISTERS // (WARP * rounded)
    warps -= warps % SM_SCHEDULERS
    return round(min(warps, SM_WARPS) / SM_WARPS, 3)


def _compile_for_amd(program: Program, folder: Path) -> Figures:
    target = ["-target", "amdgcn-mesa-mesa3d", f"-mcpu={AMD_ARCHITECTURE}", "-nogpulib", "-S"]
    remarks = "-Rpass-analysis=kernel-resource-usage"
    options = [*target, *_linked(AMD_LIBRARY), remarks]
    report = _clang(program, NVIDIA_CLANG, folder / "program.s", *options)
    figures: Figures = {}
    for part in report.split("Function Name: ")[1:]:
        kernel = part.split()[0]
        spilled = _number(r"VGPRs Spill: (\d+)", part) + _number(r"SGPRs Spill: (\d+)", part)
        waves = _number(r"Occupancy \[waves/SIMD\]: (\d+)", part)
        amd = AmdFigures(
            registers=_number(r" VGPRs: (\d+)", part),
            spilled_registers=spilled,
            stack_bytes=_number(r"ScratchSize \[bytes/lane\]: (\d+)", part),
            occupancy=waves / SIMD_WAVES,
        )
        figures[kernel] = asdict(amd)
    return figures


def _compile_to_spirv(program: Program, folder: Path) -> Figures:
    module = folder / "program.spv"
    _clang(program, SPIRV_CLANG, module, "-target", "spirv64", "-c")
    _run("spirv-val", str(module))
    return {}
