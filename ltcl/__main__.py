# SPDX-License-Identifier: BSD-3-Clause
"""``python -m ltcl``: the same program as ``ltcl``."""

from __future__ import annotations

import sys

from ltcl.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
