"""Functions of kernels summed over their tables, as numpy arrays.

A kernel is machine code on vectors of eight elements (`lanes`) where a C compiler is found, else
its instructions are calls of numpy on blocks of elements (`vectors`).
"""

import logging
from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.model.kernel import Group
from soup_nlp.model.lanes import LANES, Summed, compile_lanes
from soup_nlp.model.vectors import Vectors

log = logging.getLogger(__name__)


Terms = Mapping[str, list[Summed | Vectors]]
"""Functions of kernels, each over its table, by the sum that they belong to."""


def summed(
    groups: Sequence[Group],
    functions: Sequence[Mapping[str, ca.Function]],
    targets: Sequence[Mapping[str, NDArray[np.integer]]],
    sizes: Mapping[str, int],
    compiled: bool,
) -> Terms:
    """Terms of the sums of kernels' functions, evaluated by the fastest way there is.

    Args:
        groups: Kernels and tables.
        functions: Functions of every kernel, by the key of the sum that they belong to.
        targets: (E, k) where each entry of them is added.
        sizes: Of the sums, by key.
        compiled: Use the C compiler where there is one.

    Raises:
        ModelError: a kernel has an unknown operation.
    """
    sums: dict[str, list[Summed | Vectors]] = {key: [] for key in sizes}
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
            sums[key].append(
                Summed(library, f, blocks, target, size)
                if library and blocks
                else Vectors(f, group, target, size)
            )
    return sums
