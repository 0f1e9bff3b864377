# SPDX-License-Identifier: BSD-3-Clause
"""
From SciPy and PyLops
=====================

The operators of ltcl are SciPy's ``LinearOperator``: whatever takes one of these takes them. And
SciPy's matrices and operators can be used in ltcl.
"""

# %%
# The parts of T
# --------------
#
# ``T.systems`` holds one operator S for each colour, on the device. A picture is T p = S F p with
# the diagonal F, so that S undoes nothing but bounces: its diagonal is about 1.

import numpy as np
import pylops
import scipy.sparse
import scipy.sparse.linalg

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.refine(ltcl.scenes.dihedral(16, albedo=0.8), 16)  # 256 x 512 pixels
T = corner.transport()
(S,) = T.systems
print(
    type(S).__mro__[0].__name__, S.shape, S.dtype, isinstance(S, scipy.sparse.linalg.LinearOperator)
)

# %%
# In SciPy
# --------
#
# NumPy in, NumPy out. ``S @ x``, ``S.T``, sums and products of operators, ``gmres``, ``svds``,
# ``eigs``: all run the products on the device.

picture = T @ (0.2 + 0.8 * corner.sample(ltcl.scenes.landscape(480, 960)[..., 0]))
b = picture.ravel()

steps = []
x, failed = scipy.sparse.linalg.gmres(
    S, b, rtol=1e-4, callback=steps.append, callback_type="pr_norm"
)
ours = ltcl.solve(S, b, "gmres", rtol=1e-4)
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
# ``pylops.aslinearoperator`` takes it, and it can be joined with the operators of PyLops. Here
# something stands before the wall, and hides two fifths of the picture from the camera. A
# restriction keeps the pixels that are seen; a second derivative makes the answer smooth where
# nothing is known. ltcl alone does not do that.

A = pylops.aslinearoperator(S)
rows, columns = np.mgrid[: corner.grid[0], : corner.grid[1]]
hidden = (rows + columns) % 20 < 8
visible = np.flatnonzero(~hidden)
camera = pylops.Restriction(b.size, visible, dtype="float32") @ A
smooth = pylops.Laplacian(dims=corner.grid, dtype="float32")
found = pylops.optimization.leastsquares.regularized_inversion(
    camera, b[visible], [smooth], epsRs=[0.05], iter_lim=80, show=False
)[0]


def view(light):
    """The corner as seen from in front of it."""
    return corner.view(np.reshape(light, corner.grid), size=480, supersample=2)


true = ours.x
error = np.linalg.norm(found - true) / np.linalg.norm(true)
figure = pictures(
    {
        "what the camera sees": view(np.where(hidden, 0.02, picture)),
        f"direct light, by PyLops\n{error:.1%} from the truth": view(found),
        "the truth": view(true),
    }
)
figure

# %%
# From SciPy to ltcl
# ------------------
#
# ``ltcl.solve`` takes NumPy arrays, ``scipy.sparse`` matrices and any ``LinearOperator``; so does
# ``ltcl.Transport``. A sparse matrix goes to the device. A ``LinearOperator`` stays where it is:
# each product calls it.

rows = scipy.sparse.random_array((500, 500), density=0.02, rng=np.random.default_rng(1))
system = scipy.sparse.eye_array(500) + 0.1 * rows
right = np.ones(500)
for name, operator in {
    "sparse": system.tocsr(),
    "operator": scipy.sparse.linalg.aslinearoperator(system),
}.items():
    solution = ltcl.solve(operator, right, "gmres", rtol=1e-5)
    residual = np.linalg.norm(right - system @ solution.x) / np.linalg.norm(right)
    print(f"{name}: {solution.method}, {solution.products} products, residual {residual:.1e}")

# %%
# Which is faster?
# ----------------
#
# A vector that comes from NumPy has to be brought to the device for each product, and back.
# ``ltcl.solve`` leaves all of its vectors there. So use SciPy's or PyLops' solvers for what ltcl
# lacks, and ltcl's for what it has. Measured ratios are in the README.

# sphinx_gallery_thumbnail_number = 2
