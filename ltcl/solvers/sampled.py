# SPDX-License-Identifier: BSD-3-Clause
"""What the methods that draw random numbers share: how their estimates become a `Solution`.

Their noise falls as one over the square root of the samples, so a tolerance is nothing they can promise. The
true residual of what they found is measured with one product; it decides between CONVERGED and SAMPLED.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError, InputTypeError, LtclError, MemoryLimitError
from ltcl.operators.alias import Tables, tables
from ltcl.operators.entrywise import rows_of_R
from ltcl.operators.links import links
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import Rule, System

Result = TypeVar("Result")


@dataclass(frozen=True)
class Channel:
    """A system to be sampled, alone or with those of the other colour channels.

    `x` is where to start, (N,) or (N, k), and `r` its residual; both in the units of `system.b`, which are
    `unit` of the caller's, as `rule` is.
    """

    system: System
    x: Array
    r: Array
    rule: Rule
    unit: np.ndarray


@dataclass(frozen=True)
class Estimate:
    """What a method found, in the units of `system.b`, float64; standard errors where it knows them.

    `x` is (N,) or (N, k), or (P,) or (P, k) where it is of some pixels only and has no residual. `reason`
    tells what was sampled, `met` whether the error that was asked for is, `advice` what else to try.
    """

    x: np.ndarray
    standard_error: np.ndarray | None = None
    iterations: int = 1
    whole: bool = True
    reason: str = ""
    met: bool = True
    advice: str = ""


def solution(
    method: Any, channel: Channel, found: Estimate, in_units: Callable[[np.ndarray], np.ndarray]
) -> Solution:
    """The estimate in the caller's units, with its residual."""
    system, rule = channel.system, channel.rule
    relative, met = np.nan, False
    if found.whole:
        relative, met = _residual(system, gathered(system, found.x, add=False), rule)
    error, converged = found.standard_error, met and found.met
    advice = found.advice if found.met and not converged else ""
    return Solution(
        in_units(found.x),
        Status.CONVERGED if converged else Status.SAMPLED,
        found.iterations,
        system.products,
        (1.0, relative) if found.whole else (np.nan,),
        0.0,
        method.name,
        "; ".join(filter(None, (found.reason, advice))),
        lowest=relative if np.isfinite(relative) else np.inf,  # of x, be it worse than the start
        standard_error=None if error is None else in_units(error),
    )


def tables_of(channels: Sequence[Channel], method: Any) -> tuple[Tables, float]:
    """What walks go over, of one channel or shared by all, and the sign in S = I + sign R."""
    found = [rows_of_R(one.system.S, method.name) for one in channels]
    if len(found) == 1:
        return tables(found[0][0], method.sampler), found[0][1]
    Rs, signs = zip(*found, strict=True)
    return links(Rs, signs, method.sampler), 1.0


def each_alone(method: Any, channels: Sequence[Channel], why: str) -> list[Estimate]:
    """Estimates by walks of each channel's own, where they cannot share them."""
    found = [of_channel(c, method.estimate, [one])[0] for c, one in enumerate(channels)]
    why = f"channels share no walks: {why}"
    return [dataclasses.replace(one, reason="; ".join(filter(None, (one.reason, why)))) for one in found]


def of_channel(channel: int, f: Callable[..., Result], *given: Any, **named: Any) -> Result:
    """f(...) of one channel of several; its refusals say of which.

    >>> of_channel(2, checks.count, "samples", 0)
    Traceback (most recent call last):
    ltcl.errors.InputError: in channel 2: samples is 0; it must be a whole number of at least 1
    """
    try:
        return f(*given, **named)
    except (InputError, MemoryLimitError) as error:
        raise type(error)(f"in channel {channel}: {error}") from None


