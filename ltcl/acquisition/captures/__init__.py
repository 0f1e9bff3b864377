# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of Gray code that other programs took.

order      which file is the photograph of which pattern
gray_code  the map and the direct light of such photographs
"""

from __future__ import annotations

from ltcl.acquisition.captures.gray_code import Capture, import_gray_code
from ltcl.acquisition.captures.order import PhotographOrder

__all__ = ["Capture", "PhotographOrder", "import_gray_code"]
