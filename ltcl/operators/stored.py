# SPDX-License-Identifier: BSD-3-Clause
"""Bases by name; operators S = I + R and bases as plain arrays, which files hold, and made of such again.

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
from ltcl.operators.bases import Basis, Chained, SubsetBasis
from ltcl.operators.composed import Compressed, IdentityPlus, Sum
from ltcl.operators.csr import CSR, Pattern
from ltcl.operators.dense import Dense
from ltcl.operators.pyramid import Pyramid
from ltcl.operators.tiles import Tiles
from ltcl.operators.wavelets import Wavelet, families, is_known

Arrays = dict[str, np.ndarray]
_CORES = {"csr": CSR, "dense": Dense, "tiles": Tiles}
_KINDS = {**_CORES, "compressed": Compressed, "sum": Sum}
_DEEPEST = 4  # sums within sums


def to_arrays(systems: Sequence[IdentityPlus]) -> Arrays:
    """The arrays of all channels, as they lie on the device; an R that is not of these kinds is refused."""
    bases: dict[Basis, int] = {}
    arrays: Arrays = {}
    for number, S in enumerate(systems):
        own = {"sign": np.array(S.sign), "solution_error": np.array(S.solution_error)}
        if S.weights is not None:
            own["weights"] = np.asarray(S.weights, np.float64)
        arrays |= _named(f"system_{number}", own | _named("R", _operator(S.R, bases)))
    for W, number in bases.items():
        arrays |= _named(f"basis_{number}", W.to_arrays())
    return arrays


def from_arrays(device: Device, arrays: Mapping[str, np.ndarray]) -> tuple[IdentityPlus, ...]:
    """The S of all channels, of what `to_arrays` gave; arrays that do not fit each other are refused.

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


def _operator(A: Operator, bases: dict[Basis, int]) -> Arrays:
    kind = next((kind for kind, known in _KINDS.items() if type(A) is known), None)
    if kind is None:
        raise InputTypeError(f"R holds a {type(A).__name__}, which cannot be kept as arrays")
    own: Arrays = {"kind": np.array(kind), "error": np.array(float(A.error))}
    if isinstance(A, Compressed):
        for name, W in (("out", A.out), ("into", A.into)):
            own[name] = np.array(-1 if W is None else bases.setdefault(W, len(bases)))
        if A.known_diagonal is not None:
            own["diagonal"] = A.known_diagonal
        return own | _named("core", _operator(A.core, bases))
    if isinstance(A, Sum):
        for place, part in enumerate(A.operators):
            own |= _named(f"part_{place}", _operator(part, bases))
        return own
    return own | A.to_arrays()  # pyright: ignore[reportAttributeAccessIssue] - the other kinds have it


class _Reader:
    """Makes operators of arrays; bases and patterns that channels share are made once."""

    def __init__(self, device: Device, arrays: Mapping[str, np.ndarray]) -> None:
        self.device, self.arrays = device, arrays
        self._bases: dict[int, Basis | None] = {-1: None}
        self._pattern: Pattern | None = None

    def systems(self) -> tuple[IdentityPlus, ...]:
        found = []
        while f"system_{len(found)}.sign" in self.arrays:
            own = under(self.arrays, f"system_{len(found)}")
            R, weights = self._operator(under(own, "R")), own.get("weights")
            if weights is not None and not np.all(checks.finite("weights", weights) > 0.0):
                raise InputError("weights of a stored S are not all positive; they must be")
            error = float(own["solution_error"])
            found.append(IdentityPlus(R, float(own["sign"]), weights, solution_error=error))
        return tuple(found)

    def _operator(self, own: Mapping[str, np.ndarray], depth: int = 0) -> Operator:
        kind = checks.one_of("kind of a stored operator", str(own["kind"]), _KINDS)
        if depth > _DEEPEST:
            raise InputError(f"operators are nested more than {_DEEPEST} deep")
        error = checks.number("error of a stored operator", float(own["error"]), least=0.0)
        if kind == "compressed":
            core = self._operator(under(own, "core"), depth + 1)
            out, into = (self._basis(int(own[name])) for name in ("out", "into"))
            return Compressed(core, out, into, error, diagonal=own.get("diagonal"))
        if kind == "sum":
            names = {name.partition(".")[0] for name in own if name.startswith("part_")}
            names = sorted(names, key=lambda name: int(name.removeprefix("part_")))
            return Sum(*(self._operator(under(own, name), depth + 1) for name in names))
        shared = (self._pattern,) if kind == "csr" else ()
        core = _CORES[kind].from_arrays(self.device, own, *shared)
        self._pattern = core.pattern if isinstance(core, CSR) else self._pattern
        core.error = error
        return core

    def _basis(self, number: int) -> Basis | None:
        if number not in self._bases:
            self._bases[number] = basis_of(self.device, under(self.arrays, f"basis_{number}"))
        return self._bases[number]


def _named(prefix: str, arrays: Mapping[str, np.ndarray]) -> Arrays:
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def basis(device: Device, grid: tuple[int, int], name: str) -> Basis | None:
    """The basis called `name` of pictures of h x w pixels.

    Parameters
    ----------
    device : Device
    grid : (h, w)
    name : str
        "pixels" (None: no basis is needed), "pyramid", or an orthonormal wavelet of PyWavelets: "haar",
        "db2", "db4", ...

    Raises
    ------
    InputError
        Another name, or a wavelet that is not orthonormal.

    Examples
    --------
    >>> import ltcl
    >>> from ltcl.operators import basis
    >>> basis(ltcl.open_device(), (8, 8), "db2").orthonormal
    True
    """
    if name == "pixels":
        return None
    if name == "pyramid":
        return Pyramid(device, grid)
    if not is_known(name):
        wavelets = f"an orthonormal wavelet ({families()})"
        raise InputError(f"basis is {name!r}; it must be pixels, pyramid or {wavelets}")
    return Wavelet(device, grid, name)


def basis_of(device: Device, arrays: Mapping[str, Any]) -> Basis:
    """The basis whose `to_arrays` gave `arrays`; others are refused."""
    outer, inner = under(arrays, "outer"), under(arrays, "inner")
    if outer or inner:
        return Chained(basis_of(device, outer), basis_of(device, inner))
    if missing := sorted({"name", "grid"} - set(arrays)):
        raise InputError(f"the arrays of a basis lack {' and '.join(missing)}")
    name, grid = str(arrays["name"]), tuple(np.ravel(arrays["grid"]).tolist())
    places = arrays.get("places", arrays.get("order"))  # as files of version 0.1.0 have permutations
    if places is not None:
        return SubsetBasis(device, grid, places, name)
    if "levels" in arrays:
        return Wavelet(device, grid, name, np.asarray(arrays["levels"]).tolist())
    found = basis(device, grid, name)
    if found is None:
        raise InputError(f"the arrays describe {name}, which is no basis")
    return found


def under(arrays: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Those whose name begins with `prefix` and a point, without these."""
    start = f"{prefix}."
    return {name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)}
