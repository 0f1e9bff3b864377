# SPDX-License-Identifier: BSD-3-Clause
"""Response and colours of a projector as .cube files, which colour software reads.

NAME_response.cube, of one dimension, has codes of the projector whose light, relative to white, is
that of the sRGB code that is looked up. NAME_colours.cube, of three dimensions, also undoes how the
projector's colours mix in the camera's: of light t of the camera relative to white, with the mixing
M and white m = M 1, the projector gets M^-1 (m t), clipped to [0, 1].
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltcl.acquisition import Calibration
from ltcl.files import replace_file
from ltcl.images.encoding import from_srgb
from ltcl.show.export.projector import ExportedProjector

RESPONSE_SIZE = 1024
COLOUR_SIZE = 33


def write_cubes(folder: Path, projector: ExportedProjector, remark: str) -> list[str]:
    """Write the .cube files that the calibration allows; return their names."""
    calibration = projector.calibration
    if calibration is None:
        return []
    files = [f"{projector.name}_response.cube"]
    light = np.repeat(from_srgb(np.linspace(0.0, 1.0, RESPONSE_SIZE))[:, None], 3, axis=-1)
    _write(folder / files[0], f"LUT_1D_SIZE {RESPONSE_SIZE}", _codes(calibration, light), remark)
    if calibration.mixing is not None:
        files.append(f"{projector.name}_colours.cube")
        codes = colour_codes(calibration, COLOUR_SIZE)
        _write(folder / files[1], f"LUT_3D_SIZE {COLOUR_SIZE}", codes, remark)
    return files


def colour_codes(calibration: Calibration, size: int) -> np.ndarray:
    """Codes (size^3, 3) for all sRGB colours, red changing fastest."""
    mixing = np.asarray(calibration.mixing, np.float64)
    light = from_srgb(np.linspace(0.0, 1.0, size))
    blue, green, red = np.meshgrid(light, light, light, indexing="ij")
    colours = np.stack([red, green, blue], axis=-1).reshape(-1, 3)
    needed = np.linalg.solve(mixing, (colours * mixing.sum(axis=1)).T).T
    return _codes(calibration, np.clip(needed, 0.0, 1.0))


def _codes(calibration: Calibration, light: np.ndarray) -> np.ndarray:
    """Codes of the projector for light (n, 3) relative to white."""
    response = calibration.projector
    samples = light
    if response.channels == 3:
        samples = light[None]
    codes = response.codes(samples)
    return np.reshape(codes, light.shape)


def _write(path: Path, size: str, codes: np.ndarray, remark: str) -> None:
    lines = [f"# {remark}", f'TITLE "{path.stem}"', size]
    for red, green, blue in codes:
        lines.append(f"{red:.6f} {green:.6f} {blue:.6f}")
    with replace_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
