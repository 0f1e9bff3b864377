# SPDX-License-Identifier: BSD-3-Clause
"""Bases by name; operators S = I + R and bases as plain arrays, which files hold, and made of such again.

    system_0.sign, .solution_error, .weights    of each channel, .error_bound; weights where S has
    them system_0.R.kind, .error                     "csr", "dense", "tiles" or "compressed"; of
    what was dropped system_0.R.core.kind, ...                   of "compressed", with .out and
    .into: bases, -1 of pixels basis_0.name, ...                           as `Basis.to_arrays` has
    it; one that is shared is there once

Constructors check every size and index, before anything is uploaded.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.operators.base import Operator
from ltcl.operators.bases import Basis, SubsetBasis
from ltcl.operators.compressed import Compressed
from ltcl.operators.csr import CSR, Pattern
from ltcl.operators.dense import Dense
from ltcl.operators.identity_plus import IdentityPlus
from ltcl.operators.tiles import Tiles
from ltcl.operators.wavelets import Wavelet, basis

Arrays = dict[str, np.ndarray]
_CORES = {"csr": CSR, "dense": Dense, "tiles": Tiles}


def to_arrays(systems: Sequence[IdentityPlus]) -> Arrays:
    """The arrays of all channels, as they lie on the device; an R that is not of these kinds is refused."""
    bases: dict[Basis, int] = {}
    arrays: Arrays = {}
    for number, S in enumerate(systems):
        own = {
            name: np.array(getattr(S, name)) for name in ("sign", "solution_error", "error_bound")
        }
        if S.weights is not None:
            own["weights"] = np.asarray(S.weights, np.float64)
        arrays |= _named(f"system_{number}", own | _named("R", _compressed(S.R, bases)))
    for W, number in bases.items():
        arrays |= _named(f"basis_{number}", W.to_arrays())
    return arrays


def from_arrays(device: Device, arrays: Mapping[str, np.ndarray]) -> tuple[IdentityPlus, ...]:
    """The S of all channels, of what `to_arrays` gave; arrays that do not fit each other are refused."""
    bases = functools.cache(
        lambda number: None if number == -1 else basis_of(device, under(arrays, f"basis_{number}"))
    )
    systems, pattern = [], None
    try:
        while f"system_{len(systems)}.sign" in arrays:
            own = under(arrays, f"system_{len(systems)}")
            R, pattern = _read(device, under(own, "R"), bases, pattern)
            weights, error = own.get("weights"), float(own["solution_error"])
            if weights is not None and not np.all(checks.finite("weights", weights) > 0.0):
                raise InputError("weights of a stored S are not all positive; they must be")
            systems.append(IdentityPlus(R, float(own["sign"]), weights, solution_error=error))
            systems[-1].error_bound = max(error, float(own.get("error_bound", error)))
        return tuple(systems)
    except LtclError:
        raise
    except KeyError as error:
        raise InputError(f"the parts of the operators lack {error.args[0]!r}") from None
    except (IndexError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"the parts of the operators do not fit: {str(error)!a:.150}") from None


def _compressed(R: Operator, bases: dict[Basis, int]) -> Arrays:
    if not isinstance(R, Compressed):
        return _core(R)
    own = {"kind": np.array("compressed"), "error": np.array(float(R.error))} | _named(
        "core", _core(R.core)
    )
    for name, W in (("out", R.out), ("into", R.into)):
        own[name] = np.array(-1 if W is None else bases.setdefault(W, len(bases)))
    return own if R.known_diagonal is None else own | {"diagonal": R.known_diagonal}


def _core(A: Any) -> Arrays:
    kind = next((kind for kind, known in _CORES.items() if type(A) is known), None)
    if kind is None:
        raise InputTypeError(f"R holds a {type(A).__name__}, which cannot be kept as arrays")
    return {"kind": np.array(kind), "error": np.array(float(A.error))} | A.to_arrays()


def _read(
    device: Device,
    own: Mapping[str, Any],
    bases: Callable[[int], Basis | None],
    pattern: Pattern | None,
) -> tuple[Operator, Pattern | None]:
    """R, and the pattern of its core, which that of the next channel may share."""
    between = str(own["kind"]) == "compressed"
    inner = under(own, "core") if between else own
    kind = str(inner["kind"])
    if kind not in _CORES:
        raise InputError(
            f"kind of a stored operator is {kind!r}; it must be {', '.join(_CORES)} or compressed, "
            "between bases: compress again"
        )
    shared = (pattern,) if kind == "csr" else ()
    core = _CORES[kind].from_arrays(device, inner, *shared)
    core.error = checks.number("error of a stored operator", float(inner["error"]), least=0.0)
    pattern = core.pattern if isinstance(core, CSR) else pattern
    if not between:
        return core, pattern
    out, into = (bases(int(own[name])) for name in ("out", "into"))
    return Compressed(core, out, into, float(own["error"]), diagonal=own.get("diagonal")), pattern


def _named(prefix: str, arrays: Mapping[str, np.ndarray]) -> Arrays:
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def basis_of(device: Device, arrays: Mapping[str, Any]) -> Basis:
    """The basis whose `to_arrays` gave `arrays`; others are refused."""
    if missing := sorted({"name", "grid"} - set(arrays)):
        raise InputError(f"the arrays of a basis lack {' and '.join(missing)}; compress again")
    name, grid, levels = (
        str(arrays["name"]),
        tuple(np.ravel(arrays["grid"]).tolist()),
        arrays.get("levels"),
    )
    levels = None if levels is None else np.asarray(levels).tolist()
    W = basis(device, grid, name) if levels is None else Wavelet(device, grid, name, levels)
    if "places" in arrays:
        return SubsetBasis(device, grid, arrays["places"], W)
    if W is None:
        raise InputError(f"the arrays describe {name}, which is no basis")
    return W


def under(arrays: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Those whose name begins with `prefix` and a point, without these."""
    start = f"{prefix}."
    return {
        name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)
    }
