# SPDX-License-Identifier: BSD-3-Clause
"""A scene of Mitsuba 3, loaded with a pattern of sharp pixels in its projector; the variant that renders it.

Variants that compile kernels through LLVM are faster, but some versions of LLVM abort the whole process while
they do. So a trial runs in a process of its own.
"""

from __future__ import annotations

import functools
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np

from ltcl import checks
from ltcl.acquisition.rigs.mitsuba_scenes import SCENES, mitsuba_scene, within
from ltcl.errors import InputError
from ltcl.files import input_file

_SCALAR, _VECTOR = "scalar_rgb", "llvm_ad_rgb"
_PATIENCE = 120  # seconds for the trial


class Loaded(NamedTuple):
    """A loaded scene, its parameters, and the name of the one that is the projector's pattern."""

    scene: Any
    parameters: Any
    irradiance: str


def variant_of(mi: Any, name: str) -> str:
    """The variant to render with: as named, or for "auto" the fastest that works here.

    Raises
    ------
    InputError
        No RGB variant has that name.
    """
    offered = [known for known in mi.variants() if known.endswith("_rgb")]
    name = checks.one_of("variant", name, ["auto", *offered])
    if name != "auto":
        return name
    return _VECTOR if _VECTOR in offered and _renders(_VECTOR) else _SCALAR


@functools.cache
def _renders(variant: str) -> bool:
    """Whether a small scene can be rendered, tried in a process of its own, which it may abort."""
    trial = (
        f"import sys; sys.path[:] = {sys.path!r}\n"
        f"from ltcl.acquisition.rigs.mitsuba import MitsubaRig\n"
        f"MitsubaRig('box', (4, 4), samples=1, variant={variant!r})"
    )
    this_python = [sys.executable, "-c", trial]
    try:
        run = subprocess.run(this_python, capture_output=True, timeout=_PATIENCE)  # noqa: S603
    except (OSError, subprocess.TimeoutExpired):
        return False
    return run.returncode == 0


def load(
    mi: Any, variant: str, scene: Any, grid: tuple[int, int], camera_grid: tuple[int, int] | None
) -> Loaded:
    """The scene, a name, a dict or an XML file, with a white pattern on the projector's `grid`.

    Raises
    ------
    InputError
        Mitsuba cannot load it, or it has not one projector and one sensor.
    FileError
        There is no such file.
    """
    if isinstance(scene, str) and scene in SCENES:
        scene, camera_grid = mitsuba_scene(scene, grid, camera_grid=camera_grid), None
    path = None if isinstance(scene, dict) else str(input_file(scene))
    with within(mi, variant):
        settings = mi.parser.ParserConfig(variant)
        try:
            if path is None:
                parsed = mi.parser.parse_dict(settings, scene)
            else:
                parsed = mi.parser.parse_file(settings, path)
            _put_pattern(mi, parsed, grid)
            mi.parser.transform_all(settings, parsed)
            loaded = mi.parser.instantiate(settings, parsed)
        except RuntimeError as error:
            raise InputError(f"scene cannot be loaded by Mitsuba: {line(error)}") from error
        loaded = loaded[0] if isinstance(loaded, list) else loaded
        return _staged(mi, loaded, camera_grid)


def _put_pattern(mi: Any, parsed: Any, grid: tuple[int, int]) -> None:
    """Give the one projector a pattern of sharp pixels, white for now."""
    projectors = [node for node in parsed.nodes if node.props.plugin_name() == "projector"]
    if len(projectors) != 1:
        raise InputError(f"scene has {len(projectors)} projectors; it must have one emitter of that type")
    white = mi.Bitmap(np.ones((*grid, 3), np.float32))
    pattern = {"type": "bitmap", "bitmap": white, "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
    projectors[0].props["irradiance"] = mi.load_dict(pattern)


def _staged(mi: Any, scene: Any, camera_grid: tuple[int, int] | None) -> Loaded:
    if not hasattr(scene, "sensors") or len(scene.sensors()) != 1:
        raise InputError("scene is no scene with one sensor; it must have one")
    parameters = mi.traverse(scene)
    names = list(parameters.keys())
    if camera_grid is not None:
        (film,) = (key for key in names if key.endswith("film.size"))
        parameters[film] = mi.ScalarVector2u(camera_grid[1], camera_grid[0])
        parameters.update()
    (irradiance,) = (key for key in names if key.endswith("irradiance.data"))
    return Loaded(scene, parameters, irradiance)


def line(error: Exception) -> str:
    """What Mitsuba says, in one line."""
    return " ".join(str(error).split())[:300]
