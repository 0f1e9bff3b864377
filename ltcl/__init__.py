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
from typing import TYPE_CHECKING, Any

# Before all that takes long: Ctrl-C while the program is imported.
from ltcl.cli import interrupt as _interrupt  # noqa: F401

# isort: split
from ltcl import errors
from ltcl.batch import cluster
from ltcl.device import Device, list_devices, open_device
from ltcl.solvers import Inverse, Solution, Status, solve
from ltcl.store import load, load_inverse, save, save_inverse
from ltcl.tasks import compensation, compression
from ltcl.tasks.analysis import Analysis, analyze
from ltcl.tasks.compensation import Compensation, Compensator, compensate
from ltcl.tasks.compression import Compression, compress, invert
from ltcl.tasks.denoising import denoise
from ltcl.tasks.relighting import relight
from ltcl.tasks.separation import Separation, separate
from ltcl.transport import noise
from ltcl.transport.projectors import CombinedTransport, Gamut, combine
from ltcl.transport.transport import Transport

if TYPE_CHECKING:
    from ltcl import acquisition, batch, images, operators, plots, scenes, solvers, theory
    from ltcl.acquisition import acquire, align, fit, update
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

# What moved into folders keeps its public import path.
_PUBLIC_PATHS = {
    "ltcl.cluster": cluster,
    "ltcl.compensation": compensation,
    "ltcl.compression": compression,
    "ltcl.noise": noise,
}
sys.modules.update(_PUBLIC_PATHS)

_LAZY = ("acquisition", "batch", "images", "plots", "scenes")  # they bring OpenCV or matplotlib
_FUNCTIONS = {
    "acquire": "acquisition",
    "align": "acquisition",
    "fit": "acquisition",
    "update": "acquisition",
    "view": "viewer",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return importlib.import_module(f"ltcl.{name}")
    if name in _FUNCTIONS:
        return getattr(importlib.import_module(f"ltcl.{_FUNCTIONS[name]}"), name)
    raise AttributeError(f"module 'ltcl' has no attribute {name!r}")
