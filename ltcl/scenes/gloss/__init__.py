# SPDX-License-Identifier: BSD-3-Clause
"""Glossy rooms on the full light field: light that depends on where it goes.

Start with `glossy`, which puts a room together, and `light_field`, which computes with it. How a material
reflects: `brdf`, in the bins of `directions`. Light between patches: `beams`. What projector and camera see:
`sight`.
"""
