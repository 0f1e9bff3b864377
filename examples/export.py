# SPDX-License-Identifier: BSD-3-Clause
"""An export of your own: what a scan tells, in a format that another program reads.

`read_projectors` gives maps, blend and black of each projector, from the stores of `ltcl acquire
run` or the folders of `ltcl acquire import`. In ltcl itself the writer would lie in
`ltcl/show/export`, and its name in FORMATS of `ltcl/cli/export.py`.
"""

import csv
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ltcl.acquisition import Correspondence
from ltcl.acquisition.captures.map_file import write_map
from ltcl.show.export import ExportedProjector, read_projectors

CAMERA = (30, 60)
PROJECTOR = (10, 20)


def write_csv(path: Path, projector: ExportedProjector) -> int:
    """Write a line for each pixel that is seen: its place, that in the camera, its share."""
    seen = np.argwhere(np.isfinite(projector.camera_x))
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow(["row", "column", "camera_row", "camera_column", "blend"])
        for row, column in seen:
            place = projector.camera_y[row, column], projector.camera_x[row, column]
            lines.writerow([row, column, *place, projector.blend[row, column]])
    return len(seen)


def a_scan(folder: Path) -> None:
    """Write the map of a camera that sees each projector pixel as 3 x 3 of its own."""
    row, column = np.indices(CAMERA, np.float32)
    everywhere = np.ones(CAMERA, bool)
    mapping = Correspondence((column - 1.0) / 3.0, (row - 1.0) / 3.0, everywhere, PROJECTOR)
    write_map(folder / "map.npz", mapping)


def main() -> None:
    """Export a scan, and read it back."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        a_scan(folder)
        (projector,) = read_projectors([folder])
        count = write_csv(folder / "projector.csv", projector)
        with (folder / "projector.csv").open(encoding="utf-8") as file:
            lines = list(csv.DictReader(file))
    assert len(lines) == count
    assert count > 0.8 * np.prod(PROJECTOR)
    middle = next(line for line in lines if (line["row"], line["column"]) == ("5", "10"))
    assert abs(float(middle["camera_row"]) - 16.0) < 0.1
    print(f"{count} pixels of a projector as CSV")


if __name__ == "__main__":
    main()
