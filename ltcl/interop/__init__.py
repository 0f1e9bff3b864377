# SPDX-License-Identifier: BSD-3-Clause
"""Arrays of other libraries: into NumPy without a copy where memory allows, and back.

`ltcl.checks.takes_arrays` marks the public calls that take them. A library is imported only when
one of its arrays is given, and by then its caller has imported it.
"""
