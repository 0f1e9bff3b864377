# SPDX-License-Identifier: BSD-3-Clause
"""Denoising of a measured T by reciprocity, wavelets, and products between walls.

1. The diagonal of a square T, the first bounce, stays as measured and is left out of all that
   follows.
2. Reciprocity (`reciprocity`, `problem`): T_ij d_j = T_ji d_i in a Lambertian scene. In
   Z = D^-1/2 T D^1/2 both entries of a pair are the same light and are averaged, unless Z - Z^T
   exceeds what noise explains: then the scene is glossy.
3. Wavelets (`bases`, `shrinkage`): in C = K Z K^T, with orthonormal multiwavelets K, coefficients
   below 3 standard deviations are dropped. The result P is the pilot of Wiener factors
   P^2 / (P^2 + variance), which are applied to the measured C.
4. Products (`walls`): between two walls, light depends on rows and on columns of the picture
   nearly as a sum of few products. Singular values below those of the remaining noise are dropped.
5. Negative entries become 0; dim entries between the same two blocks of pixels lose as much light.
6. Entries that no noise explains beside their neighbours stay as measured (`problem`).
7. T is denoised once more with added noise, which tells how much of it stays. If that does not show
   that pictures become better, or if what is removed has structure along rows or columns, which
   noise has not, T is denoised without reciprocity, or stays (`risk`).

Known limits: at low noise or with few pixels, most coefficients stand out of the noise;
`bench/denoise.py` prints the bound. Where d spans a factor of over 20, reciprocity is left out:
errors of the fit would cost bounces.
"""

from ltcl.tasks.denoising.denoise import denoise

__all__ = ["denoise"]
