# SPDX-License-Identifier: BSD-3-Clause
"""Fuzzers of the readers of files: bytes in, a result or one line that names the file.

    python -m tests.fuzz.fuzz pictures|films|stores [--seconds 60] [--seed 0]

Where atheris is installed it changes the bytes, guided by the lines of ltcl that they reach; else
they are changed at random. The corpus is made here: small files of all formats. A finding ends the
run with an exit status of its own, after its bytes were saved in the folder that is named; a crash
or a hang as well. `python -m tests.fuzz.fuzz films FILE` repeats it.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import itertools
import logging
import random
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
from PIL import Image

atheris: Any = None
with contextlib.suppress(ImportError):
    atheris = importlib.import_module("atheris")

# libFuzzer is guided by the lines of these that a file reaches.
GUIDES = ["ltcl.images", "ltcl.store", "ltcl.files", "ltcl.checks"]
with atheris.instrument_imports(include=GUIDES) if atheris else contextlib.nullcontext():
    import ltcl
    from ltcl import images
    from ltcl.errors import LtclError
    from ltcl.images.frames import open_frames, write_video
    from ltcl.store import formats

# Most that a file may take in memory: far more than its bytes, as it may say that it is large.
MEMORY = 1 << 28
MAX_FRAMES = 20
MAX_BYTES = 1 << 16
# Numbers at which programs fail.
EDGES = (0, 1, 127, 128, 255, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


@dataclass(frozen=True)
class Target:
    """A reader, and how to write small files for it: the name of each, and its bytes."""

    read: Callable[[Path], Any]
    seeds: Callable[[Path], list[tuple[str, bytes]]]


def read_picture(path: Path) -> None:
    picture = images.read(path, memory=MEMORY)
    assert np.isfinite(picture).all()


def read_film(path: Path) -> None:
    for frame in itertools.islice(open_frames(path), MAX_FRAMES):
        frame.picture()


def picture_seeds(folder: Path) -> list[tuple[str, bytes]]:
    for suffix, bits in images.BITS.items():
        for bit_count, shape in itertools.product(bits, [(3, 5), (4, 3, 3)]):
            light = np.linspace(0, 1, int(np.prod(shape))).reshape(shape)
            images.write(folder / f"{len(shape)}-{bit_count}{suffix}", light, bits=bit_count)
    palette = Image.new("P", (5, 3))
    palette.putpalette(list(range(30)))
    palette.save(folder / "palette.png", transparency=2)
    for compression in ("tiff_lzw", "tiff_deflate", "packbits", "jpeg"):
        Image.new("RGB", (8, 8), (9, 99, 199)).save(
            folder / f"{compression}.tif", compression=compression
        )
    return files(folder)


def film_seeds(folder: Path) -> list[tuple[str, bytes]]:
    import av

    light = np.linspace(0, 1, 3 * 16 * 16 * 3).reshape(3, 16, 16, 3)
    for suffix in (".mkv", ".avi", ".mp4"):
        write_video(folder / f"a{suffix}", light)
    codecs = [("b.mp4", "libx264"), ("c.webm", "libvpx-vp9"), ("d.ts", "mpeg2video")]
    for name, codec in codecs:
        with av.open(str(folder / name), "w") as container:
            stream: Any = container.add_stream(codec, rate=25)
            stream.height = stream.width = 16
            stream.pix_fmt = "yuv420p"
            for picture in (255 * light).astype(np.uint8):
                frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    return files(folder)


def store_seeds(folder: Path) -> list[tuple[str, bytes]]:
    dense = ltcl.Transport(np.eye(6) * 0.5 + 0.01, (2, 3))
    sparse = ltcl.Transport(scipy.sparse.eye_array(6, format="csr") * 0.5, (2, 3))
    for suffix in (".npz", ".npy", ".mtx", ".mat", ".h5"):
        ltcl.save(folder / f"dense{suffix}", dense)
        if suffix != ".npy":
            ltcl.save(folder / f"sparse{suffix}", sparse)
    ltcl.save(folder / "small.npz", ltcl.compress(dense, 0.1))
    return files(folder)


def files(folder: Path) -> list[tuple[str, bytes]]:
    return [(path.name, path.read_bytes()) for path in sorted(folder.iterdir())]


TARGETS = {
    "pictures": Target(read_picture, picture_seeds),
    "films": Target(read_film, film_seeds),
    "stores": Target(formats.read, store_seeds),
}


class Fuzzer:
    """A target, its corpus, and the file that is read again and again."""

    def __init__(self, target: Target, folder: Path) -> None:
        self.folder = folder
        self.read = target.read
        seed_folder = folder / "seeds"
        seed_folder.mkdir()
        seeds = target.seeds(seed_folder)
        self.suffixes = sorted({Path(name).suffix for name, _ in seeds})
        # The first byte tells the extension.
        self.corpus = []
        for name, data in seeds:
            self.corpus.append(bytes([self.suffixes.index(Path(name).suffix)]) + data)

    def try_bytes(self, data: bytes) -> None:
        """Read bytes as a file; AssertionError for a message of more than a line."""
        if not data:
            return
        # What stands in the upper half of the byte tells whether checksums are put right.
        suffix = self.suffixes[data[0] % 16 % len(self.suffixes)]
        content = data[1:]
        if suffix == ".png" and data[0] < 128:
            content = with_checksums(content)
        path = self.folder / f"fuzzed{suffix}"
        path.write_bytes(content)
        try:
            self.read(path)
        except LtclError as error:
            message = str(error)
            assert str(path) in message, message
            assert "\n" not in message, message


def with_checksums(png: bytes) -> bytes:
    """A PNG file whose chunks have the right checksums, so that more than these is read."""
    stream = io.BytesIO(png)
    out = [stream.read(8)]
    while len(head := stream.read(8)) == 8:
        (length,) = struct.unpack(">I", head[:4])
        data = stream.read(min(length, MAX_BYTES))
        stream.read(4)
        out += [head, data, struct.pack(">I", zlib.crc32(head[4:] + data))]
    return b"".join(out)


def mutate(data: bytes, corpus: list[bytes], choose: random.Random) -> bytes:
    """Bytes with up to four changes."""
    changed = bytearray(data)
    for _ in range(choose.randint(1, 4)):
        place = choose.randrange(len(changed) + 1)
        kind = choose.randrange(5)
        if kind == 0 and changed:
            changed[min(place, len(changed) - 1)] ^= 1 << choose.randrange(8)
        elif kind == 1:
            size = choose.choice((1, 2, 4))
            order = choose.choice(("little", "big"))
            edge = choose.choice(EDGES) & ((1 << 8 * size) - 1)
            changed[place : place + size] = edge.to_bytes(size, order)
        elif kind == 2:
            del changed[place : place + choose.randrange(1, 64)]
        elif kind == 3:
            other = choose.choice(corpus)
            start = choose.randrange(len(other))
            changed[place:place] = other[start : start + choose.randrange(1, 64)]
        else:
            del changed[choose.randrange(len(changed) + 1) :]
    return bytes(changed[:MAX_BYTES])


def run_at_random(fuzzer: Fuzzer, seconds: float, seed: int) -> int:
    """Read changed files until the time is over; the number of files."""
    choose = random.Random(seed)  # noqa: S311 - no secrets
    end = time.monotonic() + seconds
    for count in itertools.count():
        if time.monotonic() > end:
            return count
        data = mutate(choose.choice(fuzzer.corpus), fuzzer.corpus, choose)
        # A crash of a decoder leaves the file as it was.
        (fuzzer.folder / "last").write_bytes(data)
        fuzzer.try_bytes(data)
    raise AssertionError


def run_with_atheris(fuzzer: Fuzzer, seconds: float, seed: int) -> None:
    """Let libFuzzer read changed files; it ends the process."""
    corpus = fuzzer.folder / "corpus"
    corpus.mkdir()
    for number, data in enumerate(fuzzer.corpus):
        (corpus / str(number)).write_bytes(data)
    options = [
        f"-max_total_time={int(seconds)}",
        f"-seed={seed + 1}",
        f"-max_len={MAX_BYTES}",
        f"-artifact_prefix={fuzzer.folder}/",
        "-timeout=60",
        "-rss_limit_mb=4096",
    ]
    atheris.Setup([sys.argv[0], str(corpus), *options], fuzzer.try_bytes)
    atheris.Fuzz()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("file", nargs="?", type=Path, help="bytes to repeat")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="folder of findings; else a temporary one")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    folder = options.folder or Path(tempfile.mkdtemp(prefix="ltcl-fuzz-"))
    folder.mkdir(exist_ok=True)
    sys.stderr.write(f"{options.target}: findings go to {folder}\n")
    fuzzer = Fuzzer(TARGETS[options.target], folder)
    if options.file is not None:
        fuzzer.try_bytes(options.file.read_bytes())
    elif atheris is None:
        count = run_at_random(fuzzer, options.seconds, options.seed)
        sys.stderr.write(f"{options.target}: {count} files\n")
    else:
        run_with_atheris(fuzzer, options.seconds, options.seed)


if __name__ == "__main__":
    main()
