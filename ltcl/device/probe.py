# SPDX-License-Identifier: BSD-3-Clause
"""A trial of the OpenCL drivers of this machine, run as a script in a process of its own.

A broken driver can abort the process that loads it, lists it or compiles with it; here that costs nothing.
Prints one JSON line a device that passed. Imports nothing of ltcl, so that it starts fast.
"""

import json
import os
import sys

_KERNEL = "kernel void trial(global int *x) { x[get_global_id(0)] += 41; }"


def main() -> None:
    """Run a small kernel on every device of every platform the loader shows."""
    os.environ["PYOPENCL_NO_CACHE"] = "1"  # pyopencl's cache reads and writes pickles
    import numpy as np
    import pyopencl as cl

    if "LTCL_PROBE_HOME" in os.environ:  # pyopencl sets its own on import; discovery may want another
        os.environ["PYOPENCL_HOME"] = os.environ["LTCL_PROBE_HOME"]
    for platform in cl.get_platforms():
        for device in platform.get_devices():
            context = cl.Context([device])
            queue = cl.CommandQueue(context)
            values = np.ones(4, np.int32)
            buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=values)
            program = cl.Program(context, _KERNEL).build()
            cl.Kernel(program, "trial")(queue, (4,), None, buffer)
            cl.enqueue_copy(queue, values, buffer)
            passed = bool((values == 42).all())
            line = {"platform": platform.name, "device": device.name, "passed": passed}
            sys.stdout.write(json.dumps(line) + "\n")
            sys.stdout.flush()  # what passed must be out before the next driver can abort


if __name__ == "__main__":
    main()
