# SPDX-License-Identifier: BSD-3-Clause
"""Small pictures of results in HTML, for notebooks."""

from __future__ import annotations

import base64
import html

import cv2
import numpy as np

from ltcl.images.encoding import from_linear
from ltcl.images.pictures import resize

# Pixels along the longer side of a thumbnail.
MAX_SIDE = 64

# Light above this quantile may be a highlight: it does not determine the brightness.
WHITE_QUANTILE = 0.99

FIGURE = (
    '<figure style="display:inline-block;margin:4px">'
    '<img src="data:image/png;base64,{}"\nstyle="width:128px;image-rendering:pixelated">'
    "<figcaption>{}: white is {:.2g}</figcaption></figure>"
)


def thumbnails(title: object, pictures: dict[str, np.ndarray]) -> str:
    """HTML for a notebook: linear pictures, or first frames, each as bright as its label says."""
    figures = [f"<div>{html.escape(str(title))}</div>"]
    for label, picture in pictures.items():
        light = _shrink(_first_frame(picture))
        white = _white(light)
        codes = from_linear(light / white, "srgb", 8, is_float=False)
        figures.append(FIGURE.format(_base64_png(codes), html.escape(label), white))
    return "".join(figures)


def _first_frame(picture: np.ndarray) -> np.ndarray:
    """The first picture, (h, w) or (h, w, 3), of an array with any axes in front; NaN is black."""
    light = np.nan_to_num(np.atleast_2d(picture))
    while light.ndim > 3 or light.shape[2:] not in ((), (3,)):
        light = light[0]
    return light


def _shrink(light: np.ndarray) -> np.ndarray:
    h, w = light.shape[:2]
    scale = min(MAX_SIDE / max(h, w), 1)
    return resize(light, (max(round(scale * h), 1), max(round(scale * w), 1)))


def _white(light: np.ndarray) -> float:
    """Light that is shown as white; 1 for a black picture."""
    white = float(np.quantile(light, WHITE_QUANTILE))
    if white == 0.0:
        white = float(light.max())
    if white == 0.0:
        return 1.0
    return white


def _base64_png(codes: np.ndarray) -> str:
    if codes.ndim == 3:
        codes = codes[..., ::-1]  # OpenCV keeps BGR
    _, png = cv2.imencode(".png", codes)
    return base64.b64encode(png.tobytes()).decode()
