# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl simulate`: a folder in which 'ltcl acquire' photographs a scene without a camera."""

from __future__ import annotations

import dataclasses
import json
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from ltcl import checks
from ltcl.cli import options, pictures
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import argument, grid_option, option
from ltcl.cli.reports.acquisition import SimulateReport
from ltcl.cli.reports.parts import Versions
from ltcl.cli.side_by_side import side_by_side
from ltcl.cli.tables import size_text
from ltcl.errors import InputError
from ltcl.store import CombinedRecord, StoreRecord, formats
from ltcl.tasks.report import versions

SCENES = ("dihedral", "trihedral", "box")
TEMPLATE = Path(__file__).with_name("acquisition.toml.in")
SEVERAL_TEMPLATE = Path(__file__).with_name("projectors.toml.in")
# Camera pixels along the side of a patch, and patches along that of a pixel of T, with several
# projectors, whose pixels are as large as patches.
CAMERA_PIXELS = 3
SIDE_PATCHES = 2
DEFAULT_SIZE = 16
DEFAULT_ALBEDO = (0.7,)
DEFAULT_AMBIENT = 0.01
# Projector pixels of scenes that Mitsuba renders.
DEFAULT_MITSUBA_GRID = (24, 32)
SCENE_PANEL = "Scene"
RIG_PANEL = "Projector and camera"
Curve = Literal["linear", "srgb", "gamma2.2", "film"]


def _parse_albedo(text: str) -> tuple[float, ...]:
    with suppress(ValueError):
        albedo = tuple(map(float, text.split(",")))
        if len(albedo) in (1, 3):
            return albedo
    raise typer.BadParameter(f"{text!r} is not an albedo; write one number, or red,green,blue")


def _scene_options(
    size: Annotated[
        int | None,
        option("Patches along a wall of a scene. Default: 16.", min=2, panel=SCENE_PANEL),
    ] = None,
    albedo: Annotated[
        Any,
        option(
            "Albedo of the walls: A or R,G,B. Default: 0.7.",
            parser=_parse_albedo,
            metavar="ALBEDO",
            panel=SCENE_PANEL,
        ),
    ] = None,
    ambient: Annotated[
        float | None,
        option(
            "Ambient light of the room, in units of a lit white wall. Default: 0.01; a scene "
            "of Mitsuba has its own.",
            min=0.0,
            panel=SCENE_PANEL,
        ),
    ] = None,
) -> None:
    """The scene before the rig."""


def _rig_options(
    grid: Annotated[
        tuple | None,
        grid_option(
            "Projector pixels for mitsuba (24x32), or for a file that lacks them.",
            panel=RIG_PANEL,
        ),
    ] = None,
    camera_grid: Annotated[
        tuple | None,
        grid_option(
            "Camera pixels, if they differ from the projector's; Gray code then measures the "
            "correspondence.",
            panel=RIG_PANEL,
        ),
    ] = None,
    projectors: Annotated[
        int | None,
        option(
            "So many projectors side by side, which overlap by a third, instead of one; of a "
            "named scene. The camera then has three pixels along the side of a patch.",
            panel=RIG_PANEL,
            min=2,
            max=8,
        ),
    ] = None,
    response: Annotated[
        Curve, option("Response curve of the camera, light to code.", panel=RIG_PANEL)
    ] = "srgb",
    projector_response: Annotated[
        Curve, option("Response curve of the projector, code to light.", panel=RIG_PANEL)
    ] = "srgb",
    bits: Annotated[int, option("Bits per photograph.", min=8, max=16, panel=RIG_PANEL)] = 12,
    strategy: Annotated[
        Literal["auto", "sketch", "adaptive", "direct", "pixel", "block", "hadamard"],
        option("Strategy of the scan by 'ltcl acquire'.", panel=RIG_PANEL),
    ] = "auto",
    seed: Annotated[int, option("Random seed of the noise.", min=0, panel=RIG_PANEL)] = 0,
) -> None:
    """The projector and the camera."""


