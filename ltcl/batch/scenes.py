# SPDX-License-Identifier: BSD-3-Clause
"""`map`: one task for each of many scenes, here or on the workers of a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from ltcl.batch.cluster import stream
from ltcl.errors import BatchError, LtclError

if TYPE_CHECKING:
    from distributed import Client


def map(
    function: Callable[[Any], Any],
    scenes: Iterable[Any],
    *,
    client: Client | None = None,
    share_gpu: bool = False,
    progress: Callable[[str, int, int | None], object] | None = None,
) -> list[Any]:
    """Results of a function of each scene, in order; one that fails is named, and the rest go on.

    `function` gets a path, or whatever `scenes` hold. Without a `client` it is called here, else on
    workers, which then have to see the paths; `share_gpu` is as of `ltcl.cluster.stream`.
    `progress("scenes", done, total)` is called after each.

    Raises
    ------
    BatchError
        Some scenes failed, by an LtclError of `function`. `results` has them all, errors in their
        places.

    Examples
    --------
    >>> import ltcl, numpy, pathlib, tempfile
    >>> paths = [pathlib.Path(tempfile.mkdtemp()) / f"{number}.npz" for number in range(2)]
    >>> for path in paths:
    ...     ltcl.save(path, ltcl.Transport(numpy.eye(6), grid=(2, 3)))
    >>> ltcl.batch.map(lambda path: float(ltcl.load(path).first_bounce.sum()), paths)
    [6.0, 6.0]
    """
    scenes, results = [*scenes], []
    for result in stream(client, function, scenes, window=1, share_gpu=share_gpu, errors=True):
        results.append(result)
        if progress is not None:
            progress("scenes", len(results), len(scenes))
    failed = [f"{s}: {r}" for s, r in zip(scenes, results, strict=True) if isinstance(r, LtclError)]
    if failed:
        raise BatchError(
            f"{len(failed)} of {len(scenes)} scenes failed: {'; '.join(failed)}", results
        )
    return results
