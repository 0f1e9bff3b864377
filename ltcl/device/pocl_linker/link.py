# SPDX-License-Identifier: BSD-3-Clause
"""`ld ... -o LIBRARY ... OBJECT ...` of an object that PoCL has compiled, which takes no library, by `tcc`.

What others link is left to the next `ld` in PATH. A library whose program headers do not name the
stack asks for an executable one, which glibc refuses from 2.41 on. So the header of a protection
that kernels can do without, GNU_RELRO, becomes that of a plain stack.
"""

import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

_RELRO, _STACK, _READ_WRITE = 0x6474E552, 0x6474E551, 6  # ELF: types of a program header; its flags


def main(arguments: list[str]) -> int:
    """Exit code of the linker."""
    # PoCL names its objects so.
    objects = [each for each in arguments if each.endswith(".so.o") and "tempfile_" in each]
    if "-shared" not in arguments or "-o" not in arguments or len(objects) != 1:
        own = Path(__file__).parent
        others = [
            each for each in os.environ.get("PATH", "").split(os.pathsep) if Path(each) != own
        ]
        if (other := shutil.which("ld", path=os.pathsep.join(others))) is None:
            sys.stderr.write("ld: this one links for PoCL alone, and PATH has no other\n")
            return 127
        os.execv(other, [other, *arguments])  # noqa: S606
    library = arguments[arguments.index("-o") + 1]
    link = [os.environ["LTCL_TCC"], "-shared", "-nostdlib", "-o", library, *objects]
    code = subprocess.run(link, check=False).returncode  # noqa: S603
    if code == 0:
        with open(library, "r+b") as file:
            first, size, count = struct.unpack("<32xQ14xHH6x", file.read(64))
            for place in range(first, first + size * count, size):
                file.seek(place)
                if file.read(4) == struct.pack("<I", _RELRO):
                    file.seek(place)
                    file.write(struct.pack("<II", _STACK, _READ_WRITE))
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