def cause(error: LtclError) -> str:
    """Why walks were refused, without the advice behind the last semicolon.

    >>> cause(InputError("albedo is 0.45; their variance is infinite; leave albedo out"))
    'albedo is 0.45; their variance is infinite'
    >>> cause(InputError("samples is 3; noise grows: samples= must be 5 at least"))
    'samples is 3; noise grows: samples= must be 5 at least'
    """
    *said, _ = str(error).split("; ")
    return "; ".join(said) if said and not re.fullmatch(r"\w+ is \S+", said[-1]) else str(error)


def side_by_side(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """(N,) or (N, k) of each channel as the right-hand sides of walks that they share.

    >>> side_by_side([np.array([[1, 2]]), np.array([[3, 4]]), np.array([[5, 6]])]).tolist()
    [[1, 3, 5, 2, 4, 6]]
    """
    return np.stack(arrays, axis=-1).reshape(len(arrays[0]), -1)


def each(found: np.ndarray, channels: Sequence[Channel]) -> list[np.ndarray]:
    """What was `side_by_side`, of some pixels, one array a channel."""
    columns = channels[0].r.shape[1:]
    return list(np.moveaxis(found.reshape(len(found), *columns, len(channels)), -1, 0))


def numbered(callback: Callable[[int, float], object] | None) -> Callable[[int, float], object] | None:
    """A callback that is told of its calls in order, 0, 1, ...; of several beginnings the first alone."""
    if callback is None:
        return None
    heard: list[float] = []

    def told(step: int, residual: float) -> None:
        if step or not heard:
            heard.append(residual)
            callback(len(heard) - 1, residual)

    return told


def watch(channels: Sequence[Channel]) -> Callable[[], object]:
    """Tell the callback that sampling begins; what comes back tells of each step, as NaN."""
    callback, steps = channels[0].rule.callback, itertools.count(1)
    if callback is None:
        return lambda: None
    callback(0, 1.0)
    return lambda: callback(next(steps), np.nan)


def gathered(system: System, x: np.ndarray, *, add: bool = True) -> np.ndarray:
    """Final gather, x + (b - S x) = b - R x, one exact product; or b - S x alone. float64."""
    on_device = system.S.device.upload(x)
    r = system.residual(on_device, on_device.like()).get().astype(np.float64)
    return on_device.get() + r if add else r


def _residual(system: System, r: np.ndarray, rule: Rule) -> tuple[float, bool]:
    norms, left = vectors.norm(system.b), np.linalg.norm(r, axis=0)
    relative = float(np.max(left / np.where(norms > 0, norms, 1.0)))
    return relative, bool(np.all(left <= np.maximum(rule.rtol * norms, rule.atol)))


def within_float32(estimates: np.ndarray) -> np.ndarray:
    """Return what was sampled; refuse what has grown beyond float32, or is NaN."""
    if not np.all(np.abs(estimates) <= np.finfo(np.float32).max):
        raise InputError("what was sampled has grown beyond float32; rescale, or use method='chebyshev'")
    return estimates


def check_whole(options: dict[str, Any]) -> None:
    """Refuse, where a task needs whole pictures, to estimate some pixels only."""
    if "pixels" in options:
        raise InputTypeError("pixels= gives some pixels alone; a picture needs all: leave it out")


def check_method(method: str, options: Iterable[str], those: Collection[str]) -> None:
    """Refuse options of `those` methods that sample, for one that does not."""
    for name in options:
        if name in ("samples", "seed") and method not in those:
            raise InputTypeError(
                f"unknown option {name!r}: method {method!r} does not sample; {' and '.join(those)} do"
            )


def check_seed(seed: Any) -> None:
    """Refuse a seed that does not fit into 64 bits."""
    if checks.count("seed", seed, least=0) >= 1 << 64:
        raise InputError(f"seed is {seed}; it must be below 2^64")


def check_samples(samples: Any) -> None:
    """Refuse a number of samples that 32 bits cannot count."""
    if checks.count("samples", samples) >= 1 << 32:
        raise InputError(f"samples is {samples}; it must be below 2^32")
