# SPDX-License-Identifier: BSD-3-Clause
"""The noise of a measured transport: its model, fit to measurements, and estimate from T."""

from ltcl.transport.noise.estimate import estimate
from ltcl.transport.noise.model import Noise

__all__ = ["Noise", "estimate"]
