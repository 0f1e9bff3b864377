# SPDX-License-Identifier: BSD-3-Clause
"""The sRGB curve against its closed form."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.errors import InputTypeError
from ltcl.images import from_srgb, to_srgb


def closed_form(code: float) -> float:
    """IEC 61966-2-1, one number at a time."""
    return code / 12.92 if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4


def test_decoding_is_the_closed_form():
    codes = np.linspace(0, 1, 257)
    np.testing.assert_allclose(from_srgb(codes), [closed_form(c) for c in codes], rtol=1e-14)
    assert from_srgb(np.float64(0)) == 0
    assert from_srgb(np.float64(1)) == 1


def test_the_pieces_meet():
    # The standard's rounded constants leave a step of about 1e-8 at the joint, no more.
    below, above = from_srgb(np.array([0.04045, np.nextafter(0.04045, 1)]))
    assert abs(above - below) < 1e-7
    below, above = to_srgb(np.array([0.0031308, np.nextafter(0.0031308, 1)]))
    assert abs(above - below) < 1e-7


# float32 keeps 24 bits; the power 2.4 multiplies a relative rounding error by 2.4.
@pytest.mark.parametrize(("dtype", "rtol"), [(np.float64, 1e-7), (np.float32, 1e-6)])
def test_encoding_undoes_decoding_also_outside_0_to_1(dtype, rtol):
    values = np.concatenate([[0, 0.04045], np.linspace(-2, 3, 501)]).astype(dtype)
    assert from_srgb(values).dtype == dtype
    np.testing.assert_allclose(to_srgb(from_srgb(values)), values, rtol=rtol, atol=1e-7)
    np.testing.assert_allclose(from_srgb(to_srgb(values)), values, rtol=3 * rtol, atol=1e-7)


def test_every_16_bit_code_survives():
    codes = np.arange(65536)
    linear = from_srgb(codes / 65535).astype(np.float32)
    np.testing.assert_array_equal(np.rint(to_srgb(linear) * 65535), codes)


@pytest.mark.parametrize("value", [np.array(["a"]), np.array([1j])])
def test_other_than_real_numbers_is_refused(value):
    with pytest.raises(InputTypeError, match="linear holds"):
        to_srgb(value)
    with pytest.raises(InputTypeError, match="encoded holds"):
        from_srgb(value)
