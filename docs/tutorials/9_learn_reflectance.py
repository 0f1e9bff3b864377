# SPDX-License-Identifier: BSD-3-Clause
"""
Learn a reflectance with PyTorch
================================

Products of ltcl are differentiable: a tensor that requires a gradient may go through ``T @ p``,
``ltcl.solve`` and ``ltcl.compensate``, and ``backward()`` takes one product, or one solve, with the
transpose. Here the shape of a corner is known and its paint is not. It is learned from seven
photographs, which show the light of all bounces.
"""

# %%
# A painted corner
# ----------------
#
# With the reflectance r of each patch, the light E that the projector throws, and the form factors
# G, the corner shows B = r (E + G B). ``G`` is an operator of ltcl on the device. The photographs
# come from a dense inverse in float64, with 1 % of noise, and not from the model below.

import matplotlib.pyplot as plt
import numpy as np
import torch

import ltcl
from ltcl.plots import pictures

corner = ltcl.scenes.dihedral(20)
n = corner.grid[0] * corner.grid[1]
G = ltcl.operators.as_operator(corner.form_factors)

truth = 0.15 + 0.8 * corner.sample(ltcl.scenes.landscape(240, 480)).reshape(n, 3)
random = np.random.default_rng(0)
patterns = np.hstack([np.ones((n, 1)), random.uniform(0.0, 1.0, (n, 6))])


def photographs(light):
    """What the painted corner shows under light (n, k): (n, k, 3)."""
    A = truth.T[:, :, None] * corner.form_factors
    shown = np.linalg.solve(np.eye(n) - A, truth.T[:, :, None] * light)
    return np.moveaxis(shown, 0, -1)


photos = photographs(patterns)
photos += 0.01 * photos.mean() * random.standard_normal(photos.shape)

# %%
# The model
# ---------
#
# Six bounces, written as one would write them in PyTorch. ``G @ light`` runs on the device, there
# and back; all colours and photographs are columns of one product.


def render(r, light, bounces=6):
    """What the corner shows with reflectance r (n, 3) under light (n, k): (n, k, 3)."""
    direct = r[:, None, :] * light[:, :, None]
    shown = direct
    for _ in range(bounces):
        indirect = (G @ shown.reshape(n, -1)).reshape(shown.shape)
        shown = direct + r[:, None, :] * indirect
    return shown


# %%
# Learning
# --------
#
# What a photograph under white shows is too bright in the corner, and tinted: the guess from which
# learning starts. A sigmoid keeps the reflectance between 0 and 1.

light = torch.tensor(patterns, dtype=torch.float32)
seen = torch.tensor(photos, dtype=torch.float32)
parameters = torch.logit(seen[:, 0].clamp(0.05, 0.95)).requires_grad_()
optimizer = torch.optim.Adam([parameters], lr=0.05)


def distance(found, true):
    """Relative error."""
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


losses, errors = [], []
for _ in range(120):
    optimizer.zero_grad()
    reflectance = torch.sigmoid(parameters)
    loss = ((render(reflectance, light) - seen) ** 2).mean()
    loss.backward()
    optimizer.step()
    losses.append(loss.item())
    errors.append(distance(reflectance.detach().numpy(), truth))
learned = torch.sigmoid(parameters).detach()
print(f"error of the reflectance: {errors[0]:.1%} at the start, {errors[-1]:.1%} at the end")

# %%
# The curve falls until what is left is the noise of the photographs.

figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
axes.semilogy(errors, label="error of the reflectance")
axes.semilogy(np.sqrt(losses) / photos.std(), label="distance from the photographs")
axes.axhline(0.01 * photos.mean() / photos.std(), color="grey", ls=":", label="noise of these")
axes.set_xlabel("step")
axes.legend(frameon=False)
figure

# %%
# The paint, without the light of its neighbours:


def view(values):
    """The corner as seen from in front of it."""
    return corner.view(np.reshape(values, (*corner.grid, 3)), size=300, supersample=2)


before = f"a photograph under white\n{errors[0]:.0%} from the truth"
after = f"learned\n{errors[-1]:.1%} from the truth"
figure = pictures(
    {before: view(photos[:, 0]), after: view(learned.numpy()), "the truth": view(truth)}
)
figure

# %%
# What it is good for
# -------------------
#
# A pattern that no photograph has shown:

new = random.uniform(0.0, 1.0, (n, 1)) ** 4
predicted = render(learned, torch.tensor(new, dtype=torch.float32)).numpy()
print(f"a new photograph: {distance(predicted, photographs(new)):.2%} off")

# %%
# The same way a network learns what physics leaves over: let it change the pattern before
# ``T @ p``, or the picture behind it, and train it on photographs.
# ``ltcl.compensate(T, desired).pattern`` stands in such a network like any layer. What has a
# derivative, how, and at what cost, is told by `the guide <../guide/arrays.html#derivatives>`_.

# sphinx_gallery_thumbnail_number = 2
