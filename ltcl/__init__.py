# SPDX-License-Identifier: BSD-3-Clause
"""ltcl: inverse light transport on any OpenCL device.

A projector lights a concave, coloured scene; light bounces before the camera sees it: picture = T
pattern. ltcl undoes the bounces with matrix-vector products only.

    T = ltcl.load("transport.npz")    # measured; `ltcl.scenes` also makes transports
    T = ltcl.acquire(rig, store="scan.zarr")    # photographed; stopped and resumed at will
    T = ltcl.compress(T, rtol=1e-2)    # few numbers instead of N^2, pictures within 1 %
    c = ltcl.compensate(T, desired)    # c.pattern makes the wall look like `desired`
    b = ltcl.separate(T, image)    # b.direct, b.bounces: each bounce as its own picture

After Chandraker, Bai, Ng and Ramamoorthi, On the Duality of Forward and Inverse Light Transport,
IEEE PAMI 2011; equation numbers in this package are that paper's. Importing ltcl touches no OpenCL
driver.
"""

from __future__ import annotations

import importlib
import sys
from importlib.machinery import ModuleSpec
from typing import TYPE_CHECKING, Any

# Before all that takes long: Ctrl-C while the program is imported.
from ltcl.cli import interrupt as _interrupt  # noqa: F401

# isort: split
from ltcl import errors

if TYPE_CHECKING:
    from ltcl import acquisition, batch, images, operators, plots, scenes, solvers, theory
    from ltcl.acquisition import acquire, align, fit, update
    from ltcl.device import Device, list_devices, open_device
    from ltcl.solvers import Inverse, Solution, Status, solve
    from ltcl.store import load, load_inverse, save, save_inverse
    from ltcl.tasks.analysis import Analysis, analyze
    from ltcl.tasks.compensation import Compensation, Compensator, compensate
    from ltcl.tasks.compression import Compression, compress, invert
    from ltcl.tasks.denoising import denoise
    from ltcl.tasks.relighting import relight
    from ltcl.tasks.separation import Separation, separate
    from ltcl.transport.projectors import CombinedTransport, Gamut, combine
    from ltcl.transport.transport import Transport
    from ltcl.viewer import view

__version__ = "0.1.0"
__all__ = [
    "Analysis",
    "CombinedTransport",
    "Compensation",
    "Compensator",
    "Compression",
    "Device",
    "Gamut",
    "Inverse",
    "Separation",
    "Solution",
    "Status",
    "Transport",
    "acquire",
    "acquisition",
    "align",
    "analyze",
    "batch",
    "combine",
    "compensate",
    "compress",
    "denoise",
    "errors",
    "fit",
    "images",
    "invert",
    "list_devices",
    "load",
    "load_inverse",
    "open_device",
    "operators",
    "plots",
    "relight",
    "save",
    "save_inverse",
    "scenes",
    "separate",
    "solve",
    "solvers",
    "theory",
    "update",
    "view",
]

# Names are loaded at their first use: the help of the program needs none of them.
_PACKAGES = {
    "acquisition",
    "batch",
    "demo",
    "device",
    "images",
    "operators",
    "plots",
    "scenes",
    "show",
    "solvers",
    "store",
    "tasks",
    "theory",
    "transport",
    "viewer",
}
_MODULES = {
    "Analysis": "tasks.analysis",
    "CombinedTransport": "transport.projectors",
    "Compensation": "tasks.compensation",
    "Compensator": "tasks.compensation",
    "Compression": "tasks.compression",
    "Device": "device",
    "Gamut": "transport.projectors",
    "Inverse": "solvers",
    "Separation": "tasks.separation",
    "Solution": "solvers",
    "Status": "solvers",
    "Transport": "transport.transport",
    "acquire": "acquisition",
    "align": "acquisition",
    "analyze": "tasks.analysis",
    "combine": "transport.projectors",
    "compensate": "tasks.compensation",
    "compress": "tasks.compression",
    "denoise": "tasks.denoising",
    "fit": "acquisition",
    "invert": "tasks.compression",
    "list_devices": "device",
    "load": "store",
    "load_inverse": "store",
    "open_device": "device",
    "relight": "tasks.relighting",
    "save": "store",
    "save_inverse": "store",
    "separate": "tasks.separation",
    "solve": "solvers",
    "update": "acquisition",
    "view": "viewer",
}
# What moved into folders keeps its public import path.
_PUBLIC_PATHS = {
    "ltcl.cluster": "ltcl.batch.cluster",
    "ltcl.compensation": "ltcl.tasks.compensation",
    "ltcl.compression": "ltcl.tasks.compression",
    "ltcl.noise": "ltcl.transport.noise",
}


class _PublicPaths:
    """Finder and loader of `_PUBLIC_PATHS`: `ltcl.noise` is the module `ltcl.transport.noise`."""

    def find_spec(self, fullname: str, *_: Any) -> ModuleSpec | None:
        loader: Any = self
        if fullname not in _PUBLIC_PATHS:
            return None
        return ModuleSpec(fullname, loader)

    def create_module(self, spec: ModuleSpec) -> None:
        """Let importlib make a module, which `exec_module` replaces."""

    def exec_module(self, module: Any) -> None:
        name = module.__name__
        sys.modules[name] = importlib.import_module(_PUBLIC_PATHS[name])


sys.meta_path.append(_PublicPaths())


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value = getattr(importlib.import_module(f"ltcl.{_MODULES[name]}"), name)
        globals()[name] = value
        return value
    if name in _PACKAGES or f"ltcl.{name}" in _PUBLIC_PATHS:
        return importlib.import_module(f"ltcl.{name}")
    raise AttributeError(f"module 'ltcl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES, *_PACKAGES})
