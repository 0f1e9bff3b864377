# SPDX-License-Identifier: BSD-3-Clause
"""How diffuse patches light each other: form factors, what is hidden, and the light transport they give.

From walls to a scene: `assembly`. Form factors on the host: `cube_tables` for the unit cube, `oblique` for
walls at any angle, `contours` for patches that touch, `occlusion` past a block; `crossing` refuses walls that
cut each other. A bounce that stores no matrix: `form_factor`, with `near` for close pairs; `visibility`
traces the rays past blocks, and `geometry` is what kernels read. All bounces of a stored matrix: `transport`.
"""
