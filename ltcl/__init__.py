# SPDX-License-Identifier: BSD-3-Clause
"""ltcl: inverse light transport on any OpenCL device.

A projector lights a concave, coloured scene; light bounces before the camera sees it: picture = T pattern.
ltcl undoes the bounces with matrix-vector products only.

    T = ltcl.load("transport.npz")             # measured, or ltcl.scenes.box(40, sides=3).transport()
    T = ltcl.acquire(rig, store="scan.zarr")   # any projector and camera; stopped and resumed at will
    T = ltcl.compress(T, rtol=1e-2)            # few numbers instead of N^2, solutions within 1 %
    c = ltcl.compensate(T, desired)            # c.pattern makes the wall look like `desired`
    b = ltcl.separate(T, image)                # b.direct, b.bounces: each bounce as its own picture

The house, from the ground up; imports point down only:

    errors, checks, files           one-line refusals; outputs that appear whole or not at all
    device, operators               OpenCL: devices, kernels, arrays; matrices there, S = I + R
    layout                          pictures and matrices by colour channel, as arrays of a linear system
    theory, solvers, diagnostics    forecasts; one algorithm per file; what T tells of its scene
    first_bounce, transport         F; T = S F
    compensation, separation, relighting, analysis, scenes, store       the tasks, test scenes, files of T
    acquisition                     from photographs to T: rigs, radiometry, geometry, scanning
    compression                     T in few numbers, with a bound on what solutions lose
    images, report                  pictures, JSON
    plots, batch, demo, cli         what people look at; many frames

After Chandraker, Bai, Ng and Ramamoorthi, On the Duality of Forward and Inverse Light Transport, IEEE PAMI
2011; equation numbers in this package are that paper's. Importing ltcl touches no OpenCL driver.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

from ltcl import interrupts

if interrupts.is_program(sys.orig_argv):  # before what takes a while
    interrupts.end_in_one_line()

from ltcl import errors
from ltcl.analysis import Analysis, analyze
from ltcl.compensation import Compensation, compensate
from ltcl.compression import Compression, compress, invert
from ltcl.device import Device, list_devices, open_device
from ltcl.relighting import relight
from ltcl.separation import Separation, separate
from ltcl.solvers import Inverse, Solution, Status, solve
from ltcl.store import load, load_inverse, save, save_inverse
from ltcl.transport import Transport

if TYPE_CHECKING:
    from ltcl import acquisition, batch, images, operators, plots, scenes, solvers, theory
    from ltcl.acquisition import acquire

__version__ = "0.1.0"
__all__ = [
    "Analysis",
    "Compensation",
    "Compression",
    "Device",
    "Inverse",
    "Separation",
    "Solution",
    "Status",
    "Transport",
    "acquire",
    "acquisition",
    "analyze",
    "batch",
    "compensate",
    "compress",
    "errors",
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
]

# They bring OpenCV or matplotlib, which not everybody needs.
_LAZY = ("acquisition", "batch", "images", "plots", "scenes")


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return importlib.import_module(f"ltcl.{name}")
    if name == "acquire":
        return importlib.import_module("ltcl.acquisition").acquire
    raise AttributeError(f"module 'ltcl' has no attribute {name!r}")
