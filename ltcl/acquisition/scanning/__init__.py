# SPDX-License-Identifier: BSD-3-Clause
"""Scanning T: which pixels are lit when, and T from the pictures.

pictures           a calibrated rig as a camera on the pixels of the scan
block              blocks of projector pixels as pixels of a coarser scan
pixel, hadamard    how the pixels of a batch are lit, and its columns found
columns            batches of columns into a store
exposed            exposures of a pattern that contradict each other
order              pictures that show the patterns of their batch, or are refused
sums               light that has to add up, and does not
balance            columns that add up to white
thresholds         which entries are light, which noise; sums are tested
adaptive           cells of a quad-tree (cells), those lit together that do not conflict (colouring)
log                pictures in the order in which a scan asked for them, in a store
core               what an adaptive scan found, as a compressed transport
again              the error of T, drawn: the scan again, in numbers
plan, report       what a scan takes, before; what came of it, after
"""

from __future__ import annotations

from ltcl.acquisition.scanning.hadamard import Hadamard
from ltcl.acquisition.scanning.pixel import Pixels
from ltcl.acquisition.scanning.plan import Light, Plan, plans
from ltcl.acquisition.scanning.report import Report

__all__ = ["Hadamard", "Light", "Pixels", "Plan", "Report", "plans"]
