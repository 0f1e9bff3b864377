# SPDX-License-Identifier: BSD-3-Clause
"""OpenCL status codes as ltcl errors that say what to do."""

from __future__ import annotations

import pyopencl as cl
import pytest
from pyopencl import _cl

from ltcl.device import failures
from ltcl.errors import DeviceError, MemoryLimitError


@pytest.mark.parametrize(
    ("name", "kind", "part"),
    [
        ("MEM_OBJECT_ALLOCATION_FAILURE", MemoryLimitError, "memory"),
        ("OUT_OF_RESOURCES", MemoryLimitError, "compress"),
        ("OUT_OF_HOST_MEMORY", MemoryLimitError, "memory"),
        ("INVALID_BUFFER_SIZE", MemoryLimitError, "memory"),
        ("DEVICE_NOT_AVAILABLE", DeviceError, "LTCL_DEVICE=cpu"),
        ("COMPILER_NOT_AVAILABLE", DeviceError, "ltcl devices"),
        ("INVALID_VALUE", DeviceError, "ltcl doctor"),
    ],
)
def test_status_codes(name, kind, part):
    record = _cl._ErrorRecord(msg="", code=getattr(cl.status_code, name), routine="clDoThings")
    with pytest.raises(kind, match=part) as error, failures.translated("trying"):
        raise cl.RuntimeError(record)
    assert str(error.value).startswith("trying: ")
    assert name in str(error.value)
    assert isinstance(error.value.__cause__, cl.Error)


def test_errors_without_a_code_give_their_first_line():
    message = str(failures.explain("trying", ValueError("first\nsecond")))
    assert "first" in message
    assert "second" not in message
