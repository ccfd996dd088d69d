"""Expressions of a kernel as prefix text with holes, which are filled in for every element.

The symbolic instructions are read once. Parts that depend on data only become numbers, for all
elements at once. An expression becomes a defined variable if an element uses it repeatedly or if
many elements share it, such as the 3D anchor of a superpixel with fifteen edges.
"""

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.errors import ExportError
from soup_nlp.model.kernel import Group
from soup_nlp.model.operations import NAMES, OPERATIONS, instructions

COMMUTATIVE = frozenset({ca.OP_ADD, ca.OP_MUL, ca.OP_FMIN, ca.OP_FMAX})
WORTH_NAMING = 4
"""Smallest number of operations and leaves of a defined variable."""

SHARED_BELOW = 0.6
"""Largest ratio of distinct instances to elements for a part that elements share."""

VARIABLE, NUMBER, DEFINED = "x", "n", "v"


@dataclass(frozen=True)
class Text:
    """Prefix text with a hole `%s` for every entry of `holes`.

    Attributes:
        pattern: Lines without a newline at the end.
        holes: (kind, number) of a local variable, a numeric column, or a defined node.
    """

    pattern: str
    holes: tuple[tuple[str, int], ...]


@dataclass
class _Graph:
    """Expression graph of a kernel; nodes are numbered in the order of evaluation."""

    op: list[int] = field(default_factory=list)
    args: list[tuple[int, ...]] = field(default_factory=list)
    variable: dict[int, int] = field(default_factory=dict)
    number: dict[int, Float] = field(default_factory=dict)
    roots: list[int] = field(default_factory=list)
    known: dict[object, int] = field(default_factory=dict)

    def node(self, key: object, op: int = -1, args: tuple[int, ...] = ()) -> int:
        """Node of a key, created unless the key is known."""
        if key not in self.known:
            self.known[key] = len(self.op)
            self.op.append(op)
            self.args.append(args)
        return self.known[key]

    def constant(self, key: object, value: Float | float) -> int:
        """Node of a number."""
        node = self.node(key)
        self.number[node] = np.asarray(value)
        return node

    def apply(self, op: int, args: tuple[int, ...]) -> int:
        """Node of an operation, a number if no argument is variable."""
        key = (op, tuple(sorted(args)) if op in COMMUTATIVE else args)
        if not all(a in self.number for a in args):
            return self.node(key, op, args)
        with np.errstate(all="ignore"):
            return self.constant(key, OPERATIONS[op].numpy(*(self.number[a] for a in args)))

    def values(self, x: Float) -> dict[int, Float]:
        """Value of every node at the local variables x (E, nx)."""
        out = {**self.number, **{node: x[:, slot] for node, slot in self.variable.items()}}
        with np.errstate(all="ignore"):
            for node, args in enumerate(self.args):
                if self.op[node] >= 0:
                    out[node] = OPERATIONS[self.op[node]].numpy(*(out[a] for a in args))
        return out


def trace(outputs: ca.SX, group: Group, theta: Float) -> _Graph:
    """Expression graph of the outputs; numbers are scalars, or (E,) if they depend on data.
    ExportError for an operation without an opcode."""
    kernel = group.kernel
    function = ca.Function("f", [kernel.x, kernel.row, kernel.theta], [ca.densify(outputs)])
    graph = _Graph(roots=[-1] * outputs.numel())
    work: dict[int, int] = {}
    for op, (target, *place), inputs, value in instructions(function):
        if op == ca.OP_OUTPUT:
            graph.roots[place[0]] = work[inputs[0]]
        elif op == ca.OP_CONST:
            work[target] = graph.constant(("const", value), value)
        elif op == ca.OP_INPUT and inputs[0] == 0:
            work[target] = graph.node((0, inputs[1]))
            graph.variable[work[target]] = inputs[1]
        elif op == ca.OP_INPUT:
            column, nonzero = inputs[0] == 1, inputs[1]
            values = group.data[:, nonzero] if column else theta[nonzero]
            work[target] = graph.constant(tuple(inputs), values)
        elif op in OPERATIONS and OPERATIONS[op].nl:
            work[target] = graph.apply(op, tuple(work[a] for a in inputs))
        else:
            raise ExportError(
                "operation cannot be written to .nl",
                where=kernel.name,
                found=NAMES.get(op, str(op)),
            )
    return graph


@dataclass(frozen=True)
class Template:
    """Texts of a kernel, which are filled in for the elements of a group.

    Attributes:
        defined: Node and text of every defined variable, dependencies first.
        roots: Text of every output; None for a number.
        graph: What the texts are made from; its numbers are scalars or (E,) by node.
    """

    defined: tuple[tuple[int, Text], ...]
    roots: tuple[Text | None, ...]
    graph: _Graph


