# SPDX-License-Identifier: BSD-3-Clause
"""
From SciPy and PyLops
=====================

The operators of ltcl are SciPy's ``LinearOperator``: whatever takes one of these takes them. And SciPy's matrices and
operators can be used in ltcl.
"""

# %%
# The parts of T
# --------------
#
# ``T.systems`` holds one operator S for each colour, on the device. A picture is T p = S F p with the diagonal F, so that S
# undoes nothing but bounces: its diagonal is about 1.

import numpy as np
import pylops
import scipy.sparse
import scipy.sparse.linalg

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(16, albedo=0.8)
T = corner.transport()
(S,) = T.systems
print(type(S).__mro__[0].__name__, S.shape, S.dtype, isinstance(S, scipy.sparse.linalg.LinearOperator))

# %%
# In SciPy
# --------
#
# NumPy in, NumPy out. ``S @ x``, ``S.T``, sums and products of operators, ``gmres``, ``svds``, ``eigs``: all run the products on the device.

picture = T @ (0.2 + 0.8 * corner.sample(ltcl.scenes.landscape(240, 480)[..., 0]))
b = picture.ravel()

steps = []
x, failed = scipy.sparse.linalg.gmres(S, b, rtol=1e-4, callback=steps.append, callback_type="pr_norm")
ours = ltcl.solve(S, b, "gmres", rtol=1e-4)  # without a name: up to 512 pixels a factorization
print(f"SciPy's GMRES: {len(steps)} steps; ltcl's: {ours.products} products")
print(f"difference {np.linalg.norm(x - ours.x) / np.linalg.norm(x):.1e}")

# %%
# The largest singular values tell how much a smooth picture gains by bounces:

values = scipy.sparse.linalg.svds(S, k=3, return_singular_vectors=False)
print(np.sort(values)[::-1].round(3))

# %%
# In PyLops
# ---------
#
# ``pylops.aslinearoperator`` takes it. Here a pattern is looked for that makes the picture *and* is smooth, by adding a second derivative to
# the least squares problem: something that ltcl alone does not do.

A = pylops.aslinearoperator(S)
edges = pylops.Laplacian(dims=corner.grid, dtype="float32")
noise = 0.03 * np.random.default_rng(0).normal(size=b.size)
noisy = (b * (1 + noise)).astype(np.float32)

plain = ltcl.solve(S, noisy, rtol=1e-3).x
smooth = pylops.optimization.leastsquares.regularized_inversion(A, noisy, [edges], epsRs=[0.5], iter_lim=60, show=0)[0]

true = ltcl.solve(S, b, rtol=1e-4).x


def view(light):
    """As seen from in front of the corner."""
    return corner.view(np.reshape(light, corner.grid), size=320, supersample=2)


shown = {}
for name, light in {"direct light": true, "from a noisy picture": plain, "and smooth, by PyLops": smooth}.items():
    error = np.linalg.norm(light - true) / np.linalg.norm(true)
    shown[f"{name}\n{error:.1%} error" if error else name] = view(light)
figure = pictures(shown)

# %%
# From SciPy to ltcl
# ------------------
#
# ``ltcl.solve`` takes NumPy arrays, ``scipy.sparse`` matrices and any ``LinearOperator``; so does ``ltcl.Transport``. A sparse
# matrix goes to the device. A ``LinearOperator`` stays where it is: each product calls it.

rows = scipy.sparse.random_array((500, 500), density=0.02, rng=np.random.default_rng(1))
system = scipy.sparse.eye_array(500) + 0.1 * rows
right = np.ones(500)
for name, operator in {"sparse": system.tocsr(), "operator": scipy.sparse.linalg.aslinearoperator(system)}.items():
    solution = ltcl.solve(operator, right, "gmres", rtol=1e-5)
    residual = np.linalg.norm(right - system @ solution.x) / np.linalg.norm(right)
    print(f"{name}: {solution.method}, {solution.products} products, residual {residual:.1e}")

# %%
# Which is faster?
# ----------------
#
# A vector that comes from NumPy has to be brought to the device for each product, and back. ``ltcl.solve`` leaves
# all of its vectors there. So use SciPy's or PyLops' solvers for what ltcl lacks, and ltcl's for what it has. Measured ratios are in the
# README.

# sphinx_gallery_thumbnail_number = 1
