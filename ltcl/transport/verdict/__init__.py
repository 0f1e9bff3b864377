# SPDX-License-Identifier: BSD-3-Clause
"""The uses that a measured T is good for, the reason if there are not more, and advice."""

from ltcl.transport.verdict.verdict import Verdict, verdict

__all__ = ["Verdict", "verdict"]
