# SPDX-License-Identifier: BSD-3-Clause
"""
Figure 5: when the series converges
===================================

The paper's series needs walls that are not too bright, or a box that is open. Chebyshev's
iteration, which ltcl uses, undoes the same boxes in about ten steps, whatever the walls.

``bench/fig5.py`` computes and draws it, there with 16 patches along a wall, here with 6.
"""

import fig5
import ltcl

measured = fig5.measure(6, ltcl.open_device())
figure = fig5.draw(measured)
figure

# %%
# The outcome of each box (1 % by the paper's series; 1e-5 by Chebyshev's iteration):

for race in measured.races:
    print(f"{race.name}: {race.outcome}; Chebyshev {race.chebyshev.products} products")
