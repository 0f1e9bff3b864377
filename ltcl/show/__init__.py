# SPDX-License-Identifier: BSD-3-Clause
"""Light on the wall: films and patterns in a projector window of the browser."""
