# SPDX-License-Identifier: BSD-3-Clause
"""Glossy rooms on the full light field: light that depends on where it goes.

Start with `glossy`, which puts a room together and computes with it. How a material reflects, in
bins of directions: `brdf`. Light between patches: `beams`.
"""
