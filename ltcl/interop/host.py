# SPDX-License-Identifier: BSD-3-Clause
"""Arrays of other devices go through the host, which is said once."""

from __future__ import annotations

import functools
import logging

logger = logging.getLogger(__name__)


@functools.cache
def say_once(subject: str) -> None:
    """Log that these arrays go through the host, at the first one of this process."""
    logger.warning(
        "%s go through the host: OpenCL drivers do not share memory with CUDA, see "
        "docs/guide/arrays.md",
        subject,
    )
