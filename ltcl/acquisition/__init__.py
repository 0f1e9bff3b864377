# SPDX-License-Identifier: BSD-3-Clause
"""Measuring light transport: rigs, radiometry, geometry, scanning."""

from __future__ import annotations

from ltcl.acquisition.geometry import Correspondence

__all__ = ["Correspondence"]
