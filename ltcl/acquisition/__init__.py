# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to a transport: what drives projectors and cameras, and what their pictures say.

radiometry      light from codes: response, noise, exposures, black, merging, colours
"""
