# SPDX-License-Identifier: BSD-3-Clause
"""Transports estimated from pictures: rows of T in functions that widen with the distance.

The direct part of T is local, its indirect part is smooth; so far fewer pictures than pixels
determine it. `neighbours` finds the direct part alone.
"""
