# SPDX-License-Identifier: BSD-3-Clause
"""A device as its driver describes it, before it is opened."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

KINDS = ("gpu", "accelerator", "cpu", "simulator")  # the best first


@dataclass(frozen=True)
class Description:
    """One device. `index` is what `open_device` takes: "platform:device"."""

    index: str
    name: str
    kind: str
    platform: str
    driver: str
    compute_units: int
    memory: int
    max_allocation: int
    handle: Any = field(repr=False, compare=False)

    @property
    def rank(self) -> tuple:
        """Sort key: GPUs by compute units, CPUs by how new their driver is, the best first."""
        newest = tuple(-number for number in (*_version(self.driver), 0, 0, 0)[:4])
        return (KINDS.index(self.kind), -self.compute_units if self.kind == "gpu" else 0, newest, self.index)


def describe(index: str, platform: Any, handle: Any) -> Description:
    """The description of a pyopencl device."""
    return Description(
        index=index,
        name=handle.name.strip(),
        kind=_kind(platform, handle),
        platform=platform.name.strip(),
        driver=f"{platform.name.strip()} {handle.driver_version.strip()}",
        compute_units=handle.max_compute_units,
        memory=handle.global_mem_size,
        max_allocation=handle.max_mem_alloc_size,
        handle=handle,
    )


def _kind(platform: Any, handle: Any) -> str:
    import pyopencl as cl

    if "oclgrind" in platform.name.lower():
        return "simulator"
    if handle.type & cl.device_type.GPU:
        return "gpu"
    return "cpu" if handle.type & cl.device_type.CPU else "accelerator"


def _version(text: str) -> tuple[int, ...]:
    """The numbers of the last dotted version in `text`: 'Portable ... 3.0-rc2' -> (3, 0)."""
    found = re.findall(r"\d+(?:\.\d+)+", text)
    return tuple(int(number) for number in found[-1].split(".")) if found else (0,)
