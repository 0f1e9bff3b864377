# SPDX-License-Identifier: BSD-3-Clause
"""Several projectors as one: T_k = S F_k, where S belongs to the scene and F_k to a projector."""

from ltcl.transport.projectors.combined import CombinedTransport, combine
from ltcl.transport.projectors.gamut import Gamut

__all__ = ["CombinedTransport", "Gamut", "combine"]
