"""Readable names of variables and rows: `R[17,2,1]`, `so3[17,3]`, `epigraph_gap_ref[17,23]`."""

from __future__ import annotations

import numpy as np

from soup_nlp.arrays import Int
from soup_nlp.export.nl import OF, Suffix
from soup_nlp.model.kernel import Group
from soup_nlp.model.layout import MatrixLayout, TangentLayout
from soup_nlp.model.nlp import NLP


def readable_names(nlp: NLP, layout: MatrixLayout | TangentLayout) -> tuple[list[str], list[str]]:
    """Unique names of variables and constraints of an exported NLP.

    The first index is the superpixel; for an edge or a neighbour pair the first two indices are the
    two superpixels. A further index counts from 1: the rows of R'R = I in the order 11 12 22 13 23
    33, rim rays (in matrix coordinates 1 is the anchor), or sampled pixels.
    """
    x_names, g_names = nlp.x_names(), nlp.g_names()
    for group in nlp.groups:
        table, kernel = group.table, group.kernel
        owner = _owners(group, layout)
        if owner is None:
            continue
        labels = _labels(owner)
        for j in np.flatnonzero(table.index[0] >= layout.size):
            name = kernel.x[int(j)].name()
            for k, label in zip(table.index[:, j].tolist(), labels):
                x_names[k] = f"{name}[{label}]"
        if not kernel.nc:
            continue
        repeated = len(np.unique(table.rows)) < table.rows.size
        for c in range(kernel.nc):
            for k, label in zip(table.rows[:, c].tolist(), labels):
                stem = g_names[k].partition("[")[0]
                if repeated:
                    g_names[k] = stem
                elif stem.startswith("epigraph") or kernel.nc == 1:
                    g_names[k] = f"{stem}[{label}]"
                else:
                    g_names[k] = f"{stem}[{label},{c + 1}]"
    return x_names, g_names


def suffixes_of(
    nlp: NLP, names: tuple[list[str], list[str]]
) -> tuple[dict[str, list[str]], list[Suffix]]:
    """Suffixes of variables and rows, for solvers that exploit structure.

    "superpixel" is 1 + the first superpixel of a variable or row. "kind" is 1 + the place of its
    name's stem (`R`, `so3`) in the lists that are returned beside. "scaling_factor" is the inverse
    of a natural step of a variable at the start (Ipopt's `nlp_scaling_method=user-scaling`).

    Args:
        nlp: The program.
        names: From `readable_names`.
    """
    kinds: dict[str, list[str]] = {}
    out = []
    for of, own in zip(OF, names):
        stems = [name.partition("[")[0] for name in own]
        kinds[of] = list(dict.fromkeys(stems))
        place = {stem: k + 1 for k, stem in enumerate(kinds[of])}
        first = [name.partition("[")[2].strip("]").partition(",")[0] for name in own]
        out.append(Suffix("kind", of, np.array([place[stem] for stem in stems])))
        out.append(Suffix("superpixel", of, np.array([int(i) + 1 if i else 0 for i in first])))
    for group in nlp.groups:
        if group.kernel.name == "ridge":
            factor = np.ones(nlp.nx)
            factor[group.table.index[:, 0]] = np.sqrt(group.table.data[:, 0])
            out.append(Suffix("scaling_factor", OF[0], factor))
    return kinds, out


def _owners(group: Group, layout: MatrixLayout | TangentLayout) -> Int | None:
    """(E, 1 or 2) superpixels of each element; None if it has no variables of superpixels."""
    index = group.table.index
    own = index < layout.count * layout.stride
    if group.kernel.name == "ridge" or not own[:, 0].all():
        return None
    superpixel = np.where(own, index // layout.stride, index[:, :1] // layout.stride)
    first = superpixel[:, 0]
    second = np.where(superpixel == first[:, None], -1, superpixel).max(axis=1)
    return np.column_stack([first, second]) if (second >= 0).all() else first[:, None]


def _labels(owner: Int) -> list[str]:
    """Labels `i` or `i,k`; `i,3` for the third of several elements of a superpixel."""
    own = [",".join(map(str, row)) for row in owner.tolist()]
    if len(set(own)) == len(own):
        return own
    seen: dict[str, int] = {}
    out = []
    for label in own:
        seen[label] = seen.get(label, 0) + 1
        out.append(f"{label},{seen[label]}")
    return out
