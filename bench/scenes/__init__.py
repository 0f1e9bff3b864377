# SPDX-License-Identifier: BSD-3-Clause
"""A benchmark for inverse light transport: scenes of known bounces, and scores of methods on them.

`tracing` traces T by bounces with Mitsuba 3, `dataset` makes the files of a scene, `scoring` runs
anybody's method and judges its results, `baselines` are such methods. README.md describes the
formats. `perspective` has T of such scenes without noise and without Mitsuba, from form factors
(`exchange`) of the pieces that pixels see (`pieces`).
"""
