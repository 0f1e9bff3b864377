# SPDX-License-Identifier: BSD-3-Clause
"""The tasks that ltcl is used for: compensation, separation, relighting, compression, analysis, denoising."""
