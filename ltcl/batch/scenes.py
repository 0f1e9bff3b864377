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
    """Results of a function of each scene, in order; failing scenes are named, the others go on.

    Parameters
    ----------
    function : callable(scene)
    scenes : iterable of paths, or of whatever `function` takes
    client : distributed.Client, optional
        Calls are made on its workers, which have to see the paths; else here.
    share_gpu : bool
        As in `ltcl.cluster.stream`.
    progress : callable("scenes", done, total), optional
        Called after each scene.

    Raises
    ------
    BatchError
        `function` raised an LtclError for some scenes. `results` has all results, with the
        errors in their places.

    Examples
    --------
    >>> import ltcl, numpy, pathlib, tempfile
    >>> paths = [pathlib.Path(tempfile.mkdtemp()) / f"{number}.npz" for number in range(2)]
    >>> for path in paths:
    ...     ltcl.save(path, ltcl.Transport(numpy.eye(6), grid=(2, 3)))
    >>> ltcl.batch.map(lambda path: float(ltcl.load(path).first_bounce.sum()), paths)
    [6.0, 6.0]
    """
    scenes = list(scenes)
    results = []
    stream_of_results = stream(client, function, scenes, window=1, share_gpu=share_gpu, errors=True)
    for result in stream_of_results:
        results.append(result)
        if progress is not None:
            progress("scenes", len(results), len(scenes))
    failures = []
    for scene, result in zip(scenes, results, strict=True):
        if isinstance(result, LtclError):
            failures.append(f"{scene}: {result}")
    if failures:
        count = f"{len(failures)} of {len(scenes)} scenes failed"
        raise BatchError(f"{count}: {'; '.join(failures)}", results)
    return results
