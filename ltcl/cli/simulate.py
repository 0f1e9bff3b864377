# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl simulate`: a scene to be photographed without a camera, as a folder for `ltcl acquire`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from ltcl import checks, report
from ltcl.cli import acquisition_file, console, options, results
from ltcl.errors import InputError, InputTypeError

_MITSUBA = "mitsuba:"
_SCENES = ("dihedral", "trihedral", "box")
_SIZE, _GRID = 16, (24, 32)


def _albedo(text: str) -> tuple[float, ...]:
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) not in (1, 3):
        raise typer.BadParameter(f"{text!r} is no albedo; write one number, or red,green,blue")
    return found


_SCENE = Annotated[
    str,
    typer.Argument(
        metavar="SCENE",
        help="dihedral, trihedral or box; a transport file; or mitsuba: and dihedral, trihedral, box or an "
        "XML file of Mitsuba (extra rig), which is rendered.",
    ),
]
_Size = Annotated[
    int | None,
    typer.Option(
        min=2, metavar="N", help="Patches along a wall of a scene. Default: 16.", show_default=False
    ),
]
_Grid = Annotated[
    tuple | None,
    typer.Option(
        parser=options.grid,
        metavar="HxW",
        help="Projector pixels: of mitsuba (default 24x32), or where the file does not tell.",
        show_default=False,
    ),
]
_CameraGrid = Annotated[
    tuple | None,
    typer.Option(
        parser=options.grid,
        metavar="HxW",
        help="Camera pixels, if not those of the projector: Gray code then finds which is which.",
        show_default=False,
    ),
]
_Albedo = Annotated[
    Any,
    typer.Option(
        parser=_albedo,
        metavar="A|R,G,B",
        help="Of the walls; three numbers make it a scene in colour. Default: 0.7.",
        show_default=False,
    ),
]
_Curve = Literal["linear", "srgb", "gamma2.2", "film"]
_Response = Annotated[_Curve, typer.Option(help="Of the camera, light to code.")]
_Projector = Annotated[_Curve, typer.Option(help="Of the projector, code to light.")]
_Bits = Annotated[int, typer.Option(min=8, max=16, metavar="8|12|16", help="Of the photographs.")]
_Ambient = Annotated[
    float | None,
    typer.Option(
        min=0.0,
        metavar="LIGHT",
        help="In the room, where a white wall under the projector has 1. Default: 0.01; mitsuba has its own.",
        show_default=False,
    ),
]
_Strategy = Annotated[
    Literal["auto", "adaptive", "pixel", "block", "hadamard"],
    typer.Option(help="How 'ltcl acquire' is to scan."),
]
_Seed = Annotated[int, typer.Option(min=0, metavar="N", help="Of the noise.")]


def run(
    scene: _SCENE,
    out: options.Out,
    size: _Size = None,
    grid: _Grid = None,
    camera_grid: _CameraGrid = None,
    albedo: _Albedo = None,
    response: _Response = "srgb",
    projector_response: _Projector = "srgb",
    bits: _Bits = 12,
    ambient: _Ambient = None,
    strategy: _Strategy = "auto",
    seed: _Seed = 0,
    json: options.Json = False,
) -> None:
    """Make a folder in which 'ltcl acquire' photographs SCENE, without a camera.

    Writes acquisition.toml, which says how, with what else it could say; truth.npz, the transport that is to
    be found again (not of mitsuba); and white.png and black.png, what the camera photographs under these.
    """
    _refuse_taken(out)
    sensor = {"response": response, "projector_response": projector_response, "bits": bits, "seed": seed}
    given = {"size": size, "grid": grid, "camera_grid": camera_grid, "albedo": albedo, "ambient": ambient}
    text = {"command": "simulate", "versions": report.versions(), "scene": scene}
    text["options"] = {**given, **sensor, "strategy": strategy}
    with console.Steps(2) as steps, results.fill(out, text) as folder:
        steps.item("scene")
        if scene.startswith(_MITSUBA):
            rig = _rendered(scene.removeprefix(_MITSUBA), given)
        else:
            rig = _known(folder, scene, given)
        aligned = camera_grid is None and not scene.endswith(".xml")
        settings = {"geometry": "aligned" if aligned else "graycode", "strategy": strategy}
        (folder / "acquisition.toml").write_text(acquisition_file.text(rig | sensor, settings), "utf-8")
        steps.item("photographs")
        with _named(folder, out):
            facts = _photograph(folder)
        text |= facts
    if json:
        console.answer({"folder": out, **text})
        return
    h, w = facts["projector_grid"]
    typer.echo(f"{out}: {scene}, {h} x {w} projector pixels, {facts['channels']} channel(s)")
    typer.echo(f"what it takes: ltcl acquire plan {out}\nto do it:      ltcl acquire run {out}")


def _refuse_taken(out: Path) -> None:
    """Nobody's acquisition, and no acquisition.toml written by hand, is replaced."""
    if (out / "transport.zarr").exists():
        raise InputError(f"{out}: holds a transport.zarr that was acquired; choose another folder")
    if (out / "acquisition.toml").exists() and not (out / "simulate.json").exists():
        raise InputError(
            f"{out}: holds an acquisition.toml that 'ltcl simulate' did not make; choose another folder"
        )


