# SPDX-License-Identifier: BSD-3-Clause
"""Scanning T: which pixels are lit when, and T from the pictures.

pictures      a calibrated rig as a camera on the pixels of the scan
checks        photographs of a batch against what is known of them
codes         how the pixels of a batch are lit, and its columns estimated
columns       batches of columns into a store; thresholds: which entries are light
balance       rows that add up to white
adaptive      cells of a quad-tree (cells), those lit together that do not conflict; core: T from them
log           pictures in the order in which a scan asked for them, in a store
plan, forecast, report
              what a scan takes, before; the error of T, by bootstrap; what came of it
"""

from __future__ import annotations

from ltcl.acquisition.scanning.codes import Hadamard, Pixels
from ltcl.acquisition.scanning.plan import Light, Plan, plans
from ltcl.acquisition.scanning.report import Report

__all__ = ["Hadamard", "Light", "Pixels", "Plan", "Report", "plans"]
