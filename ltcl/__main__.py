# SPDX-License-Identifier: BSD-3-Clause
"""``python -m ltcl``: the same program as ``ltcl``."""

import sys

from ltcl.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
