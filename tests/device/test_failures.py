# SPDX-License-Identifier: BSD-3-Clause
"""OpenCL status codes as ltcl errors that say what to do."""

from __future__ import annotations

import pyopencl as cl
import pytest
from pyopencl import _cl

from ltcl.device import failures
from ltcl.errors import DeviceError, LtclError, MemoryLimitError


def status(name: str) -> cl.Error:
    """pyopencl's own error, as it raises it itself."""
    return cl.RuntimeError(_cl._ErrorRecord(msg="", code=getattr(cl.status_code, name), routine="clDoThings"))


@pytest.mark.parametrize(
    ("name", "kind", "part"),
    [
        ("MEM_OBJECT_ALLOCATION_FAILURE", MemoryLimitError, "the device ran out of memory"),
        ("OUT_OF_RESOURCES", MemoryLimitError, "compress the matrix"),
        ("OUT_OF_HOST_MEMORY", MemoryLimitError, "ran out of memory"),
        ("INVALID_BUFFER_SIZE", MemoryLimitError, "ran out of memory"),
        ("DEVICE_NOT_AVAILABLE", DeviceError, "try LTCL_DEVICE=cpu"),
        ("COMPILER_NOT_AVAILABLE", DeviceError, "choose another device"),
        ("INVALID_WORK_GROUP_SIZE", DeviceError, "please report it"),
        ("INVALID_VALUE", DeviceError, "see ltcl doctor"),
    ],
)
def test_status_codes(name, kind, part):
    with pytest.raises(kind, match=part) as error, failures.translated("trying"):
        raise status(name)
    assert str(error.value).startswith("trying: ")
    assert name in str(error.value)
    assert "\n" not in str(error.value)
    assert isinstance(error.value.__cause__, cl.Error)


def test_errors_without_a_code_keep_their_first_line():
    with pytest.raises(DeviceError, match="trying: OpenCL answered first; see ltcl doctor"):
        raise failures.explain("trying", ValueError("first\nsecond"))
    assert "ValueError" in str(failures.explain("trying", ValueError()))


def test_other_errors_pass():
    with pytest.raises(KeyError), failures.translated("trying"):
        raise KeyError


def test_every_error_is_one_of_ltcl():
    assert isinstance(failures.explain("trying", status("OUT_OF_RESOURCES")), LtclError)