def make_template(outputs: ca.SX, group: Group, theta: Float) -> Template:
    """Make the template of (m,) expressions of a kernel's x, row and theta."""
    graph = trace(outputs, group, theta)
    names = _defined(graph, group)
    defined = tuple((n, _emit(graph, n, names)) for n in sorted(names))
    # an output without an instruction is a structural zero
    numbers = [root < 0 or root in graph.number for root in graph.roots]
    roots = (
        None if number else _emit(graph, root, names, root=True)
        for root, number in zip(graph.roots, numbers)
    )
    return Template(defined, tuple(roots), graph)


def _defined(graph: _Graph, group: Group) -> set[int]:
    """Nodes that become defined variables."""
    # operations that depend on variables, arguments first
    nodes = [node for node, op in enumerate(graph.op) if op >= 0]
    parents: dict[int, list[int]] = {n: [] for n in nodes}
    for node in nodes:
        for a in graph.args[node]:
            if a in parents:
                parents[a].append(node)
    uses = {n: len(parents[n]) + graph.roots.count(n) for n in nodes}
    common = _common(graph, nodes, group) if len(group) > 1 else set()
    size: dict[int, int] = {}
    names = set()
    for node in nodes:
        size[node] = 1 + sum(1 if a in names else size.get(a, 1) for a in graph.args[node])
        # only the largest part that elements share
        top = node in common and (node in graph.roots or not common.issuperset(parents[node]))
        if (uses[node] > 1 or top) and size[node] >= WORTH_NAMING:
            names.add(node)
    return names


def _common(graph: _Graph, nodes: list[int], group: Group) -> set[int]:
    """Nodes with equal instances (same variables and numbers) in many elements."""
    columns: dict[int, Int] = {}
    support: dict[int, frozenset[int]] = {}

    def leaf(node: int) -> frozenset[int]:
        """The node itself, if its value depends on the element."""
        if node in graph.variable:
            columns[node] = group.index[:, graph.variable[node]].astype(np.int64)
        elif np.ndim(graph.number[node]):
            columns[node] = np.ascontiguousarray(graph.number[node]).view(np.int64)
        else:
            return frozenset()
        return frozenset({node})

    distinct: dict[frozenset[int], int] = {}
    common = set()
    for node in nodes:
        for a in graph.args[node]:
            if a not in support:
                support[a] = leaf(a)
        leaves = frozenset[int]().union(*(support[a] for a in graph.args[node]))
        support[node] = leaves
        if leaves not in distinct:
            instances = np.stack([columns[a] for a in leaves], axis=1)
            distinct[leaves] = len(set(map(bytes, instances)))
        if distinct[leaves] <= SHARED_BELOW * len(group):
            common.add(node)
    return common


def _emit(graph: _Graph, top: int, names: set[int], root: bool = False) -> Text:
    """Prefix text of a node; defined nodes below it (and, for a root, itself) are holes."""
    lines: list[str] = []
    holes: list[tuple[str, int]] = []

    def write(node: int, inside: bool = True) -> None:
        value = graph.number.get(node)
        if node in names and inside:
            lines.append("v%s")
            holes.append((DEFINED, node))
        elif node in graph.variable:
            lines.append("v%s")
            holes.append((VARIABLE, graph.variable[node]))
        elif value is None:
            operation(node)
        elif np.ndim(value):
            lines.append("n%s")
            holes.append((NUMBER, node))
        else:
            lines.append(f"n{number(float(value))}")

    def operation(node: int) -> None:
        op, args = graph.op[node], graph.args[node]
        if op == ca.OP_ADD:
            terms, todo = [], [node]
            while todo:
                term = todo.pop()
                if term == node or (graph.op[term] == ca.OP_ADD and term not in names):
                    todo += reversed(graph.args[term])
                else:
                    terms.append(term)
            lines.append(plus(len(terms)))
            operands: list[str | int] = [*terms]
        elif op == ca.OP_SQ and (args[0] in names or args[0] in graph.variable):
            lines.append("o2")
            operands = [args[0], args[0]]
        else:
            code, *words = OPERATIONS[op].nl.split()
            lines.append(code)
            operands = [args[int(word[1])] if word.startswith("{") else word for word in words]
        for operand in operands:
            if isinstance(operand, str):
                lines.append(operand)
            else:
                write(operand)

    write(top, inside=root)
    return Text("\n".join(lines), tuple(holes))


def plus(count: int) -> str:
    """Head of a sum of terms, o0 of two; o54 of more is followed by their number."""
    return "o0" if count == 2 else f"o54\n{count}"


def number(value: float) -> str:
    """Shortest text that reads back as the same double (at most 17 significant digits)."""
    text = repr(float(value))
    return text[:-2] if text.endswith(".0") else text
