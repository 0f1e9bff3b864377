# SPDX-License-Identifier: BSD-3-Clause
"""The linker that the script `ld` runs: it links an object of PoCL by `tcc`.

It links `ld ... -o LIBRARY ... OBJECT ...`, where PoCL has compiled OBJECT, which needs no library.
All else is left to the next `ld` in PATH.

A library whose program headers do not name the stack asks for an executable one, which glibc
refuses from 2.41 on. So the header of a protection that kernels can do without, GNU_RELRO, becomes
that of a plain stack.
"""

import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

# ELF: types of a program header, and its flags.
GNU_RELRO = 0x6474E552
GNU_STACK = 0x6474E551
READ_WRITE = 6
COMMAND_NOT_FOUND = 127


def main(arguments: list[str]) -> int:
    """Exit code of the linker."""
    objects = [name for name in arguments if is_pocl_object(name)]
    if "-shared" not in arguments or "-o" not in arguments or len(objects) != 1:
        return run_next_linker(arguments)
    library = arguments[arguments.index("-o") + 1]
    command = [os.environ["LTCL_TCC"], "-shared", "-nostdlib", "-o", library, *objects]
    code = subprocess.run(command, check=False).returncode  # noqa: S603
    if code == 0:
        declare_plain_stack(library)
    return code


def is_pocl_object(name: str) -> bool:
    """True for the names that PoCL gives its objects."""
    return name.endswith(".so.o") and "tempfile_" in name


def run_next_linker(arguments: list[str]) -> int:
    """Become the next `ld` in PATH; returns only if there is none."""
    own_folder = Path(__file__).parent
    folders = os.environ.get("PATH", "").split(os.pathsep)
    other_folders = [folder for folder in folders if Path(folder) != own_folder]
    linker = shutil.which("ld", path=os.pathsep.join(other_folders))
    if linker is None:
        sys.stderr.write("ld: this one links for PoCL alone, and PATH has no other\n")
        return COMMAND_NOT_FOUND
    os.execv(linker, [linker, *arguments])  # noqa: S606


def declare_plain_stack(library: str) -> None:
    """Turn the header GNU_RELRO of an ELF library into that of a stack that is not executable."""
    with open(library, "r+b") as file:
        elf_header = file.read(64)
        first, size, count = struct.unpack("<32xQ14xHH6x", elf_header)
        for position in range(first, first + size * count, size):
            file.seek(position)
            if file.read(4) == struct.pack("<I", GNU_RELRO):
                file.seek(position)
                file.write(struct.pack("<II", GNU_STACK, READ_WRITE))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
