# SPDX-License-Identifier: BSD-3-Clause
"""Tasks of ltcl: compensation, separation, relighting, compression, analysis and denoising."""
