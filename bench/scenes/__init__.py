# SPDX-License-Identifier: BSD-3-Clause
"""A benchmark for inverse light transport: scenes of known bounces, and how a method is judged on them.

`tracing` traces T by bounces with Mitsuba 3, `dataset` makes the files of a scene, `scoring` runs
anybody's method and judges what it writes, `baselines` are such methods. README.md tells the
formats.
"""
