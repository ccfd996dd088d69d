"""The `V`, `C` and `O` segments of a .nl file: templates filled in for every element.

A lifted file has a variable and a row, `expression - variable = 0`, in the place of every defined
variable; they precede the others. SCIP expands defined variables a hundredfold, but not these.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from soup_nlp.arrays import Float, Int
from soup_nlp.export.program import Program
from soup_nlp.export.template import DEFINED, NUMBER, VARIABLE, Template, Text, number, plus


@dataclass
class _Part:
    """A template with its table, in the numbering of the file.

    Attributes:
        template: Texts with holes.
        index: (E, nx) variable of the file for every local variable.
        goal: (E, m) row of the file of every output.
        identity: (E,) numbers of the instances of each defined node.
    """

    template: Template
    index: Int
    goal: Int
    identity: dict[int, Int] = field(default_factory=dict)

    def columns(self, text: Text, elements: Int | slice, final: Int | None = None) -> list[Int]:
        """Integers for the holes of a text: variables, defined variables, bits of numbers."""
        out = []
        for kind, slot in text.holes:
            if kind == VARIABLE:
                column = self.index[elements, slot]
            elif kind == DEFINED:
                column = self.identity[slot][elements]
                column = column if final is None else final[column]
            else:
                values = np.ascontiguousarray(self.template.graph.number[slot], float)
                column = values.view(np.int64)[elements]
            out.append(column)
        return out

    def write(self, text: Text, elements: Int | slice, final: Int, shift: int) -> list[str]:
        """Texts of elements; `final` are the numbers of defined variables in the file, `shift` is
        that of the first of the others."""
        columns: list[list[object]] = []
        for (kind, _), column in zip(text.holes, self.columns(text, elements, final)):
            if kind == NUMBER:
                columns.append(list(map(repr, column.view(np.float64).tolist())))
            else:
                columns.append((column + shift * (kind == VARIABLE)).tolist())
        if not columns:
            return [text.pattern] * len(np.arange(len(self.index))[elements])
        return [text.pattern % values for values in zip(*columns)]


class NlBody:
    """Expressions of a program.

    Two instances of defined nodes share one defined variable when their text is equal: the same
    operations on the same variables, numbers and defined variables, in any template.

    Attributes:
        classes: Defined variables by use: both, constraints, objective (several), one constraint,
            the objective alone.
        lifted: Variables, and rows, that stand before the others.
    """

    def __init__(self, program: Program, column: Int, row: Int, lift: bool = False) -> None:
        """Number the defined variables; `column` (nx,) and `row` (ng,) are indices in the file, and
        with `lift` variables with rows are written instead."""
        # the objective is the last row
        last, goals = len(row), np.append(row, len(row))
        self._program, self._row = program, goals
        self._known: dict[str, dict[bytes, int]] = {}
        self._count = 0
        self._nodes: list[tuple[_Part, int, Text, Int]] = []
        self._parts = []
        for template, index, goal in program.stamped:
            part = _Part(template, column[index], goals[goal])
            for node, text in template.defined:
                self._identify(part, node, text)
            self._parts.append(part)
        low, high = self._users()
        kind = np.select([low == last, low == high, high == last], [4, 3, 0], 1)
        # a variable with one user is written before its row
        owner = np.where(kind < 3, last, low)
        self._order = np.lexsort((np.arange(len(kind)), owner, kind))
        self._owner = owner[self._order]
        self._shared = int((kind < 3).sum())
        self.lifted = self._count if lift else 0
        self._first = 0 if lift else len(column)
        self._final = self._first + np.argsort(self._order)
        b, c, o, c1, o1 = (0 if lift else int((kind == k).sum()) for k in range(5))
        self.classes = (b, c, o, c1, o1)

    def _identify(self, part: _Part, node: int, text: Text) -> None:
        """Number the instances of a defined node; instances with equal text share a number."""
        known = self._known.setdefault(text.pattern, {})
        columns = part.columns(text, slice(None))
        blob, width = np.stack(columns, axis=1).tobytes(), 8 * len(columns)
        begin, identity = self._count, np.empty(len(part.index), np.int64)
        for e in range(len(identity)):
            number = known.setdefault(blob[e * width : (e + 1) * width], self._count)
            self._count += number == self._count
            identity[e] = number
        part.identity[node] = identity
        # first element of every new number, in order
        new, first = np.unique(identity, return_index=True)
        self._nodes.append((part, node, text, first[new >= begin]))

    def _users(self) -> tuple[Int, Int]:
        """First and last row that uses each defined variable, also indirectly."""
        low, high = np.full(self._count, len(self._row)), np.full(self._count, -1)
        for part in self._parts:
            for k, root in enumerate(part.template.roots):
                for kind, node in root.holes if root else ():
                    if kind == DEFINED:
                        np.minimum.at(low, part.identity[node], part.goal[:, k])
                        np.maximum.at(high, part.identity[node], part.goal[:, k])
        # a node is visited after everything that uses it
        for part, node, text, _ in reversed(self._nodes):
            parent = part.identity[node]
            for kind, other in text.holes:
                if kind == DEFINED:
                    child = part.identity[other]
                    np.minimum.at(low, child, low[parent])
                    np.maximum.at(high, child, high[parent])
        return low, high

    def segments(self) -> Iterator[str]:
        """`V`, `C` and `O` segments; a variable with one user is written right before it."""
        rows: list[list[str]] = [[] for _ in self._row]
        for part in self._parts:
            for k, root in enumerate(part.template.roots):
                texts = part.write(root, slice(None), self._final, self.lifted) if root else []
                for r, text in zip(part.goal[:, k].tolist(), texts):
                    rows[r].append(text)
        constant = np.zeros(len(rows))
        constant[self._row] = self._program.constant
        written = [
            text
            for part, _, pattern, first in self._nodes
            for text in part.write(pattern, first, self._final, self.lifted)
        ]
        order, owner = self._order.tolist(), self._owner.tolist()
        shared = self.lifted or self._shared
        for k in range(shared):
            head = f"C{k}" if self.lifted else f"V{self._first + k} 0 0"
            yield f"{head}\n{written[order[k]]}"
        k = shared
        for r in range(len(rows)):
            while k < len(owner) and owner[k] == r:
                yield f"V{self._first + k} 0 {r + 1}\n{written[order[k]]}"
                k += 1
            head = f"C{self.lifted + r}" if r < len(rows) - 1 else "O0 0"
            yield f"{head}\n{_total(rows[r], constant[r])}"

    def lifted_values(self, x: Float) -> Float:
        """(lifted,) values of the lifted variables at a point x (nx,) in the order of the file."""
        out, found = np.empty(self.lifted), dict[int, dict[int, Float]]()
        for part, node, _, first in self._nodes if self.lifted else ():
            if id(part) not in found:
                found[id(part)] = part.template.graph.values(x[part.index])
            out[self._final[part.identity[node][first]]] = found[id(part)][node][first]
        return out

    def with_lifted(self, linear: sparse.spmatrix) -> sparse.csr_matrix:
        """Entries of the rows of the file, 0 where they are nonlinear, from those of a file without
        lifted variables (ng + 1, nx)."""
        k = self.lifted
        given = linear.tocoo()
        # what is nonlinear moves to other rows
        kept = given.data != 0 if k else slice(None)
        triplets = [(given.data[kept], given.row[kept] + k, given.col[kept] + k)]
        triplets.append((-np.ones(k), np.arange(k), np.arange(k)))

        def add(part: _Part, text: Text, elements: Int | slice, row: Int) -> None:
            for (kind, _), column in zip(text.holes, part.columns(text, elements, self._final)):
                if kind != NUMBER:
                    triplets.append((np.zeros(len(row)), row, column + k * (kind == VARIABLE)))

        for part, node, text, first in self._nodes if k else ():
            add(part, text, first, self._final[part.identity[node][first]])
        for part in self._parts if k else ():
            for j, root in enumerate(part.template.roots):
                if root:
                    add(part, root, slice(None), k + part.goal[:, j])
        value, row, column = (np.concatenate(c) for c in zip(*triplets))
        size = k + linear.shape[0], k + linear.shape[1]
        out = sparse.csr_matrix((value, (row, column)), size)
        out.sort_indices()
        return out


def _total(terms: list[str], constant: float) -> str:
    """Prefix text of the sum of terms and a number."""
    if constant or not terms:
        terms = [*terms, f"n{number(constant)}"]
    return terms[0] if len(terms) == 1 else "\n".join([plus(len(terms)), *terms])
