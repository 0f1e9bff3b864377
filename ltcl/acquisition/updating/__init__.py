# SPDX-License-Identifier: BSD-3-Clause
"""A finished scan carried over to where the projector and its lamp stand now: `task.update`."""