@contextmanager
def _named(folder: Path, out: Path) -> Iterator[None]:
    """Refusals name the folder that is to be, not the one that is filled."""
    try:
        yield
    except (InputError, InputTypeError) as error:
        raise type(error)(str(error).replace(str(folder), str(out))) from None


def _photograph(folder: Path) -> dict[str, Any]:
    """Pictures under white and black as the camera gives them; sizes for the report."""
    from ltcl import images
    from ltcl.acquisition import Project, Shots
    from ltcl.acquisition.geometry.measure import exposure

    with Project.open(folder).rig() as rig:
        shots = Shots(rig)
        seconds = exposure(shots, shots.grid)
        for name, code in (("white", 1.0), ("black", 0.0)):
            codes = shots.photograph(np.full(shots.grid, code, np.float32), seconds)
            images.write(folder / f"{name}.png", codes, encoding="linear")
        grids = {"projector_grid": shots.grid, "camera_grid": shots.camera_grid}
        return {**grids, "channels": shots.channels, "seconds": seconds}


def _rendered(scene: str, given: dict[str, Any]) -> dict[str, Any]:
    """The table of a rig that Mitsuba renders."""
    _refuse(given, "size", "ambient", why="is not for mitsuba")
    rig: dict[str, Any] = {"kind": "mitsuba", "scene": scene, "projector_grid": given["grid"] or _GRID}
    if scene not in _SCENES:
        _refuse(given, "albedo", why=f"is for {', '.join(_SCENES)}; {scene} has its own")
        rig["scene"] = str(Path(scene).resolve())
    albedo = given["albedo"] or (0.7,)
    if scene in _SCENES:
        rig |= {"channels": len(albedo), "albedo": albedo if len(albedo) == 3 else albedo[0]}
    if given["camera_grid"]:
        rig["camera_grid"] = given["camera_grid"]
    return rig


def _known(folder: Path, scene: str, given: dict[str, Any]) -> dict[str, Any]:
    """The table of a rig around a transport, which goes into the folder."""
    from ltcl.store import Record, formats

    if scene in _SCENES:
        _refuse(given, "grid", why="is for mitsuba and files; give --size")
        record = _built(scene, given["size"] or _SIZE, given["albedo"] or (0.7,))
    else:
        _refuse(given, "size", "albedo", why=f"is for {', '.join(_SCENES)}; a file has its own")
        record = formats.read(_file(scene))
    if isinstance(record, Record) and (given["grid"] or record.grid is None):
        if given["grid"] is None:
            raise InputError(f"{scene}: does not tell its grid; give --grid HxW")
        record = dataclasses.replace(record, grid=checks.grid("--grid", given["grid"], record.shape[1]))
    formats.write(folder / "truth.npz", record)
    rig: dict[str, Any] = {"kind": "virtual", "transport": "truth.npz"}
    if given["camera_grid"]:
        rig |= {"camera_grid": given["camera_grid"], "camera_map": "camera.npz"}
        formats.write(folder / "camera.npz", _camera(record.camera_grid or record.grid, given["camera_grid"]))
    return rig | {"ambient": 0.01 if given["ambient"] is None else given["ambient"]}


def _refuse(given: dict[str, Any], *names: str, why: str) -> None:
    for name in names:
        if given[name] is not None:
            raise InputError(f"--{name} is given, but it {why}")


def _file(scene: str) -> Path:
    path = Path(scene)
    if not path.suffix and not path.exists():
        raise InputError(
            f"SCENE is {scene!r}; it must be {', '.join(_SCENES)}, mitsuba:NAME or a transport file"
        )
    return path


def _built(scene: str, size: int, albedo: tuple[float, ...]) -> Any:
    from ltcl import scenes
    from ltcl.store import Record

    walls = np.array([albedo]) if len(albedo) == 3 else albedo[0]
    sides = {"sides": 5} if scene == "box" else {}
    made = getattr(scenes, scene)(size, albedo=walls, **sides)
    return Record(made.matrices(), grid=made.grid)


def _camera(pixels: Any, camera: tuple[int, int]) -> Any:
    """What each pixel of a camera in the projector's place sees: the mean of the area that it covers."""
    from scipy.sparse import csr_array, kron

    from ltcl.store import Record

    down, across = (csr_array(_covered(*sides)) for sides in zip(pixels, camera, strict=True))
    return Record((csr_array(kron(down, across)),), grid=pixels, camera_grid=camera)


def _covered(pixels: int, camera: int) -> np.ndarray:
    """Of each of the camera's pixels along a side, its parts on the others, (camera, pixels).

    >>> _covered(4, 2).tolist()
    [[0.5, 0.5, 0.0, 0.0], [0.0, 0.0, 0.5, 0.5]]
    """
    edges, start = np.arange(camera + 1) * pixels / camera, np.arange(pixels)
    shared = np.minimum(edges[1:, None], start + 1) - np.maximum(edges[:-1, None], start)
    return np.maximum(shared, 0.0) * camera / pixels