@command(_scene_options, _rig_options)
def simulate(
    context: Context,
    scene: Annotated[
        str,
        argument(
            "SCENE",
            "Scene: dihedral, trihedral, box; a transport file; or mitsuba: and one of these or an "
            "XML file of Mitsuba.",
            parser=None,
        ),
    ],
    out: options.OutFolder,
) -> Answer:
    """Make a folder in which 'ltcl acquire' photographs SCENE, without a camera.

    Writes acquisition.toml, with comments on all other settings, and truth.npz, the transport that
    is to be measured (except for mitsuba).
    """
    from ltcl.acquisition import Project

    _check_folder(out)
    asked = {name: value for name, value in context.options.items() if name != "out"}
    context.progress("scene")
    with pictures.fill(out) as folder:
        if asked["projectors"] is None:
            _write_project(folder, scene, asked)
        else:
            _write_several(folder, scene, asked)
        # Opening the rig refuses what cannot be photographed.
        with Project.open_all(folder)[0].rig() as rig:
            report = SimulateReport(
                folder=out,
                command="simulate",
                versions=Versions(**versions()),
                scene=scene,
                options=asked,
                projector_grid=rig.projector_grid,
                channels=rig.channels,
            )
        pictures.write_report(folder, report)
    size = size_text(report.projector_grid)
    several = "" if asked["projectors"] is None else f"{asked['projectors']} projectors of "
    lines = [
        f"{out}: {scene}, {several}{size} projector pixels, {report.channels} channel(s)",
        f"what it takes: ltcl acquire plan {out}",
        f"to do it:      ltcl acquire run {out}",
    ]
    return Answer(report, lines)


def _check_folder(out: Path) -> None:
    """Refuse a folder with an acquisition that would be lost."""
    if (out / "transport.zarr").exists():
        raise InputError(f"{out}: holds a transport.zarr that was acquired; choose another folder")
    has_project = (out / "acquisition.toml").exists()
    if has_project and not (out / "simulate.json").exists():
        raise InputError(
            f"{out}: holds an acquisition.toml of somebody else; choose another folder"
        )


def _write_project(folder: Path, scene: str, asked: dict[str, Any]) -> None:
    """Write acquisition.toml, and the files that it names."""
    rig = _write_scene(folder, scene, asked)
    for name in ("response", "projector_response", "bits", "seed"):
        rig[name] = asked[name]
    is_aligned = asked["camera_grid"] is None and not scene.endswith(".xml")
    settings = {
        "geometry": "aligned" if is_aligned else "graycode",
        "strategy": asked["strategy"],
    }
    text = TEMPLATE.read_text("utf-8").format(rig=_toml(rig), acquire=_toml(settings))
    (folder / "acquisition.toml").write_text(text, "utf-8")


def _write_several(folder: Path, scene: str, asked: dict[str, Any]) -> None:
    """Write acquisition.toml of several projectors, and the files that it names."""
    if scene not in SCENES:
        raise InputError(
            f"--projectors is {asked['projectors']}, but SCENE is {scene}; it must be one of "
            f"{', '.join(SCENES)}"
        )
    for name in ("camera_grid", "grid"):
        if asked[name] is not None:
            raise InputError(
                f"--{name.replace('_', '-')} is {asked[name]}, but with --projectors the scene "
                "decides"
            )
    light = _named_scene(scene, asked)
    scene_grid = checks.grid("grid", light.grid or (1, 1))
    if scene_grid[0] < asked["projectors"]:
        raise InputError(
            f"--size is {asked['size']}, but --projectors is {asked['projectors']}; so many take a "
            f"--size of {asked['projectors']} or more"
        )
    camera_grid = (CAMERA_PIXELS * scene_grid[0], CAMERA_PIXELS * scene_grid[1])
    _write_camera(folder / "camera.npz", camera_grid, scene_grid)
    ambient = asked["ambient"]
    rig = {
        "kind": "virtual",
        "camera_map": "camera.npz",
        "camera_grid": camera_grid,
        "ambient": DEFAULT_AMBIENT if ambient is None else ambient,
    }
    for name in ("response", "projector_response", "bits", "seed"):
        rig[name] = asked[name]
    tables = []
    albedo = asked["albedo"] or DEFAULT_ALBEDO
    for projector in side_by_side(asked["projectors"], scene_grid):
        direct = projector.direct(scene_grid).toarray()
        matrices = []
        for T, part in zip(light.matrices, albedo, strict=True):
            # T of a scene is S times its albedo.
            matrices.append(np.asarray(T @ direct / part, np.float32))
        path = f"{projector.name}.npz"
        record = StoreRecord(tuple(matrices), grid=projector.grid, camera_grid=scene_grid)
        formats.write(folder / path, record)
        tables.append(f"[[projector]]\n{_toml({'name': projector.name, 'transport': path})}")
    text = SEVERAL_TEMPLATE.read_text("utf-8").format(
        rig=_toml(rig),
        projectors="\n".join(tables),
        side=SIDE_PATCHES * CAMERA_PIXELS,
        acquire=_toml({"strategy": asked["strategy"]}),
    )
    (folder / "acquisition.toml").write_text(text, "utf-8")


