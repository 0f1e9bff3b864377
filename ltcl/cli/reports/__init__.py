# SPDX-License-Identifier: BSD-3-Clause
"""JSON documents of all commands, as classes."""
