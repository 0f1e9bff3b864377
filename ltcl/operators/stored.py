# SPDX-License-Identifier: BSD-3-Clause
"""Operators S = I + R and bases as plain arrays, which files hold, and made from such again.

=====================================================  ==================================
system_0.sign, .solution_error, .error_bound           of each channel
system_0.weights                                       if S has them
system_0.R.kind                                        "csr", "dense", "tiles" or "compressed"
system_0.R.error                                       norm of what was dropped
system_0.R.core.kind, ...                              of "compressed"
system_0.R.out, .into                                  numbers of bases, -1 for pixels
basis_0.name, ...                                      see `Basis.to_arrays`
=====================================================  ==================================

A basis that several operators share is there once. Constructors check every size and index before
anything is uploaded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.operators.base import Operator
from ltcl.operators.bases import Basis, ScaledBasis, SubsetBasis
from ltcl.operators.colour_hats import COLOURS
from ltcl.operators.compressed import Compressed
from ltcl.operators.csr import CSR, Pattern, plain_arrays
from ltcl.operators.dense import Dense
from ltcl.operators.identity_plus import IdentityPlus
from ltcl.operators.patch_hats import PATCH_HATS, PatchHats
from ltcl.operators.pyramid import Hats
from ltcl.operators.tiles import Tiles
from ltcl.operators.wavelets import Wavelet, basis

Arrays = dict[str, np.ndarray]
KINDS: dict[str, Any] = {"csr": CSR, "dense": Dense, "tiles": Tiles}
# The number of a basis where a side is pixels.
NO_BASIS = -1


def to_arrays(systems: Sequence[IdentityPlus]) -> Arrays:
    """The arrays of all channels, as they lie on the device; an R of another kind is refused."""
    bases: dict[Basis, int] = {}
    arrays: Arrays = {}
    for number, S in enumerate(systems):
        system = {
            "sign": np.array(S.sign),
            "solution_error": np.array(S.solution_error),
            "error_bound": np.array(S.error_bound),
        }
        if S.weights is not None:
            system["weights"] = np.asarray(S.weights, np.float64)
        system |= _prefixed("R", _operator_arrays(S.R, bases))
        arrays |= _prefixed(f"system_{number}", system)
    for W, number in bases.items():
        arrays |= _prefixed(f"basis_{number}", W.to_arrays())
    return arrays


def multiscale_arrays(
    sums: str,
    grid: tuple[int, int],
    cores: Sequence[scipy.sparse.csr_array],
    diagonals: np.ndarray,
    scales: np.ndarray | None = None,
) -> Arrays:
    """The arrays of S = I + R, R = C W or R = diag(scale) W^T C W, made without a device.

    `sums` names W, the sums at all scales of a `grid`: "pyramid" or "hats".

    `cores` are C, (N, sums), or (sums, sums) with `scales`, (channels, N); `diagonals`,
    (channels, N), are those of R.
    """
    described = {"name": np.array(sums), "grid": np.array(grid)}
    arrays = _prefixed("basis_0", described)
    for number, (C, diagonal) in enumerate(zip(cores, diagonals, strict=True)):
        out = NO_BASIS
        if scales is not None:
            out = number + 1
            arrays |= _prefixed(f"basis_{out}", {**described, "scale": scales[number]})
        R = {
            "kind": np.array("compressed"),
            "error": np.array(0.0),
            "out": np.array(out),
            "into": np.array(0),
            "diagonal": diagonal,
        }
        core = {"kind": np.array("csr"), "error": np.array(0.0), **plain_arrays(C)}
        R |= _prefixed("core", core)
        system = {"sign": np.array(1.0), "solution_error": np.array(0.0), **_prefixed("R", R)}
        arrays |= _prefixed(f"system_{number}", system)
    return arrays


def _operator_arrays(R: Operator, bases: dict[Basis, int]) -> Arrays:
    if not isinstance(R, Compressed):
        return _core_arrays(R)
    arrays = {
        "kind": np.array("compressed"),
        "error": np.array(float(R.error)),
        "out": np.array(_number_basis(R.out, bases)),
        "into": np.array(_number_basis(R.into, bases)),
    }
    arrays |= _prefixed("core", _core_arrays(R.core))
    if R.known_diagonal is not None:
        arrays["diagonal"] = R.known_diagonal
    return arrays


def _number_basis(W: Basis | None, bases: dict[Basis, int]) -> int:
    """The number of a basis, a new one at the first time."""
    if W is None:
        return NO_BASIS
    return bases.setdefault(W, len(bases))


def _core_arrays(A: Any) -> Arrays:
    for kind, known in KINDS.items():
        if isinstance(A, known):
            return {"kind": np.array(kind), "error": np.array(float(A.error)), **A.to_arrays()}
    raise InputTypeError(f"R holds a {type(A).__name__}, which cannot be kept as arrays")


def from_arrays(device: Device, arrays: Mapping[str, np.ndarray]) -> tuple[IdentityPlus, ...]:
    """The S of all channels whose `to_arrays` gave `arrays`; arrays that do not fit are refused."""
    try:
        return StoredSystems(device, arrays).read()
    except LtclError:
        raise
    except KeyError as error:
        raise InputError(f"the parts of the operators lack {error.args[0]!r}") from None
    except (IndexError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"the parts of the operators do not fit: {str(error)!a:.150}") from None


class StoredSystems:
    """Reads the systems of all channels, which may share bases and a pattern."""

    def __init__(self, device: Device, arrays: Mapping[str, np.ndarray]) -> None:
        self._device = device
        self._arrays = arrays
        self._bases: dict[int, Basis] = {}
        self._pattern: Pattern | None = None

    def read(self) -> tuple[IdentityPlus, ...]:
        """The systems of all channels."""
        systems: list[IdentityPlus] = []
        while f"system_{len(systems)}.sign" in self._arrays:
            system = under(self._arrays, f"system_{len(systems)}")
            systems.append(self._read_system(system))
        return tuple(systems)

    def _read_system(self, arrays: Mapping[str, Any]) -> IdentityPlus:
        R = self._read_operator(under(arrays, "R"))
        weights = arrays.get("weights")
        if weights is not None and not np.all(checks.finite("weights", weights) > 0.0):
            raise InputError("weights of a stored S are not all positive; they must be")
        solution_error = float(arrays["solution_error"])
        S = IdentityPlus(R, float(arrays["sign"]), weights, solution_error=solution_error)
        S.error_bound = max(solution_error, float(arrays.get("error_bound", solution_error)))
        return S

    def _read_operator(self, arrays: Mapping[str, Any]) -> Operator:
        if str(arrays["kind"]) != "compressed":
            return self._read_core(arrays)
        out = self._read_basis(int(arrays["out"]))
        into = self._read_basis(int(arrays["into"]))
        # The three colours of a sketch of many pixels are multiplied as one.
        is_sketch = isinstance(out, ScaledBasis) and isinstance(into, Hats)
        later = is_sketch and f"system_{COLOURS - 1}.sign" in self._arrays
        return Compressed(
            self._read_core(under(arrays, "core"), later=later),
            out,
            into,
            float(arrays["error"]),
            diagonal=arrays.get("diagonal"),
        )

    def _read_core(self, arrays: Mapping[str, Any], *, later: bool = False) -> Operator:
        kind = str(arrays["kind"])
        if kind not in KINDS:
            raise InputError(
                f"kind of a stored operator is {kind!r}; it must be {', '.join(KINDS)} or "
                "compressed, between bases: compress again"
            )
        if kind == "csr":
            core = CSR.from_arrays(self._device, arrays, self._pattern, later=later)
            # The next channel may share it.
            self._pattern = core.pattern
        else:
            core = KINDS[kind].from_arrays(self._device, arrays)
        error = float(arrays["error"])
        core.error = checks.number("error of a stored operator", error, least=0.0)
        return core

    def _read_basis(self, number: int) -> Basis | None:
        if number == NO_BASIS:
            return None
        if number not in self._bases:
            self._bases[number] = basis_of(self._device, under(self._arrays, f"basis_{number}"))
        return self._bases[number]


def basis_of(device: Device, arrays: Mapping[str, Any]) -> Basis:
    """The basis whose `to_arrays` gave `arrays`; others are refused."""
    missing = sorted({"name", "grid"} - set(arrays))
    if missing:
        raise InputError(f"the arrays of a basis lack {' and '.join(missing)}; compress again")
    name = str(arrays["name"])
    grid = tuple(np.ravel(arrays["grid"]).tolist())
    levels = arrays.get("levels")
    if levels is not None:
        W = Wavelet(device, grid, name, np.asarray(levels).tolist())
    elif name == PATCH_HATS:
        W = PatchHats(device, grid, int(arrays["walls"]), int(arrays["detail"]))
    else:
        W = basis(device, grid, name)
    if "places" in arrays:
        return SubsetBasis(device, grid, arrays["places"], W)
    if W is not None and "scale" in arrays:
        return ScaledBasis(W, arrays["scale"])
    if W is None:
        raise InputError(f"the arrays describe {name}, which is no basis")
    return W


def under(arrays: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """The arrays whose name begins with `prefix` and a point, by the rest of the name."""
    start = f"{prefix}."
    chosen = {}
    for name, array in arrays.items():
        if name.startswith(start):
            chosen[name.removeprefix(start)] = array
    return chosen


def _prefixed(prefix: str, arrays: Mapping[str, np.ndarray]) -> Arrays:
    return {f"{prefix}.{name}": array for name, array in arrays.items()}
