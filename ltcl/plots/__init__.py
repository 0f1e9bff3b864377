# SPDX-License-Identifier: BSD-3-Clause
"""Plots: pictures under their names, the convergence of solves, the results of an analysis.

Every function takes data and returns a matplotlib `Figure`. A notebook shows it, its method `show`
opens it elsewhere, and `save` writes it whole or not at all. Figures are drawn by Agg without
pyplot, so nothing here but `show` needs a screen or touches global state.
matplotlib is imported by the first plot, not with this module.
"""

from __future__ import annotations

from ltcl.plots.figures import analysis, convergence, pictures
from ltcl.plots.page import save

__all__ = ["analysis", "convergence", "pictures", "save"]
