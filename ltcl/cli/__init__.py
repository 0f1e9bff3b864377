# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `main` has the entry point; `command` what all commands share."""
