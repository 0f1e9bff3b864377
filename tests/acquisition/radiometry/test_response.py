# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import ProjectorResponse, Response
from ltcl.errors import InputError

SQUARE = Response(np.linspace(0, 1, 4097) ** 2)


def test_a_table_is_linear_between_and_beyond_its_codes():
    response = Response(np.array([[-0.1, 0.3, 1.0]]))
    codes = np.array([-0.5, 0.0, 0.25, 0.5, 0.75, 1.0, 1.5])
    np.testing.assert_allclose(response.linear(codes), [-0.5, -0.1, 0.1, 0.3, 0.65, 1.0, 1.7], rtol=1e-6)
    np.testing.assert_allclose(response.derivative(codes), [0.8, 0.8, 0.8, 1.4, 1.4, 1.4, 1.4], rtol=1e-6)


def test_codes_undo_linear():
    codes = np.random.default_rng(0).random((5, 7))
    np.testing.assert_allclose(SQUARE.codes(SQUARE.linear(codes)), codes, atol=1e-4)


def test_channels_have_their_own_tables():
    response = Response(np.stack([np.linspace(0, 1, 4097) ** power for power in (1, 2, 3)]))
    codes = np.random.default_rng(0).random((5, 7, 3))
    np.testing.assert_allclose(response.linear(codes), codes ** [1, 2, 3], atol=1e-6)
    np.testing.assert_allclose(response.derivative(codes), [1, 2, 3] * codes ** [0, 1, 2], atol=1e-3)
    np.testing.assert_allclose(response.tables(256)[2], np.linspace(0, 1, 256) ** 3, atol=1e-6)
    with pytest.raises(InputError, match=r"image has shape \(5, 7\); this response needs \(..., 3\)"):
        response.linear(np.zeros((5, 7)))


def test_it_is_kept_as_arrays():
    assert np.array_equal(Response.from_arrays(SQUARE.to_arrays()).values, SQUARE.values)
    assert isinstance(ProjectorResponse.from_arrays(SQUARE.to_arrays()), ProjectorResponse)


def test_linear_codes_stay():
    codes = np.linspace(-1, 2, 9)
    np.testing.assert_allclose(Response.identity().linear(codes), codes, rtol=1e-6)


@pytest.mark.parametrize(
    ("values", "part"),
    [
        ([[0.0]], r"shape \(1, 1\)"),
        (np.zeros((2, 5)), r"shape \(2, 5\)"),
        ([[0.0, np.nan, 1.0]], "NaN"),
        ([[0.0, 0.6, 0.5]], "falls"),
        ([[0.5, 0.5, 0.5]], "falls"),
    ],
)
def test_what_is_no_response_is_refused(values, part):
    with pytest.raises(InputError, match=part):
        Response(values)


def test_integers_are_no_codes():
    with pytest.raises(InputError, match="image holds uint8"):
        SQUARE.linear(np.zeros((2, 2), np.uint8))
