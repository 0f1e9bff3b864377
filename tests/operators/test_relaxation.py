# SPDX-License-Identifier: BSD-3-Clause
"""Sweeps and steps over rows meet their twins, as launched on CPUs and GPUs."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from ltcl.device import Device
from ltcl.errors import MemoryLimitError
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.relaxation import Relaxation, Steps, Sweeps, relaxation
from tests import gallery, reference
from tests.conftest import SMALL, launched_as
from tests.operators import helpers

MATRICES = {
    "1x1": np.array([[0.25]], np.float32),
    "no entries": np.zeros((5, 5), np.float32),
    "53": gallery.signed(53, 53, 3) / 20,
    "53 in slabs": gallery.signed(53, 53, 4) / 20,
    "sparse 97": gallery.sparse(97, 97, 0.3).toarray() / 20,
    "empty rows": np.where(
        np.arange(40)[:, None] % 3 == 1, gallery.signed(40, 40) / 20, np.float32(0)
    ),
    "runs": np.tril(np.triu(gallery.signed(150, 150, 5), -70), 70) / 40,
    "below only": np.tril(gallery.signed(33, 33, 6), -1) / 9,
    "above only": np.triu(gallery.signed(33, 33, 7), 1) / 9,
}
# Their omega.
METHODS = {"sor": 1.3, "block_gauss_seidel": None}
# Items of a work-group.
SHAPES = {"cpu": 1, "gpu7": 7, "gpu256": 256}


@pytest.fixture(scope="module", params=SHAPES)
def launch(request, device) -> tuple[Device, int]:
    """A device whose kernels are launched as on a CPU or a GPU, and the size of its work-groups."""
    if request.param == "cpu" and not device.is_cpu:
        pytest.skip("strips hand on their turn within a launch, which OpenCL promises on no GPU")
    return launched_as(device, request.param[:3]), SHAPES[request.param]


def matrix_of(device: Device, form: str, name: str) -> tuple[CSR | Dense, np.ndarray]:
    """R on the device, some in slabs, and I - R."""
    M = MATRICES[name]
    is_cut = "slabs" in name
    device.max_allocation = SMALL if is_cut else device.description.max_allocation
    R = helpers.FORMATS[form](device, M)
    assert (len(R.slabs) > 1) == is_cut
    return R, np.eye(len(M)) - M.astype(np.float64)


def sweeps_of(relax: Relaxation, k: int | None) -> tuple[Sweeps, np.ndarray, np.ndarray]:
    """Sweeps that start with NaN wherever nothing is read."""
    x = gallery.vectors(relax.n, k, 1)
    b = gallery.vectors(relax.n, k, 2)
    garbage = np.full_like(x, np.nan)
    upload = relax.device.upload
    sweeps = Sweeps(relax, upload(x), upload(b), upload(garbage))
    for array in (sweeps.before, sweeps.s, sweeps.carry):
        array.set(garbage)
    return sweeps, x, b


@pytest.mark.slow
@pytest.mark.parametrize("k", [None, 5])
@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("form", helpers.ROWS)
def test_sweeps_meet_their_twins(launch, form, method, name, k):
    """Blocks of 1 to all rows; a sweep leaves behind what the next one tells the residual from."""
    device, group = launch
    A, S = matrix_of(device, form, name)
    # Inverses fit in one buffer.
    blocks = (1, 5, 16) if "slabs" in name else (1, 7, None)
    for block in blocks:
        relax = relaxation(IdentityPlus(A, -1), method, block, METHODS[method])
        if form == "csr" and len(A.slabs) == 1:
            windows = reference.relax_windows(
                MATRICES[name], relax.block, relax.panel, inverses=relax.inverses
            )
            np.testing.assert_array_equal(relax.windows[0].get(), windows)
        check_sweeps(relax, S, k, group)


def check_sweeps(relax: Relaxation, S: np.ndarray, k: int | None, group: int) -> None:
    """Assert that three sweeps are those of S in float64."""
    sweeps, y, b = sweeps_of(relax, k)
    sweeps.group = group
    carry = np.full_like(y, np.nan)
    for sweep in range(3):
        before = y
        y, r, carry = reference.relax_strips(
            S, relax.block, relax.omega, y, b, carry, in_place=not relax.inverses
        )
        sweeps.sweep()
        np.testing.assert_allclose(sweeps.x.get(), y, rtol=0, atol=1e-5)
        np.testing.assert_allclose(sweeps.before.get(), before, rtol=0, atol=1e-5)
        np.testing.assert_allclose(sweeps.carry.get(), carry, rtol=0, atol=1e-5)
        np.testing.assert_allclose(sweeps.r.get(), r, rtol=0, atol=1e-5)
        if sweep > 0:
            np.testing.assert_allclose(sweeps.r.get(), b - S @ before, rtol=0, atol=1e-5)


@pytest.mark.parametrize("form", helpers.ROWS)
def test_many_strips_on_many_threads_repeat_to_the_bit(device, form):
    """The strips of a panel end in any order; each waits for its turn all the same."""
    M = np.random.default_rng(1).random((800, 800), np.float32) / 800
    if form == "csr":
        M[M > 0.2 / 800] = 0
    relax = relaxation(IdentityPlus(helpers.FORMATS[form](device, M)), "sor", 2, 1.0)
    # The same each time.
    _, x, b = sweeps_of(relax, None)
    iterates = []
    for _ in range(5):
        sweeps, _, _ = sweeps_of(relax, None)
        for _ in range(4):
            sweeps.sweep()
        iterates.append(sweeps.x.get())
    S = np.eye(800) + M.astype(np.float64)
    for _ in range(4):
        x = scipy.linalg.solve_triangular(S, b - np.triu(S, 1) @ x, lower=True)
    np.testing.assert_allclose(iterates[0], x, rtol=0, atol=1e-5)
    for other in iterates[1:]:
        helpers.same_bits(iterates[0], other)


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("parts", [1, 7, 1000])
@pytest.mark.parametrize("name", ["1x1", "53", "empty rows", "runs", "53 in slabs"])
@pytest.mark.parametrize("form", helpers.ROWS)
def test_steps_meet_their_twin(launch, form, name, parts, k):
    device, group = launch
    R, S = matrix_of(device, form, name)
    n = len(S)
    parts = min(parts, n)
    x = gallery.vectors(n, k, 1)
    r = gallery.vectors(n, k, 2)
    system = IdentityPlus(R, -1)
    steps = Steps(system, "southwell", device.upload(x), device.upload(r), parts)
    steps.group = group
    for picks in (True, True, False, True, False):
        steps.step(picks=picks)
        if picks:
            x, r = reference.southwell_step(S, parts, x, r)
    np.testing.assert_allclose(steps.x.get(), x, rtol=0, atol=1e-5)
    np.testing.assert_allclose(steps.r.get(), r, rtol=0, atol=1e-5)


@pytest.mark.parametrize("form", helpers.ROWS)
def test_inverses_beyond_the_device_are_refused_with_both_sizes(device, monkeypatch, form):
    S = IdentityPlus(helpers.FORMATS[form](device, MATRICES["53"]))
    monkeypatch.setattr(device, "memory", 1000)
    with pytest.raises(MemoryLimitError, match=r"'block_gauss_seidel'.* 4 blocks .*3.* KiB.*1000"):
        relaxation(S, "block_gauss_seidel", 16, None)
