# SPDX-License-Identifier: BSD-3-Clause
"""The noise of a measured transport as a quantity: its model, and what it is where nobody measured it."""

from ltcl.transport.noise.estimate import estimate
from ltcl.transport.noise.model import Noise

__all__ = ["Noise", "estimate"]
