# SPDX-License-Identifier: BSD-3-Clause
"""A kernel of your own: a file of OpenCL C, launched on ltcl's device, against its twin in NumPy.

In ltcl itself it would lie in `kernels/`, its twin in `tests/reference.py`.
"""

from pathlib import Path

import numpy as np

import ltcl

SOURCE = Path(__file__).with_name("soft.cl")
# Work-items that run together; ltcl clamps it to what the device allows.
GROUP = 64


def soft_threshold(x: np.ndarray, t: float, device: ltcl.Device) -> np.ndarray:
    """Bring all of x, (n,), nearer to zero by t, on the device."""
    kernel = device.kernel(str(SOURCE), "soft_threshold")
    on_device = device.upload(x)
    out = on_device.like()
    # Arguments go by their names in the source; the launch returns at once, and `get` waits.
    kernel(-(-x.size // GROUP) * GROUP, GROUP, count=x.size, t=t, x=on_device, out=out)
    return out.get()


def twin(x: np.ndarray, t: float) -> np.ndarray:
    """Compute the same in float64."""
    return np.sign(x) * np.maximum(np.abs(x) - t, 0.0)


def main() -> None:
    """Compare both on awkward sizes."""
    device = ltcl.open_device()
    random = np.random.default_rng(0)
    for n in (1, 53, 1000):
        x = random.standard_normal(n)
        difference = np.abs(soft_threshold(x, 0.5, device) - twin(x, 0.5)).max()
        # A difference and its operands are rounded to float32.
        assert difference <= 2.0**-22 * np.abs(x).max()
    print(f"soft_threshold agrees with NumPy on {device.name}")


if __name__ == "__main__":
    main()
