"""Functions of kernels summed over their tables, as numpy arrays.

A kernel is machine code on vectors of eight elements (`lanes`) where a C compiler is found, else
its instructions are calls of numpy on blocks of elements (`vectors`).
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.model.kernel import Group
from soup_nlp.model.lanes import LANES, Summed, compile_lanes
from soup_nlp.model.vectors import Vectors

log = logging.getLogger(__name__)


@dataclass
class Sum:
    """One function of an NLP: what all kernels add to a vector.

    Attributes:
        sizes: Of x, theta and lam_g.
        size: Of the vector.
        terms: A function of a kernel over its table, each.
    """

    sizes: tuple[int, int, int]
    size: int
    terms: list[Summed | Vectors] = field(default_factory=list)

    def __call__(
        self, x: Float, theta: Float, lam_f: float = 1.0, lam_g: Float | None = None
    ) -> Float:
        """The vector (size,) at x; the multipliers are for Hessians.

        Raises:
            ValueError: a vector has another length, which machine code does not see.
        """
        x, theta = _vector("x", x, self.sizes[0]), _vector("theta", theta, self.sizes[1])
        lam_g = lam_g if lam_g is None else _vector("lam_g", lam_g, self.sizes[2])
        # one entry more, for what fills the last block of lanes
        out = np.zeros(self.size + 1)
        for term in self.terms:
            term.add(out, x, theta, lam_f, lam_g)
        return out[:-1]


def _vector(name: str, values: Float, size: int) -> Float:
    """A contiguous vector of a length."""
    if len(values) != size:
        raise ValueError(f"{name} has {len(values)} entries, expected {size}")
    return np.ascontiguousarray(values, dtype=float)


def summed(
    groups: Sequence[Group],
    functions: Sequence[Mapping[str, ca.Function]],
    targets: Sequence[Mapping[str, NDArray[np.integer]]],
    given: tuple[int, int, int],
    sizes: Mapping[str, int],
    compiled: bool,
) -> Mapping[str, Sum]:
    """Sums of kernels' functions by key, evaluated by the fastest way there is.

    Args:
        groups: Kernels and tables.
        functions: Functions of every kernel, by the key of the sum that they belong to.
        targets: (E, k) where each entry of them is added.
        given: Sizes of x, theta and lam_g.
        sizes: Of the sums, by key.
        compiled: Use the C compiler where there is one.

    Raises:
        ModelError: a kernel has an unknown operation.
    """
    sums = {key: Sum(given, size) for key, size in sizes.items()}
    for group, own_functions, own_targets in zip(groups, functions, targets):
        library, blocks = None, None
        if compiled and own_functions:
            # one library per kernel: the cache then still holds the kernels that did not change
            library = compile_lanes(list(own_functions.values()))
            if library is None:
                compiled = False
                log.info(
                    "no machine code: kernels run in numpy, and a solve takes about a third"
                    " longer (a C compiler on the PATH, gcc or clang, is used)"
                )
            else:
                blocks = group.blocks(LANES, np.int32)
        for key, f in own_functions.items():
            target, size = own_targets[key], sizes[key]
            sums[key].terms.append(
                Summed(library, f, blocks, target, size)
                if library and blocks
                else Vectors(f, group, target, size)
            )
    return sums
