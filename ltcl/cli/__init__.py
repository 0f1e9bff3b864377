# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `main` has the entry point; each command has a file of its own."""
