# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl combine`, and `ltcl acquire run` of a folder with several projectors."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from ltcl import store
from ltcl.cli import loading, options
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import argument, option, out_option
from ltcl.cli.reports.acquisition import ProjectorsReport
from ltcl.cli.reports.transports import CombineReport
from ltcl.cli.tables import size_text
from ltcl.device import open_device
from ltcl.errors import FileError, InputError

PROJECT = "acquisition.toml"


@command()
def combine(
    context: Context,
    scans: Annotated[
        list[Path],
        argument(
            "SCAN",
            "Stores of one camera, one for each projector, or the folder of 'ltcl acquire run' "
            "with several [[projector]]; or transport files of one camera grid.",
        ),
    ],
    out: Annotated[Path, out_option("The transport of all projectors: .npz.")],
    blend: Annotated[
        Literal["auto", "smooth", "linear"],
        option(
            "How the light of a projector falls towards its border: with the square of the "
            "distance, or with the distance; auto: the square unless an overlap is narrower than "
            "16 pixels."
        ),
    ] = "auto",
    balance: Annotated[
        float,
        option(
            "From 0, all light where projectors overlap, to 1, as soft as possible near borders.",
            min=0.0,
            max=1.0,
        ),
    ] = 0.5,
    black: Annotated[
        Literal["measured", "uniform"],
        option(
            "Leave black as it was measured, or lift it to one level everywhere. For scans only."
        ),
    ] = "measured",
    device: options.DeviceName = None,
) -> Answer:
    """Make one transport of several projectors, from scans with one camera that did not move.

    'ltcl compensate', 'film', 'play', 'view' and 'separate' take the file. With stores of 'ltcl
    acquire run' it keeps the black of the projectors and what each of them is to be fed: codes by
    its measured response, on its own pixels, side by side from left to right in the order of SCAN.
    """
    if out.suffix.lower() != ".npz":
        raise InputError(f"--out is {out}; several projectors are kept as .npz")
    paths = _stores(scans)
    opened = open_device(device)
    context.progress("combining")
    T = _combined(paths, {"blend": blend, "balance": balance, "black": black}, opened)
    context.progress(f"writing {out}")
    store.save(out, T)
    report = CombineReport(
        out=out,
        scans=paths,
        grids=[list(grid) for grid in T.montage.grids],
        camera_grid=T.camera_grid,
        channels=T.channels,
        fed=[list(grid) for grid in _fed_grids(T)],
        contrast=_finite(T.contrast and T.contrast.measured),
        contrast_uniform=_finite(T.contrast and T.contrast.uniform),
        differences=T.gamut.differences.tolist(),
    )
    return Answer(report, _combine_lines(out, T))


def _stores(scans: Sequence[Path]) -> list[Path]:
    """The stores of a folder with several projectors, or the files that are named."""
    if len(scans) == 1 and (scans[0] / PROJECT).exists():
        from ltcl.acquisition.several import scanned_stores

        scans = scanned_stores(scans[0])
    for scan in scans:
        if not scan.exists():
            raise FileError(f"{scan}: no such file")
    if len(scans) < 2:
        raise InputError(
            f"SCAN is {scans[0]} alone; it must be two or more, or a folder of several projectors"
        )
    for number, scan in enumerate(scans):
        if any(_is_same(scan, other) for other in scans[:number]):
            raise InputError(f"SCAN {scan} is given twice; each projector must be given once")
    return [*scans]


def _is_same(scan: Path, other: Path) -> bool:
    """Whether two names are of one file or folder."""
    return scan.resolve() == other.resolve()


def _combined(paths: Sequence[Path], settings: dict[str, Any], device: Any) -> Any:
    """The combination of stores of scans, with their set-ups, or of other files."""
    from ltcl.acquisition.projectors import combine_scans
    from ltcl.acquisition.projectors.combined import facts_path, has_facts
    from ltcl.transport.projectors import combine as combine_transports

    are_scans = [has_facts(path) for path in paths]
    if all(are_scans):
        return combine_scans(paths, device=device, **settings)
    if any(are_scans):
        other = paths[are_scans.index(False)]
        raise InputError(f"{other}: is no scan of one of several projectors, but others are")
    for path in paths:
        if loading.is_measured(path):
            raise InputError(
                f"{path}: is the scan of one projector alone, on its pixels, not on the camera's; "
                "those of several are scanned by an acquisition.toml with [[projector]], and have "
                f"{facts_path(path).name} beside them"
            )
    if settings["black"] == "uniform":
        raise InputError(
            f"--black is uniform, but {paths[0]} is a file without black; give stores of scans, or "
            "use blacks= of ltcl.combine"
        )
    members = [store.load(path, device=device) for path in paths]
    return combine_transports(members, device=device, **settings)


