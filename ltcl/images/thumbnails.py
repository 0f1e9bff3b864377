# SPDX-License-Identifier: BSD-3-Clause
"""Results as small pictures in a notebook: what `_repr_html_` of them returns."""

from __future__ import annotations

import base64
import html
import io

import cv2
import numpy as np
from PIL import Image

from ltcl.images.srgb import to_srgb

_PIXELS = 64  # of the longer side; smaller pictures keep their pixels


def figures(title: object, pictures: dict[str, np.ndarray]) -> str:
    """HTML of labelled PNG files inside of it, each as bright as its brightest values, which the label names.

    Pictures are linear, (h, w), (h, w, 3) or frames of these, of which the first is shown.

    >>> figures("T", {"F": np.eye(2)}).count("data:image/png;base64,")
    1
    """
    parts = []
    for label, picture in pictures.items():
        light = np.nan_to_num(np.atleast_2d(picture)).astype(np.float32)
        while light.ndim > 3 or (light.ndim == 3 and light.shape[2] != 3):
            light = light[0]
        scale = _PIXELS / max(light.shape[:2])
        if scale < 1:
            h, w = (max(round(side * scale), 1) for side in light.shape[:2])
            light = cv2.resize(light, (w, h), interpolation=cv2.INTER_AREA)
        white = float(np.quantile(light, 0.99)) or float(light.max()) or 1.0
        file = io.BytesIO()
        codes = np.rint(255 * to_srgb(np.clip(light / white, 0, 1))).astype(np.uint8)
        Image.fromarray(codes).save(file, "PNG")
        source = "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
        parts.append(
            f'<figure style="display:inline-block;margin:4px"><img src="{source}" '
            'style="width:128px;image-rendering:pixelated">'
            f"<figcaption>{html.escape(label)}: white is {white:.2g}</figcaption></figure>"
        )
    return f"<div>{html.escape(str(title))}</div>{''.join(parts)}"
