# SPDX-License-Identifier: BSD-3-Clause
"""Operators S = I + R as plain arrays by name, and made of such again: what files hold of compressed ones.

    system_0.sign, .solution_error, .weights    of each channel; weights where S has them
    system_0.R.kind                             "csr", "dense", "tiles", "compressed" or "sum"
    system_0.R.error                            of what was dropped
    system_0.R.core.kind, ...                   of "compressed", with .out and .into: bases, -1 of pixels
    system_0.R.part_0.kind, ...                 of "sum"
    basis_0.name, ...                           as `Basis.to_arrays` has it; one that is shared is there once

Nothing is believed that these say: constructors check every size and index, before anything is uploaded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.operators.base import Operator
from ltcl.operators.bases import Basis
from ltcl.operators.composed import IdentityPlus
from ltcl.operators.compressed import Compressed, Sum
from ltcl.operators.csr import CSR, Pattern
from ltcl.operators.dense import Dense
from ltcl.operators.named_bases import basis_of
from ltcl.operators.tiles import Tiles

Arrays = dict[str, np.ndarray]
_KINDS = {"csr": CSR, "dense": Dense, "tiles": Tiles, "compressed": Compressed, "sum": Sum}
_DEEPEST = 4  # sums within sums


def to_arrays(systems: Sequence[IdentityPlus]) -> Arrays:
    """The arrays of all channels, as they lie on the device.

    Raises
    ------
    InputTypeError
        An R that is not made of cores, bases and sums of such.
    """
    bases: list[Basis] = []
    found: Arrays = {}
    for number, S in enumerate(systems):
        own = {"sign": np.array(S.sign), "solution_error": np.array(S.solution_error)}
        if S.weights is not None:
            own["weights"] = np.asarray(S.weights, np.float64)
        found |= _named(f"system_{number}", own | _named("R", _operator(S.R, bases)))
    for number, W in enumerate(bases):
        found |= _named(f"basis_{number}", W.to_arrays())
    return found


def from_arrays(device: Device, arrays: Mapping[str, np.ndarray]) -> tuple[IdentityPlus, ...]:
    """The S of all channels, of what `to_arrays` gave.

    Raises
    ------
    InputError
        Arrays that are missing, or do not fit each other.
    MemoryLimitError
        More than the device holds.

    Examples
    --------
    >>> import ltcl
    >>> device = ltcl.open_device()
    >>> S = IdentityPlus(Dense(device, [[0.0, 0.5], [0.5, 0.0]]), solution_error=0.01)
    >>> (again,) = from_arrays(device, to_arrays([S]))
    >>> again.to_dense().tolist(), again.solution_error
    ([[1.0, 0.5], [0.5, 1.0]], 0.01)
    """
    try:
        return _Reader(device, arrays).systems()
    except LtclError:
        raise
    except KeyError as error:
        raise InputError(f"the parts of the operators lack {error.args[0]!r}") from None
    except (IndexError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"the parts of the operators do not fit: {str(error)!a:.150}") from None


def _operator(A: Operator, bases: list[Basis]) -> Arrays:
    kind = next((kind for kind, known in _KINDS.items() if type(A) is known), None)
    if kind is None:
        raise InputTypeError(f"R holds a {type(A).__name__}, which cannot be kept as arrays")
    own: Arrays = {"kind": np.array(kind), "error": np.array(float(A.error))}
    if isinstance(A, Compressed):
        own |= {"out": np.array(_number(A.out, bases)), "into": np.array(_number(A.into, bases))}
        if A.known_diagonal is not None:
            own["diagonal"] = A.known_diagonal
        return own | _named("core", _operator(A.core, bases))
    if isinstance(A, Sum):
        for place, part in enumerate(A.operators):
            own |= _named(f"part_{place}", _operator(part, bases))
        return own
    assert isinstance(A, CSR | Dense | Tiles)  # noqa: S101 - the other kinds
    return own | A.to_arrays()


def _number(W: Basis | None, bases: list[Basis]) -> int:
    """The place of a basis among those to be kept, -1 of pixels."""
    if W is None:
        return -1
    if not any(W is other for other in bases):
        bases.append(W)
    return next(place for place, other in enumerate(bases) if other is W)


class _Reader:
    """Makes operators of arrays; bases and patterns that channels share are made once."""

    def __init__(self, device: Device, arrays: Mapping[str, np.ndarray]) -> None:
        self.device, self.arrays = device, arrays
        self._bases: dict[int, Basis] = {}
        self._pattern: Pattern | None = None

    def systems(self) -> tuple[IdentityPlus, ...]:
        count = 0
        while f"system_{count}.sign" in self.arrays:
            count += 1
        return tuple(self._system(_under(self.arrays, f"system_{number}")) for number in range(count))

    def _system(self, own: Mapping[str, np.ndarray]) -> IdentityPlus:
        R, weights = self._operator(_under(own, "R")), own.get("weights")
        if weights is not None and not np.all(checks.finite("weights", weights) > 0.0):
            raise InputError("weights of a stored S are not all positive; they must be")
        sign, error = float(own["sign"]), float(own["solution_error"])
        return IdentityPlus(R, sign, weights, solution_error=error)

    def _operator(self, own: Mapping[str, np.ndarray], depth: int = 0) -> Operator:
        kind = checks.one_of("kind of a stored operator", str(own["kind"]), _KINDS)
        if depth > _DEEPEST:
            raise InputError(f"operators are nested more than {_DEEPEST} deep")
        error = checks.number("error of a stored operator", float(own["error"]), least=0.0)
        if kind == "compressed":
            core = self._operator(_under(own, "core"), depth + 1)
            out, into = (self._basis(int(own[name])) for name in ("out", "into"))
            return Compressed(core, out, into, error, diagonal=own.get("diagonal"))
        if kind == "sum":
            names = sorted({name.split(".")[0] for name in own if name.startswith("part_")}, key=_trailing)
            return Sum(*(self._operator(_under(own, name), depth + 1) for name in names))
        found = self._core(kind, own)
        found.error = error
        return found

    def _core(self, kind: str, own: Mapping[str, np.ndarray]) -> Operator:
        if kind == "csr":
            found = CSR.from_arrays(self.device, own, self._pattern)
            self._pattern = found.pattern
            return found
        return (Dense if kind == "dense" else Tiles).from_arrays(self.device, own)

    def _basis(self, number: int) -> Basis | None:
        if number == -1:
            return None
        if number not in self._bases:
            self._bases[number] = basis_of(self.device, _under(self.arrays, f"basis_{number}"))
        return self._bases[number]


def _named(prefix: str, arrays: Mapping[str, np.ndarray]) -> Arrays:
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def _under(arrays: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    start = f"{prefix}."
    return {name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)}


def _trailing(name: str) -> int:
    return int(name.rpartition("_")[2])