def _fed_grids(T: Any) -> list[tuple[int, int]]:
    """Height and width of the codes of each projector, where scans have told them."""
    from ltcl.acquisition.projectors import CombinedSetup

    setup = CombinedSetup.of(T)
    if setup is None:
        return []
    return [projector.warp.pixels for projector in setup.projectors]


def _finite(contrast: float | None) -> float | None:
    """A contrast as JSON has it: None where it is unknown, or without any black."""
    if contrast is None or not math.isfinite(contrast):
        return None
    return contrast


def _combine_lines(out: Path, T: Any) -> list[str]:
    sizes = ", ".join(size_text(grid) for grid in T.montage.grids)
    lines = [
        f"{out}: {len(T.transports)} projectors of {sizes} pixels, camera "
        f"{size_text(T.camera_grid)}",
        str(T.gamut),
    ]
    if T.contrast is not None:
        lines.append(str(T.contrast))
    fed = _fed_grids(T)
    if fed:
        height = max(h for h, _ in fed)
        width = sum(w for _, w in fed)
        fed_sizes = ", ".join(f"{w} x {h}" for h, w in fed)
        lines.append(
            f"codes of the projectors stand side by side, in {width} x {height} pixels (width x "
            f"height): {fed_sizes}"
        )
    name = shlex.quote(str(out))
    lines.append(f"next: ltcl compensate {name} PICTURE --resize crop --out shown")
    return lines


def copy_from_card(rig: Any, card: Path, project: Any) -> None:
    """Copy the new photographs of a folder, which keeps those of all scans of the project."""
    files = [path for path in card.glob("[!.]*") if path.is_file()]
    own = [(rig.folder / "photographs").resolve(), card.resolve()]
    known: list[Path] = []
    for pattern in ("photographs", "*/photographs"):
        for folder in project.folder.glob(pattern):
            if folder.is_dir() and folder.resolve() not in own:
                known.extend(path for path in folder.iterdir() if path.is_file())
    try:
        rig.take(files, known=known)
    except InputError as error:
        # The argument is a folder here.
        problem = str(error).removeprefix("files ")
        raise InputError(f"{card}: {problem}") from None


def run_several(context: Context, projects: Sequence[Any], take: Path | None, device: Any) -> Any:
    """Take the steps that are pending; the step and the error where one needs a person.

    Returns None when all are done.
    """
    from ltcl.acquisition.several import pending_steps
    from ltcl.errors import PhotographMissing

    for step in pending_steps(projects):
        with step.rig() as rig:
            if take is not None:
                copy_from_card(rig, take, projects[0])
                # The next step is of other photographs.
                take = None
            try:
                step.run(rig, projects[0], context.progress, device)
            except PhotographMissing as error:
                return step, error, rig.missing()
    return None


def report_several(folder: Path, projects: Sequence[Any]) -> Answer:
    """Report what the scans have made, whether the camera stayed, and what comes next."""
    from ltcl.acquisition.several import movements

    moved = movements(projects)
    report = ProjectorsReport(
        folder=folder,
        projectors=[project.name for project in projects],
        stores=[project.store for project in projects],
        movements=moved,
    )
    lines = []
    for project in projects:
        lines.append(f"{project.name}: transport in {project.store}")
    largest = max(moved.values(), default=0.0)
    lines.append(f"the camera moved by at most {largest:.2g} camera pixels between the scans")
    both = shlex.quote(str(folder / "combined.npz"))
    name = shlex.quote(str(folder))
    lines.append(f"next: ltcl combine {name} --out {both}")
    lines.append(f"how good each scan is: ltcl acquire report {name}")
    return Answer(report, lines)
