# SPDX-License-Identifier: BSD-3-Clause
"""Arguments that constructors of operators refuse."""

from __future__ import annotations

from functools import partial

import numpy as np
import scipy.sparse

from ltcl.errors import InputError, InputTypeError
from ltcl.operators import (
    CSR,
    Compressed,
    Coupled,
    Dense,
    Host,
    IdentityPlus,
    PatchHats,
    Product,
    Pyramid,
    ScaledColumns,
    SubsetBasis,
    Tiles,
    Wavelet,
    basis,
    multiresolution_order,
    smallest,
)
from ltcl.operators.relaxation import relaxation
from ltcl.operators.walks import rows_of_R, tables
from tests import gallery
from tests.bases import MatrixBasis, rotation
from tests.operators import helpers

N = 33
EYE = np.eye(2)
MATRIX = gallery.SPARSE["53x7"]
NO_WAVELETS = ("bior2.2", "rbio1.3", "dmey", "db99", "morl", "", None, 2)


def test_what_is_no_operator_is_refused(device, small_device):
    W = MatrixBasis(device, rotation(N))
    tall = MatrixBasis(device, gallery.signed(N + 1, N))
    skew = MatrixBasis(device, gallery.signed(N, N))
    core = Dense(device, np.eye(N))
    dropped = Dense(device, np.eye(N))
    dropped.error = 0.1
    assert Compressed(dropped, skew, skew, 0.3).error == 0.3
    a = Dense(device, gallery.signed(3, 3))
    b = Dense(device, gallery.signed(3, 2))
    host = Host(device, helpers.Plain(EYE))
    one_entry = (np.ones(1), ([0], [1 << 22]))
    wide = CSR(device, scipy.sparse.csr_array(one_entry, shape=(1, (1 << 22) + 1)))
    beyond = gallery.sparse(9, 9)
    beyond.indices[0] = 9
    helpers.refused(
        InputTypeError,
        ("matrix.*ndarray", CSR, device, np.eye(3)),
        ("matrix", Dense, device, [["a"]]),
        ("matrix", Dense, device, [[1j]]),
        ("d holds", ScaledColumns, b, np.array(["a", "b"])),
        ("Plain", Host, device, helpers.Plain(1j * EYE)),
        ("places", SubsetBasis, device, (2, 2), [None]),
    )
    helpers.refused(
        InputError,
        (r"matrix\.indices.* 9", CSR, device, beyond),
        (r"matrix.*\(4,\)", Dense, device, np.zeros(4)),
        (r"matrix.*\(2, 2, 2\)", Dense, device, np.zeros((2, 2, 2))),
        (r"matrix.* 1 .*\(0, 1\)", Dense, device, [[1.0, np.nan]]),
        ("float32", Dense, device, [[1.0, 1e39]]),
        ("width is 4.*1, 8", Tiles, device, MATRIX, 4),
        ("precision is 'double'.* float32", Tiles, device, MATRIX, 8, "double"),
        ("matrix.data has 1 NaN", Tiles, device, scipy.sparse.csr_array([[np.nan]])),
        ("beyond float32", Tiles, device, scipy.sparse.csr_array([[1e39]])),
        ("tolerance is -1", smallest, MATRIX, -1),
        (r"R .*\(3, 2\)", IdentityPlus, b),
        ("sign is 2", IdentityPlus, a, 2),
        ("solution_error is -1e-09", partial(IdentityPlus, a, solution_error=-1e-9)),
        ("solution_error is nan", partial(IdentityPlus, a, solution_error=np.nan)),
        (r"\(3, 2\)", ScaledColumns, b, np.ones(2), 1.0),
        (r"shift .*\(2,\)", ScaledColumns, a, np.ones(3), np.ones(2)),
        (r"d .*\(1,\).*\(3,\)", ScaledColumns, a, np.ones(1)),
        ("d has 1 NaN", ScaledColumns, b, np.array([1.0, np.nan])),
        (rf"out .*{N + 1} .* {N}", Compressed, core, tall, W),
        (rf"into .*{N + 1} ", Compressed, core, None, tall),
        ("into .*device", Compressed, core, W, MatrixBasis(small_device, np.eye(N))),
        ("error is -1.0", Compressed, core, W, W, -1.0),
        ("error is nan", Compressed, core, W, W, np.nan),
        # An error of coefficients is none of pixels.
        ("error is None", Compressed, dropped, skew, skew),
        (r"diagonal .*\(2,\)", partial(Compressed, core, W, W, diagonal=np.ones(2))),
        (f"diagonal has {N} NaN", partial(Compressed, core, W, W, diagonal=np.full(N, np.nan))),
        (r"A .*\(3, 2\).* 2 rows", Product, b, b),
        ("blocks", Coupled, [[a] * 3] * 2),
        ("blocks", Coupled, [[a] * 2] * 3),
        ("blocks", Coupled, [[a, a, b], [a] * 3, [a] * 3]),
        ("blocks", Coupled, [[None] * 3] * 3),
        ("Plain has no rmatvec", host.rmatvec, np.ones(2)),
        (r"Plain has no diagonal\(\)", host.diagonal),
        ("Host", host.norms),
        ("hybrid.*Host", rows_of_R, IdentityPlus(host), "hybrid"),
        ("'sor'.*chebyshev", relaxation, ScaledColumns(a, np.ones(3)), "sor"),
        ("'sor'.*chebyshev", relaxation, a.T, "sor"),
        ("R.*4194305.*4194304", tables, wide),
        ("R.*row 1.*float32", tables, Dense(device, [[1.0, 1.0], [3e38, -3e38]])),
        *((f"wavelet .*{name}.*haar", Wavelet, device, (8, 8), name) for name in NO_WAVELETS),
        *(("grid is", Wavelet, device, grid, "haar") for grid in ((0, 4), (2.5, 2), 9, (1, 2, 3))),
        *(
            (f"levels is {levels!r}", Wavelet, device, (8, 5), "haar", levels)
            for levels in (4, -1, 1.5, "3")
        ),
        *((f"{name}.*haar", basis, device, (4, 6), name) for name in ("hilbert", None, "bior2.2")),
        (r"grid is \(0, 3\)", Pyramid, device, (0, 3)),
        (r"grid is \(4, 6\).*3 x 3 pixels on 2", PatchHats, device, (4, 6), 2, 3),
        (r"grid is \(4, 6\).*2 x 2 pixels on 2", PatchHats, device, (4, 6), 2, 2),
        ("walls is 0", PatchHats, device, (4, 6), 0, 2),
        ("detail is 1.5", PatchHats, device, (4, 6), 1, 1.5),
        (r"grid is \(0, 3\)", multiresolution_order, (0, 3), 1),
        (r"levels is 1\.5", multiresolution_order, (4, 4), 1.5),
        (r"places.*\(0,\)", SubsetBasis, device, (2, 2), []),
        (r"places.*\(1, 2\)", SubsetBasis, device, (2, 2), [[0, 1]]),
        ("places.*float64", SubsetBasis, device, (2, 2), [0.5]),
        ("places.*0 to 4", SubsetBasis, device, (2, 2), [0, 4]),
        ("places.*-1 to 2", SubsetBasis, device, (2, 2), [-1, 2]),
        ("places.*1 to 1.*4", SubsetBasis, device, (2, 2), [1, 1]),
        ("of is", SubsetBasis, device, (2, 2), [1, 2], Wavelet(device, (1, 4))),
        ("of is", SubsetBasis, device, (2, 2), [1, 2], Wavelet(small_device, (2, 2))),
    )
    assert basis(device, (4, 6), "pixels") is None
