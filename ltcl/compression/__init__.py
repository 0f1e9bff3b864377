# SPDX-License-Identifier: BSD-3-Clause
"""Compressed transports: R as few numbers between two bases, with a bound on what a solution loses."""
