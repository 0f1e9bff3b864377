# SPDX-License-Identifier: BSD-3-Clause
"""All that is known of one operator: norms, numbers in float64, and what solvers learnt of it.

Every operator keeps one `Knowledge` as `known`, which lives as long as the operator. Nothing in it
may refer to that operator: device memory is freed by reference counting alone.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse

if TYPE_CHECKING:
    from ltcl.operators.base import Operator

Product = Callable[[np.ndarray], np.ndarray]  # (N, k) float64 -> (M, k) float64

# Smaller divisors have reciprocals near the end of the range of float64.
MIN_DIVISOR = 1e-300


class Norms(NamedTuple):
    """Norms of a matrix, and its smallest entry where one is negative, else 0."""

    one: float
    inf: float
    frobenius: float
    lowest: float


class NormBound(NamedTuple):
    """The size of an operator: a bound on the 2-norm of |A|, entry by entry, or an estimate."""

    value: float
    is_bound: bool


class RowSumRange(NamedTuple):
    """The least, the mean and the largest row sum of an operator."""

    least: float
    mean: float
    largest: float


@dataclass(frozen=True, kw_only=True)
class Float64Form:
    """matrix diag(scale) + diag(shift): the numbers of an operator (M, N) in float64 on the host.

    `matrix` is an array, a csr_array, or an operator that multiplies on the host in float64 by
    `product` and `to_dense`. `scale` and `shift` are numbers or (N,).
    """

    matrix: Any
    scale: Any = 1.0
    shift: Any = 0.0

    @classmethod
    def from_quotient(cls, matrix: Any, divisor: np.ndarray, removed: Any) -> Float64Form | None:
        """The form matrix / divisor - diag(removed); None if a divisor has no reciprocal."""
        if np.any(np.abs(divisor) <= MIN_DIVISOR):
            return None
        # 0.0 - x: a negative of booleans is refused by NumPy.
        return cls(matrix=matrix, scale=1.0 / divisor, shift=0.0 - removed)

    def scaled(self, scale: Any, shift: Any) -> Float64Form:
        """The form of A diag(scale) + diag(shift), where this is that of A."""
        return Float64Form(
            matrix=self.matrix,
            scale=self.scale * scale,
            shift=self.shift * scale + shift,
        )

    def product(self) -> Product:
        """The function x -> A x in float64."""
        multiply = getattr(self.matrix, "product", self.matrix.__matmul__)
        scale = np.reshape(self.scale, (-1, 1))
        shift = np.reshape(self.shift, (-1, 1))

        def product(x: np.ndarray) -> np.ndarray:
            result = multiply(scale * x).astype(np.float64)
            # Only a square operator has a shift.
            return result + shift * x if np.any(shift) else result

        return product

    def to_dense(self) -> np.ndarray:
        """The matrix (N, N) in float64."""
        matrix = self.matrix
        if scipy.sparse.issparse(matrix):
            matrix = matrix.toarray()
        elif not isinstance(matrix, np.ndarray):
            matrix = matrix.to_dense()
        dense = np.multiply(matrix, self.scale, dtype=np.float64)
        dense[np.diag_indices(len(dense))] += self.shift
        return dense


@dataclass(kw_only=True)
class Knowledge:
    """Facts about one operator that are found once in its life, each None until then.

    Attributes
    ----------
    row_sums : (M,) float32
    row_sum_range : RowSumRange
    norm_bound : NormBound
    float64_form : Float64Form
        Kept where a product by it is cheap.
    survey : ltcl.solvers.survey.Survey
        What three steps of GMRES show of the spectrum.
    was_tried : bool
        Whether "auto" has tried a method without a survey.
    factorization : ltcl.solvers.direct.Factorization
    coefficient_system : Operator
        The same system between the coefficients of its basis.
    joined : tuple
        Weak references to the systems of all colours, of which it is the first, and all as one.
    colour_rows : tuple
        The same for the matrices of all colours of a sketch, and their entries as one.
    relaxations : dict
        Block inverses and windows of `ltcl.operators.relaxation`.
    walk_tables : dict
        Alias tables of `ltcl.operators.walks`.
    is_quicker_in_shares : dict
        By columns: whether vectors are better kept in shares of several devices than on one.
    transposed : Knowledge
        Facts about the transpose, of which each use makes a new operator.
    """

    row_sums: np.ndarray | None = None
    row_sum_range: RowSumRange | None = None
    norm_bound: NormBound | None = None
    float64_form: Float64Form | None = None
    survey: Any = None
    was_tried: bool = False
    factorization: Any = None
    coefficient_system: Operator | None = None
    joined: tuple[tuple[weakref.ref[Operator], ...], Operator] | None = None
    colour_rows: tuple[tuple[weakref.ref[Operator], ...], Any] | None = None
    relaxations: dict[tuple[Any, ...], Any] = field(default_factory=dict)
    walk_tables: dict[str, Any] = field(default_factory=dict)
    is_quicker_in_shares: dict[int, bool] = field(default_factory=dict)
    transposed: Knowledge | None = None