def _toml(table: dict[str, Any]) -> str:
    """Format the lines of a table of TOML."""
    lines = []
    for key, value in table.items():
        lines.append(f"{key} = {json.dumps(value, ensure_ascii=False)}\n")
    return "".join(lines)


def _write_scene(folder: Path, scene: str, asked: dict[str, Any]) -> dict[str, Any]:
    """Write the files of a scene; return the first keys of the table [rig]."""
    source = scene.removeprefix("mitsuba:")
    is_rendered = source != scene
    is_named = source in SCENES
    _check_options(scene, asked, is_rendered, is_named)
    rig: dict[str, Any] = {}
    if asked["camera_grid"] is not None:
        rig["camera_grid"] = asked["camera_grid"]
    if is_rendered:
        return {**rig, **_mitsuba_rig(source, asked)}
    if is_named:
        record = _named_scene(source, asked)
    else:
        record = _scene_of_file(scene, asked)
    formats.write(folder / "truth.npz", record)
    ambient = asked["ambient"]
    rig["kind"] = "virtual"
    rig["transport"] = "truth.npz"
    rig["ambient"] = DEFAULT_AMBIENT if ambient is None else ambient
    if asked["camera_grid"]:
        rig["camera_map"] = "camera.npz"
        scene_grid = checks.grid("grid", record.camera_grid or record.grid)
        _write_camera(folder / "camera.npz", asked["camera_grid"], scene_grid)
    return rig


def _check_options(scene: str, asked: dict[str, Any], is_rendered: bool, is_named: bool) -> None:
    """Refuse options that the kind of scene does not take."""
    refused = {
        "size": is_rendered or not is_named,
        "grid": is_named and not is_rendered,
        "albedo": not is_named,
        "ambient": is_rendered,
    }
    for name, is_refused in refused.items():
        if is_refused and asked[name] is not None:
            raise InputError(f"--{name} is {asked[name]}, but {scene} takes no --{name}")


def _mitsuba_rig(source: str, asked: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of a rig that Mitsuba renders: a scene by name, or an XML file."""
    rig = {"kind": "mitsuba", "projector_grid": asked["grid"] or DEFAULT_MITSUBA_GRID}
    if source not in SCENES:
        return {**rig, "scene": str(Path(source).resolve())}
    albedo = asked["albedo"] or DEFAULT_ALBEDO
    rig["scene"] = source
    rig["channels"] = len(albedo)
    rig["albedo"] = _single_or_colour(albedo)
    return rig


def _single_or_colour(albedo: tuple[float, ...]) -> Any:
    if len(albedo) == 1:
        return albedo[0]
    return albedo


def _named_scene(name: str, asked: dict[str, Any]) -> StoreRecord:
    from ltcl import scenes

    size = asked["size"] or DEFAULT_SIZE
    albedo = _single_or_colour(asked["albedo"] or DEFAULT_ALBEDO)
    if np.ndim(albedo):
        # One colour for all walls.
        albedo = [albedo]
    if name == "box":
        scene = scenes.box(size, albedo=albedo, sides=5)
    else:
        scene = getattr(scenes, name)(size, albedo=albedo)
    return StoreRecord(scene.matrices(), grid=scene.grid)


def _scene_of_file(scene: str, asked: dict[str, Any]) -> Any:
    path = Path(scene)
    if not path.suffix and not path.exists():
        known = f"{', '.join(SCENES)}, mitsuba:NAME or a transport file"
        raise InputError(f"SCENE is {scene!r}; it must be {known}")
    record = formats.read(path)
    if isinstance(record, CombinedRecord):
        raise InputError(f"{scene}: is of several projectors; give the transport of one of them")
    if record.grid is None and asked["grid"] is None:
        raise InputError(f"{scene}: does not contain its grid; give --grid HxW")
    if isinstance(record, StoreRecord) and asked["grid"] is not None:
        grid = checks.grid("--grid", asked["grid"], record.shape[1])
        return dataclasses.replace(record, grid=grid)
    return record


def _write_camera(path: Path, camera_grid: tuple[int, int], scene_grid: tuple[int, int]) -> None:
    """Write the map of a camera in the projector's place, with pixels of its own."""
    from ltcl.acquisition import camera_map

    camera_height, camera_width = camera_grid
    height, width = scene_grid

    def project(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = (u + 0.5) * width / camera_width - 0.5
        y = (v + 0.5) * height / camera_height - 0.5
        return x, y

    seen = camera_map(project, camera_grid, scene_grid)
    formats.write(path, StoreRecord((seen,), grid=scene_grid, camera_grid=camera_grid))
