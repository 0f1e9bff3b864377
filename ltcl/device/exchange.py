# SPDX-License-Identifier: BSD-3-Clause
"""Rows of arrays that go from one device to another.

Devices of one context, as of ``open_device("all")``, copy without the host: nothing waits, and
events say what comes first. Others copy through the host, which waits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from ltcl.device.arrays import Array
from ltcl.device.device import Device


def are_near(first: Device, second: Device) -> bool:
    """True if two devices copy without the host."""
    return first.context == second.context


def send_rows(
    source: Array, first: int, target: Array, target_first: int, count: int, ready: Any
) -> Any:
    """Queue a copy of rows of an array into one on another device, which has as many columns.

    Parameters
    ----------
    source, first, target, target_first, count
        `count` rows from row `first` on, and where they go.
    ready : event
        Of the source's device (`Device.mark`): what the copy waits for.

    Returns
    -------
    event or None
        Until then the rows of the source must stay: its device has to wait for that event
        (`Device.wait_for`) before it writes them. None if they have arrived.
    """
    if are_near(source.device, target.device):
        row_bytes = source.columns * source.dtype.itemsize
        return target.device.queue_bytes(
            target.buffer,
            source.buffer,
            ready,
            byte_count=count * row_bytes,
            src_offset=first * row_bytes,
            dst_offset=target_first * row_bytes,
        )
    rows = source.rows(first, count).get()
    target.set_rows(target_first, target.device.upload(rows))
    return None


class Span(NamedTuple):
    """`rows` rows from row `first` on, which go to those from `target` on."""

    first: int
    target: int
    rows: int


def send_to_all(sources: Sequence[Array], spans: Sequence[Span], targets: Sequence[Array]) -> None:
    """Queue rows of an array of each device into those of the others.

    Parameters
    ----------
    sources, spans
        An array of each device, and which of its rows are sent, from where to where. What comes
        later on that device waits until they have arrived.
    targets
        Arrays of devices that receive the rows of all others; each has its own ones already.
    """
    marks = [source.device.mark() for source in sources]
    arrived = [[] for _ in sources]
    for target in targets:
        for source, span, mark, events in zip(sources, spans, marks, arrived, strict=True):
            if source.device is not target.device:
                event = send_rows(source, span.first, target, span.target, span.rows, mark)
                events.append(event)
    for source, events in zip(sources, arrived, strict=True):
        source.device.wait_for(*events)
