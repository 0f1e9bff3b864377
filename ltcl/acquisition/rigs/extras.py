# SPDX-License-Identifier: BSD-3-Clause
"""Packages that ltcl needs for some rigs only, imported when they are needed."""

from __future__ import annotations

import importlib
from typing import Any

from ltcl.errors import AcquisitionError


def load(module: str, extra: str, what: str, instead: str = "") -> Any:
    """Import `module`, which comes with an extra of ltcl.

    Parameters
    ----------
    module : str
        Its dotted name.
    extra : str
        The extra of ltcl that brings it.
    what : str
        What needs it; the message begins with it.
    instead : str
        What else can be done; the message ends with it.

    Raises
    ------
    AcquisitionError
        It is not installed, or cannot be loaded.

    Examples
    --------
    >>> load("math", "rig", "this rig").pi
    3.141592653589793
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError)
        fault = "is not installed" if missing else f"cannot be loaded ({' '.join(str(error).split())})"
        raise AcquisitionError(
            f'{what} needs {module}, which {fault}; install it with pip install "ltcl[{extra}]"{instead}'
        ) from None
