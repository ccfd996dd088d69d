"""An NLP of kernels and tables, taken apart into the parts of a .nl file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from soup_nlp.errors import ExportError
from soup_nlp.export.opcodes import PLUS, SUM, number
from soup_nlp.export.split import split
from soup_nlp.export.stamp import NOWHERE, Defined, Stamp
from soup_nlp.export.template import DEFINED, Template, make_template
from soup_nlp.model.kernel import Group

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

OBJECTIVE = -1


@dataclass(frozen=True)
class Program:
    """The NLP in parts; variables and rows in the order of the NLP.

    Attributes:
        stamped: (template, (E, nx) variables, (E, m) rows or OBJECTIVE of every output).
        jacobian: (ng, nx) linear coefficients of the rows.
        gradient: (1, nx) those of the objective; both keep a zero for a nonlinear entry.
        in_rows: (nx,) variable is nonlinear in some row.
        in_objective: (nx,) variable is nonlinear in the objective.
        curved_rows: (ng,) row has an expression (or a constant, which only those can have).
        curved_objective: The objective has an expression with variables.
        row_constant: (ng,) numbers to add to the rows' expressions.
        objective_constant: The same for the objective.
    """

    stamped: tuple[tuple[Template, Int, Int], ...]
    jacobian: sparse.csr_matrix
    gradient: sparse.csr_matrix
    in_rows: Mask
    in_objective: Mask
    curved_rows: Mask
    curved_objective: bool
    row_constant: Float
    objective_constant: float


def take_apart(groups: Sequence[Group], nx: int, ng: int, theta: Float) -> Program:
    """Split, trace and fold every kernel.

    Args:
        groups: Kernels and tables.
        nx: Variables of the NLP.
        ng: Rows of the NLP.
        theta: Values of the shared parameters.

    Raises:
        ExportError: an operation has no opcode, or a number is not finite.
    """
    in_rows, in_objective = np.zeros(nx, bool), np.zeros(nx, bool)
    curved_rows, row_constant = np.zeros(ng, bool), np.zeros(ng)
    curved_objective, objective_constant = False, 0.0
    stamped = []
    linear: list[tuple[Float, Int, Int]] = [(np.zeros(0), np.zeros(0, int), np.zeros(0, int))]
    for group in groups:
        name, table = group.kernel.name, group.table
        if not group.size:
            continue
        parts = split(group, theta)
        if not parts.nonlinear.numel():
            continue
        template = make_template(name, parts.nonlinear, group, theta)
        for values in (*template.numbers.values(), parts.coefficient):
            if not np.isfinite(values).all():
                raise ExportError(
                    "number of an expression is not finite",
                    where=name,
                    hint="a kernel divides by a column that is 0 somewhere",
                )
        goal = np.full((group.size, int(parts.objective)), OBJECTIVE)
        if group.kernel.nc:
            goal = np.concatenate([goal, table.rows], axis=1)
        stamped.append((template, table.index, goal))
        row, column = goal[:, parts.row], table.index[:, parts.column]
        linear.append((parts.coefficient.ravel(), row.ravel(), column.ravel()))
        for k in range(parts.nonlinear.numel()):
            variables = table.index[:, parts.column[(parts.row == k) & ~parts.is_linear]]
            curved = template.roots[k] is not None
            constant = np.broadcast_to(template.constants[k], group.size)
            if parts.objective and k == 0:
                in_objective[variables] = True
                curved_objective |= curved
                objective_constant += float(constant.sum())
            else:
                in_rows[variables] = True
                curved_rows[goal[:, k]] |= curved
                np.add.at(row_constant, goal[:, k], constant)
    # sums of triplets keep zeros: entries of nonlinear variables belong to the structure
    value, row, column = (np.concatenate(column) for column in zip(*linear))
    own = row == OBJECTIVE
    return Program(
        stamped=tuple(stamped),
        jacobian=sparse.csr_matrix((value[~own], (row[~own], column[~own])), (ng, nx)),
        gradient=sparse.csr_matrix((value[own], (0 * row[own], column[own])), (1, nx)),
        in_rows=in_rows,
        in_objective=in_objective,
        curved_rows=curved_rows | (row_constant != 0),
        curved_objective=curved_objective,
        row_constant=row_constant,
        objective_constant=objective_constant,
    )


def orders(program: Program) -> tuple[Int, Int]:
    """Variables and rows in the order of the format.

    Variables: nonlinear in rows and objective, in rows alone, in the objective alone, linear.
    Rows: nonlinear, linear. Inside a class the NLP's order stays.
    """
    kind = np.where(
        program.in_rows,
        np.where(program.in_objective, 0, 1),
        np.where(program.in_objective, 2, 3),
    )
    variables = np.argsort(kind, kind="stable")
    return variables, np.argsort(~program.curved_rows, kind="stable")


@dataclass
class Body:
    """Expressions of a program in the numbering of the file.

    Args:
        program: The NLP in parts.
        place: (nx,) place in the file of every variable.
        row_place: (ng,) place in the file of every row.
    """

    program: Program
    place: Int
    row_place: Int
    classes: tuple[int, int, int, int, int] = field(init=False)

    def __post_init__(self) -> None:
        self._defined = Defined()
        self._stamps: list[tuple[Stamp, Int]] = []
        for template, index, goal in self.program.stamped:
            stamp = Stamp(template, self.place[index])
            self._defined.register(stamp)
            # the entry past the last row is the objective's, whose row is -1
            place = np.append(self.row_place, OBJECTIVE)
            self._stamps.append((stamp, place[goal]))
        low, high, objective = self._defined.users(self._uses())
        used_in_rows = low != NOWHERE
        kind = np.select(
            [objective & used_in_rows, used_in_rows & (low < high), used_in_rows], [0, 1, 3], 4
        )
        # single-use ones stand before their row, in the order of the rows
        owner = np.where(kind == 3, low, len(self.row_place))
        self._order = np.lexsort((np.arange(len(kind)), owner, kind))
        self._kind, self._owner = kind[self._order], owner[self._order]
        self._final = np.empty(len(kind), np.int64)
        self._final[self._order] = len(self.place) + np.arange(len(kind))
        b, c, o, c1, o1 = (int((kind == k).sum()) for k in range(5))
        self.classes = (b, c, o, c1, o1)

    def _uses(self) -> Iterator[tuple[Int, Int]]:
        """(identities, rows) of the defined variables that outputs name themselves."""
        for stamp, goal in self._stamps:
            for k, root in enumerate(stamp.template.roots):
                for kind, node in root.holes if root else ():
                    if kind == DEFINED:
                        yield stamp.identity[node], goal[:, k]

    def segments(self) -> Iterator[str]:
        """`V`, `C` and `O` segments; a variable with one user stands right before it."""
        rows: list[list[str]] = [[] for _ in self.row_place]
        objective: list[str] = []
        for stamp, goal in self._stamps:
            for k, root in enumerate(stamp.template.roots):
                if root is None:
                    continue
                texts = stamp.write(root, slice(None), self._final)
                if goal[0, k] == OBJECTIVE:
                    objective += texts
                else:
                    for r, text in zip(goal[:, k].tolist(), texts):
                        rows[r].append(text)
        constant = np.zeros(len(rows))
        constant[self.row_place] = self.program.row_constant
        texts = self._defined.texts(self._final)
        shared = int(np.searchsorted(self._kind, 3))
        first = len(self.place)
        order, owner = self._order.tolist(), self._owner.tolist()
        for k in range(shared):
            yield f"V{first + k} 0 0\n{texts[order[k]]}"
        k = shared
        for r, parts in enumerate(rows):
            while k < len(owner) and owner[k] == r:
                yield f"V{first + k} 0 {r + 1}\n{texts[order[k]]}"
                k += 1
            yield f"C{r}\n{_total(parts, constant[r])}"
        while k < len(owner):
            yield f"V{first + k} 0 {len(rows) + 1}\n{texts[order[k]]}"
            k += 1
        yield f"O0 0\n{_total(objective, self.program.objective_constant)}"


def _total(terms: list[str], constant: float) -> str:
    """Sum of prefix texts and a number."""
    if constant or not terms:
        terms = [*terms, f"n{number(constant)}"]
    if len(terms) == 1:
        return terms[0]
    head = PLUS if len(terms) == 2 else f"{SUM}\n{len(terms)}"
    return "\n".join([head, *terms])
