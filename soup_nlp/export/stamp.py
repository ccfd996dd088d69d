"""Templates stamped over their tables: texts of objective and rows, and defined variables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from soup_nlp.errors import ExportError
from soup_nlp.export.template import DEFINED, NUMBER, VARIABLE, Template, Text

Float = NDArray[np.float64]
Int = NDArray[np.int64]

NOWHERE = np.iinfo(np.int64).max


@dataclass
class _Node:
    """One defined node of a template with the identity that each element's instance has."""

    text: Text
    stamp: Stamp
    identity: Int
    fresh: Int


@dataclass
class Stamp:
    """A template on its table.

    Attributes:
        template: Text with holes.
        index: (E, nx) variable in the file of every local one.
        identity: Identities (E,) of the instances of each defined node.
    """

    template: Template
    index: Int
    identity: dict[int, Int] = field(default_factory=dict)

    def columns(self, text: Text, elements: Int | slice, final: Int | None = None) -> list[Int]:
        """Integers that fill the holes of a text: variables, defined variables, bits of numbers."""
        out = []
        for kind, number in text.holes:
            if kind == VARIABLE:
                column = self.index[elements, number]
            elif kind == DEFINED:
                column = self.identity[number][elements]
                column = column if final is None else final[column]
            else:
                column = np.ascontiguousarray(self.template.numbers[number], float)
                column = column.view(np.int64)[elements]
            out.append(column)
        return out

    def write(self, text: Text, elements: Int | slice, final: Int) -> list[str]:
        """The text of elements, defined variables numbered by `final`."""
        columns: list[list[object]] = []
        for (kind, _), column in zip(text.holes, self.columns(text, elements, final)):
            if kind == NUMBER:
                columns.append(list(map(repr, column.view(np.float64).tolist())))
            else:
                columns.append(column.tolist())
        if not columns:
            return [text.pattern] * len(np.arange(len(self.index))[elements])
        return [text.pattern % values for values in zip(*columns)]


class Defined:
    """Defined variables of all templates: equal instances are one, wherever they occur.

    Two instances are equal when their text is: the same operations on the same variables, numbers
    and defined variables.
    """

    def __init__(self) -> None:
        self._known: dict[str, dict[bytes, int]] = {}
        self._nodes: list[_Node] = []
        self.count = 0

    def register(self, stamp: Stamp) -> None:
        """Give every instance of the template's defined nodes its identity."""
        size = len(stamp.index)
        for node, text in stamp.template.defined:
            known = self._known.setdefault(text.pattern, {})
            columns = stamp.columns(text, slice(None))
            blob = np.stack(columns, axis=1).tobytes()
            width = 8 * len(columns)
            begin, identity = self.count, np.empty(size, np.int64)
            for e in range(size):
                key = blob[e * width : (e + 1) * width]
                place = known.get(key)
                if place is None:
                    known[key] = place = self.count
                    self.count += 1
                identity[e] = place
            stamp.identity[node] = identity
            # first element of every new identity, in the order of the identities
            new, fresh = np.unique(identity, return_index=True)
            self._nodes.append(_Node(text, stamp, identity, fresh[new >= begin]))

    def users(self, uses: Iterator[tuple[Int, Int]]) -> tuple[Int, Int, NDArray[np.bool_]]:
        """Who needs each defined variable, directly or through others.

        Args:
            uses: (identities, constraint rows or -1 for the objective) of direct uses.

        Returns:
            Smallest and largest constraint row (NOWHERE, -1 for none) and use in the objective.
        """
        low, high = np.full(self.count, NOWHERE), np.full(self.count, -1)
        objective = np.zeros(self.count, bool)
        for identity, row in uses:
            inside = row < 0
            objective[identity[inside]] = True
            np.minimum.at(low, identity[~inside], row[~inside])
            np.maximum.at(high, identity[~inside], row[~inside])
        # a node is visited after everything that uses it
        for node in reversed(self._nodes):
            for kind, number in node.text.holes:
                if kind == DEFINED:
                    parent, child = node.identity, node.stamp.identity[number]
                    np.logical_or.at(objective, child, objective[parent])
                    np.minimum.at(low, child, low[parent])
                    np.maximum.at(high, child, high[parent])
        return low, high, objective

    def texts(self, final: Int) -> list[str]:
        """Prefix text of every defined variable, by identity."""
        out: list[str] = []
        for node in self._nodes:
            out += node.stamp.write(node.text, node.fresh, final)
        if len(out) != self.count:
            raise ExportError("defined variables were lost", found=len(out), expected=self.count)
        return out
