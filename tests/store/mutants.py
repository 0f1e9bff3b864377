# SPDX-License-Identifier: BSD-3-Clause
"""Damaged transport files, read in a process of its own: ``python -m tests.store.mutants FOLDER COUNT SEED``.

Each of the files in FOLDER in turn has bits flipped, is cut, gets bytes appended, or has bytes of its head
replaced; of a store, one of its files. Prints how many were read, how many refused, whatever was raised that
is no error of ltcl in one line with the file's name, and by how many bytes the process has grown.
"""

from __future__ import annotations

import json
import random
import resource
import shutil
import sys
from pathlib import Path

from ltcl.errors import LtclError
from ltcl.store import formats, inverses

HEAD = 400


def mutant(good: bytes, draw: random.Random) -> bytes:
    """The same bytes but for some damage."""
    data, how = bytearray(good), draw.randrange(4)
    if how == 0:
        for _ in range(draw.choice((1, 1, 4))):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    elif how == 1:
        del data[draw.randrange(len(data)) :]
    elif how == 2:
        data += draw.randbytes(draw.choice((1, 8, 40)))
    else:
        place, size = draw.randrange(min(len(data), HEAD)), draw.choice((1, 4, 8))
        data[place : place + size] = bytes(
            draw.choice((0, 255, 57, 69, draw.randrange(256))) for _ in range(size)
        )
    return bytes(data)


def main(folder: Path, count: int, seed: int) -> None:
    """See above."""
    draw, raw, refused = random.Random(seed), [], 0  # noqa: S311 - damage, no secrets
    good = sorted(path for path in folder.iterdir() if path.name != "mutants")
    for path in good:  # so that memory is counted from a process that has read each once
        inverses.read(path) if inverses.is_inverse(path) else formats.read(path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(count):
        original = good[number % len(good)]
        path = place = folder / "mutants" / f"{number}{original.suffix}"
        if original.is_dir():
            shutil.copytree(original, path)
            place = path / draw.choice(sorted(f.relative_to(path) for f in path.rglob("*") if f.is_file()))
            original = original / place.relative_to(path)
        else:
            path.parent.mkdir(exist_ok=True)
        place.write_bytes(mutant(original.read_bytes(), draw))
        try:
            inverses.read(path) if "inverse" in original.name else formats.read(path)
        except LtclError as error:
            refused += 1
            if not str(error).startswith(f"{path}: ") or "\n" in str(error):
                raw.append(f"{original.name} {number}: {error}")
        except Exception as error:  # noqa: BLE001 - whatever there is, it is listed
            raw.append(f"{original.name} {number}: {type(error).__name__}: {error}")
        else:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    outcome = {"read": count - refused - len(raw), "refused": refused, "raw": raw, "grown": grown}
    sys.stdout.write(json.dumps(outcome))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
