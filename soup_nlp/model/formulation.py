"""The soup's nonlinear programs: the constrained one (the product) and the tangent presolve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.errors import ModelError
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import terms
from soup_nlp.model.energy import EnergyData, Weights
from soup_nlp.model.kernel import Group, Kernel, Table
from soup_nlp.model.layout import GAUGES, Gauge, MatrixLayout, TangentLayout
from soup_nlp.model.nlp import NLP, assemble
from soup_nlp.model.norms import Norm, NormForm, TruncationForm, solver_form
from soup_nlp.model.views import View, matrix_view, tangent_view

Float = NDArray[np.float64]
Int = NDArray[np.int64]

THETA = ("eps", "eps_pixel", "theta", "ridge")
MIN_SCALE = 1e-4


@dataclass(frozen=True)
class Formulation:
    """How the energy is written for a solver.

    Attributes:
        gauge: "unit-offset", "unit-translation" or "free".
        norm: "smooth" (sqrt(|v|^2 + eps^2) - eps) or "epigraph" (slack s, |v|^2 <= s^2).
        truncation: "smooth" or "lifted" (z in [0, 1], exact).
        hessian: "exact", "gauss-newton" or "gauss-newton+constraints".
        eps: Smoothing of lengths and rotations, in the energy's unit (pixels by default).
        eps_pixel: Smoothing of re-projection errors, pixels.
        theta: Share of curvature along a residual that the Gauss-Newton Hessian leaves out.
        ridge: Added to the Gauss-Newton Hessian's diagonal.
        min_facing: Visibility: lower bound c of -n . r.
        depth_ratio: Depth at a rim pixel is at most this many times the anchor's.
        compiled: Compile kernels where a C compiler is found.
    """

    gauge: Gauge = "unit-offset"
    norm: NormForm = "smooth"
    truncation: TruncationForm = "smooth"
    hessian: str = "exact"
    eps: float = 1e-2
    eps_pixel: float = 1e-2
    theta: float = 0.9
    ridge: float = 1e-2
    min_facing: float = 1e-3
    depth_ratio: float = 5.0
    compiled: bool = True


@dataclass(frozen=True)
class _Element:
    """One kind of element: its local superpixel views and where their variables are."""

    arity: int
    fields: dict[str, int]
    columns: dict[str, Float]
    index: Int
    norms: Callable[[list[View], dict[str, ca.SX], ca.SX, ca.SX], list[Norm]]


@dataclass
class _Builder:
    """Collects groups, slack variables and constraint rows."""

    form: Formulation
    nx: int
    ng: int = 0

    def __post_init__(self) -> None:
        self.groups: list[Group] = []
        self.x_extra: list[tuple[str, Float, Float]] = []
        self.lbg: list[Float] = []
        self.ubg: list[Float] = []
        self.g_blocks: list[tuple[str, Int]] = []
        self.x_blocks: list[tuple[str, Int]] = []
        self.theta = ca.SX.sym("theta", len(THETA))

    def new_variables(self, label: str, count: int, lower: float, upper: float) -> Int:
        """Indices of `count` fresh variables with bounds."""
        index = self.nx + np.arange(count)
        self.nx += count
        self.x_extra.append((label, np.full(count, lower), np.full(count, upper)))
        self.x_blocks.append((label, np.arange(count)))
        return index

    def new_rows(self, label: str, count: int, lower: float, upper: float) -> Int:
        """Indices of `count` fresh constraint rows with bounds."""
        index = self.ng + np.arange(count)
        self.ng += count
        self.lbg.append(np.full(count, lower))
        self.ubg.append(np.full(count, upper))
        self.g_blocks.append((label, np.arange(count)))
        return index

    def add_norms(self, name: str, element: _Element, view: Callable[..., View], own: int) -> None:
        """Add an energy term: kernel of its norms in solver form, and its table.

        Args:
            name: Of the kernel.
            element: Data columns, superpixel indices and the norms.
            view: Makes a View of local variables (own,) and the data row, by position.
            own: Variables per superpixel.
        """
        size = len(element.index)
        if not size:
            return
        x = ca.SX.sym("x", own * element.arity)
        row = {k: ca.SX.sym(k, c) for k, c in element.fields.items()}
        views = [view(x[own * a : own * (a + 1)], row, a) for a in range(element.arity)]
        norms = element.norms(views, row, self.theta[0], self.theta[1])
        slacks: list[ca.SX | None] = []
        switches: list[ca.SX | None] = []
        local, index = [x], [element.index]
        for norm in norms:
            slack = switch = None
            if self.form.norm == "epigraph" and norm.kind == "norm":
                slack = ca.SX.sym(f"s_{norm.name}")
                local.append(slack)
                index.append(self.new_variables(f"s_{norm.name}", size, 0.0, np.inf)[:, None])
            if self.form.truncation == "lifted" and norm.sigma is not None:
                switch = ca.SX.sym(f"z_{norm.name}")
                local.append(switch)
                index.append(self.new_variables(f"z_{norm.name}", size, 0.0, 1.0)[:, None])
            slacks.append(slack)
            switches.append(switch)
        everything = ca.vertcat(*local)
        forms = [
            solver_form(norm, everything, self.theta[2], s, z)
            for norm, s, z in zip(norms, slacks, switches)
        ]
        cons = [f.constraint for f in forms if f.constraint is not None]
        rows = np.zeros((size, 0), np.int64)
        for norm, f in zip(norms, forms):
            if f.constraint is not None:
                fresh = self.new_rows(f"epigraph_{norm.name}", size, 0.0, np.inf)
                rows = np.concatenate([rows, fresh[:, None]], axis=1)
        kernel = Kernel(
            name,
            everything,
            ca.vertcat(*row.values()),
            self.theta,
            objective=sum((f.objective for f in forms), ca.SX(0)),
            constraints=ca.vertcat(*cons) if cons else None,
            curvature=sum((f.curvature for f in forms), ca.SX(0)),
            exact=sum((n.exact() for n in norms), ca.SX(0)),
        )
        data = np.column_stack([element.columns[k].reshape(size, -1) for k in element.fields])
        self.groups.append(Group(kernel, Table(np.concatenate(index, axis=1), data, rows)))

    def add_constraint(
        self, name: str, x: ca.SX, row: ca.SX, body: ca.SX, index: Int, data: Float, rows: Int
    ) -> None:
        """Add a constraint kernel with its table."""
        kernel = Kernel(name, x, row, self.theta, constraints=body)
        self.groups.append(Group(kernel, Table(index, data, rows)))

    def add_ridge(self, metric: Float) -> None:
        """Zero objective whose stand-in Hessian is ridge x metric on the diagonal.

        Args:
            metric: (n,) squared inverse length of a natural step of the first n variables.
        """
        x, m = ca.SX.sym("x"), ca.SX.sym("metric")
        kernel = Kernel("ridge", x, m, self.theta, objective=0 * x, curvature=self.theta[3] * m)
        self.groups.append(Group(kernel, Table(np.arange(len(metric))[:, None], metric[:, None])))


def _elements(
    data: EnergyData, w: Weights, layout: TangentLayout | MatrixLayout
) -> dict[str, _Element]:
    """The four terms as element kinds, with the columns that the layout's views need."""

    def base(columns: dict[str, Float], sp: Int) -> tuple[dict[str, int], dict[str, Float]]:
        extra: dict[str, Float] = {}
        for a in range(sp.shape[1]):
            i = sp[:, a]
            if isinstance(layout, TangentLayout):
                extra[f"anchor_{a}"] = layout.anchor[i]
                extra[f"radius_{a}"] = layout.radius[i]
                extra[f"depth_{a}"] = layout.depth[i]
                extra[f"R0_{a}"] = layout.R0[i].transpose(0, 2, 1).reshape(-1, 9)
            else:
                extra[f"offset_{a}"] = layout.offset[i]
        merged = {**columns, **extra}
        widths = {k: int(np.prod(v.shape[1:], dtype=int)) for k, v in merged.items()}
        return widths, merged

    def full(n: int, value: float) -> Float:
        return np.full(n, value if np.isfinite(value) else 0.0)

    out = {}
    e = data.edges
    fields, columns = base(
        {
            "weight": w.arap * data.edge_weight,
            "unit": data.edge_unit,
            "turn": full(len(e), data.rotation_scale),
            "sigma": full(len(e), w.sigma_arap),
            "leak": full(len(e), w.leak_arap),
            "ray_i": data.anchor_ray[e[:, 0]],
            "ray_k": data.anchor_ray[e[:, 1]],
        },
        e,
    )
    out["arap"] = _Element(
        2,
        fields,
        columns,
        e,
        lambda v, row, eps, _: terms.arap(
            v[0],
            v[1],
            row,
            eps,
            bool(np.isfinite(w.sigma_arap)),
            data.arap_at_anchors,
            data.local_units,
        ),
    )
    n, s = data.pixel_weight.shape
    superpixel = np.repeat(np.arange(n), s)
    used = data.pixel_weight.ravel() > 0
    owner = superpixel[used][:, None]
    fields, columns = base(
        {
            "weight": w.proj * data.pixel_weight.ravel()[used],
            "sigma": full(int(used.sum()), w.sigma_proj),
            "ray": data.pixel_ray.reshape(-1, 3)[used],
            "target": data.pixel_target.reshape(-1, 2)[used],
        },
        owner,
    )
    K = ca.DM(data.K_next)
    out["proj"] = _Element(
        1,
        fields,
        columns,
        owner,
        lambda v, row, _, eps: terms.reprojection(
            v[0], row, eps, K, bool(np.isfinite(w.sigma_proj))
        ),
    )
    pairs, b = data.pairs, data.boundary_ray.shape[1]
    fields, columns = base(
        {
            "weight": w.cont * data.pair_weight,
            "factor": data.pair_factor / data.pair_unit,
            "sigma_ref": full(len(pairs), w.sigma_cont_ref),
            "sigma": full(len(pairs), w.sigma_cont),
            "ray_i": data.anchor_ray[pairs[:, 0]],
            "ray_k": data.anchor_ray[pairs[:, 1]],
            "rays": data.boundary_ray.reshape(len(pairs), 3 * b),
        },
        pairs,
    )
    out["cont"] = _Element(
        2,
        fields,
        columns,
        pairs,
        lambda v, row, eps, _: terms.continuity(
            v[0],
            v[1],
            row,
            eps,
            b,
            bool(np.isfinite(w.sigma_cont_ref)),
            bool(np.isfinite(w.sigma_cont)),
            data.local_units,
        ),
    )
    fields, columns = base(
        {"weight": w.orient * data.pair_count, "sigma": full(len(pairs), w.sigma_orient)}, pairs
    )
    out["orient"] = _Element(
        2,
        fields,
        columns,
        pairs,
        lambda v, row, eps, _: terms.orientation(
            v[0], v[1], row, eps, bool(np.isfinite(w.sigma_orient))
        ),
    )
    return out


def _names(own: list[str], blocks: list[tuple[str, Int]]) -> list[str]:
    return own + [f"{label}[{i}]" for label, index in blocks for i in index]


def build_matrix_nlp(
    soup: Soup, data: EnergyData, weights: Weights, form: Formulation
) -> tuple[NLP, MatrixLayout]:
    """The constrained NLP: matrix rotations with SO(3), unit normals, simplex, visibility.

    Args:
        soup: Start; SO(3) and unit normals should hold.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Gauge, norm, truncation, Hessian, smoothing.

    Returns:
        The NLP and the layout that turns its vectors into soups.

    Raises:
        ModelError: unknown gauge.
    """
    if form.gauge not in GAUGES:
        raise ModelError("unknown gauge", found=form.gauge, expected=", ".join(GAUGES))
    n = len(data)
    layout = MatrixLayout(data.share, form.gauge)
    b = _Builder(form, layout.size)
    own = layout.stride

    def view(x: ca.SX, row: dict[str, ca.SX], position: int) -> View:
        return matrix_view(x, form.gauge, row[f"offset_{position}"])

    for name, element in _elements(data, weights, layout).items():
        placed = np.concatenate([layout.of(c) for c in element.index.T], axis=1)
        b.add_norms(name, _Element(**{**element.__dict__, "index": placed}), view, own)

    every = layout.of(np.arange(n))
    x = ca.SX.sym("x", own)
    none, empty = ca.SX.sym("none", 0), np.zeros((n, 0))
    v = matrix_view(x, form.gauge, ca.SX(1.0))
    rows = b.new_rows("so3", 6 * n, 0.0, 0.0).reshape(n, 6)
    b.add_constraint("so3", x, none, terms.so3(v), every, empty, rows)
    rows = b.new_rows("normal", n, 0.0, 0.0)[:, None]
    b.add_constraint("normal", x, none, terms.unit_normal(v), every, empty, rows)
    count = data.rim_ray.shape[1]
    ray = ca.SX.sym("rays", 3 * count)
    rows = b.new_rows("visible", count * n, form.min_facing, np.inf).reshape(n, count)
    b.add_constraint(
        "visible",
        x,
        ray,
        terms.visibility(v, ray, count),
        every,
        data.visibility_ray(form.depth_ratio).reshape(n, -1),
        rows,
    )
    row = np.tile(b.new_rows("simplex", 1, 1.0, 1.0), (n, 1))
    b.add_constraint("simplex", x, none, v.lam / n, every, empty, row)
    if form.gauge != "unit-offset":
        # the length unit: sum_i c_i D_i = 1 (in gauge unit-offset the simplex says it)
        row = np.tile(b.new_rows("unit", 1, 1.0, 1.0), (n, 1))
        c = ca.SX.sym("share")
        b.add_constraint("unit", x, c, c * v.lam * x[4], every, data.share[:, None], row)
    if form.gauge == "unit-translation":
        tau = ca.SX.sym("tau")
        both = ca.vertcat(x, tau)
        index = np.column_stack([every, np.full(n, layout.tau)])
        rows = b.new_rows("translation", n, 0.0, 0.0)[:, None]
        b.add_constraint("translation", both, none, ca.sumsqr(v.t) - tau**2, index, empty, rows)
    b.add_ridge(_metric(layout, layout.pack(soup), data))

    lbx, ubx = np.full(b.nx, -np.inf), np.full(b.nx, np.inf)
    lbx[np.arange(n) * own] = MIN_SCALE
    if form.gauge != "unit-offset":
        lbx[np.arange(n) * own + 4] = MIN_SCALE
    if form.gauge == "unit-translation":
        lbx[layout.tau] = 1e-8
    x0 = np.concatenate([layout.pack(soup), np.zeros(b.nx - layout.size)])
    nlp = _finish("soup", b, x0, lbx, ubx, layout.size, layout.names)
    return _with_slacks(nlp, layout.size), layout


def _metric(layout: MatrixLayout, x: Float, data: EnergyData) -> Float:
    """Ridge metric of the matrix variables that equals the presolve's at the start.

    A natural step is: relative 1 in scale and offset, a slope of 1 at the superpixel's rim in the
    normal, one radian in R, one anchor depth in the translation.
    """
    n, own = layout.count, layout.stride
    a = x[: n * own].reshape(n, own)
    s = layout.unpack(x)
    facing = -np.einsum("nc,nc->n", s.n, data.anchor_ray)
    metric = np.ones((n, own))
    metric[:, 0] = 1 / a[:, 0] ** 2
    metric[:, 1:4] = (1 / np.maximum(facing * data.radius, 1e-3) ** 2)[:, None]
    if layout.gauge != "unit-offset":
        metric[:, 4] = 1 / a[:, 4] ** 2
    depth = s.depth_at(data.anchor_ray)
    metric[:, -3:] = (a[:, 0] / depth)[:, None] ** 2
    return np.append(metric.ravel(), np.ones(layout.size - n * own))


def build_tangent_nlp(
    soup: Soup, data: EnergyData, weights: Weights, form: Formulation
) -> tuple[NLP, TangentLayout]:
    """The presolve: 9 coordinates per superpixel about the soup, linear constraints only.

    Args:
        soup: Base and start.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Smoothing and Hessian; gauge is not used.
    """
    n = len(data)
    layout = TangentLayout.about(soup, data)
    b = _Builder(form, 9 * n)

    def view(x: ca.SX, row: dict[str, ca.SX], a: int) -> View:
        return tangent_view(
            x, row[f"anchor_{a}"], row[f"radius_{a}"], row[f"depth_{a}"], row[f"R0_{a}"]
        )

    for name, element in _elements(data, weights, layout).items():
        placed = np.concatenate([layout.of(c) for c in element.index.T], axis=1)
        b.add_norms(f"t_{name}", _Element(**{**element.__dict__, "index": placed}), view, 9)
    # the simplex, linear in the scales with the slopes held: every iterate keeps it, and the
    # constrained NLP, which has it exactly, starts from the normalised answer
    share = soup.normalised(layout.share).lam
    lam, part = ca.SX.sym("lam"), ca.SX.sym("share")
    row = np.tile(b.new_rows("simplex", 1, 1.0, 1.0), (n, 1))
    b.add_constraint(
        "t_simplex", lam, part, part * lam, np.arange(n)[:, None] * 9, share[:, None], row
    )
    # visibility as in the constrained NLP, divided by the anchor's facing 1 / |m|: the same set, so
    # that one's solution is the other's
    count = data.rim_ray.shape[1] - 1
    off = (data.rim_ray[:, 1:] - data.rim_ray[:, :1])[..., :2] / layout.radius[:, None, None]
    slope, place = ca.SX.sym("slope", 2), ca.SX.sym("off", 2 * count)
    ray, reach = ca.SX.sym("ray", 2), ca.SX.sym("radius")
    facing = ca.norm_2(ca.vertcat(slope / reach, 1 - ca.dot(slope, ray) / reach))
    rows = b.new_rows("visible", count * n, 1 / form.depth_ratio - 1, np.inf)
    b.add_constraint(
        "t_visible",
        slope,
        ca.vertcat(place, ray, reach),
        ca.vertcat(*[ca.dot(slope, place[2 * j : 2 * j + 2]) for j in range(count)])
        - form.min_facing * facing,
        np.arange(n)[:, None] * 9 + np.array([1, 2]),
        np.column_stack([off.reshape(n, -1), layout.anchor[:, :2], layout.radius]),
        rows.reshape(n, count),
    )
    b.add_ridge(np.ones(9 * n))
    lower, upper = np.full((n, 9), -np.inf), np.full((n, 9), np.inf)
    lower[:, 0] = 1e-3
    lower[:, 1:3], upper[:, 1:3] = -0.99 * form.depth_ratio, 0.99 * form.depth_ratio
    extra = b.nx - 9 * n
    x0 = np.concatenate([_visible(layout.pack(soup), off, form.depth_ratio), np.zeros(extra)])
    nlp = _finish(
        "presolve",
        b,
        x0,
        np.concatenate([lower.ravel(), np.zeros(extra)]),
        np.concatenate([upper.ravel(), np.zeros(extra)]),
        9 * n,
        layout.names,
    )
    nlp = _with_slacks(nlp, 9 * n)
    return nlp, layout


def _visible(x: Float, off: Float, depth_ratio: float) -> Float:
    """Shrink the slopes of a presolve vector until every rim pixel is visible."""
    x = x.reshape(-1, 9).copy()
    least = np.einsum("nc,nvc->nv", x[:, 1:3], off).min(axis=1)
    limit = 0.95 * (1 / depth_ratio - 1)
    x[:, 1:3] *= np.minimum(1.0, limit / np.minimum(least, limit))[:, None]
    return x.ravel()


def _finish(
    name: str,
    b: _Builder,
    x0: Float,
    lbx: Float,
    ubx: Float,
    own: int,
    names: Callable[[], list[str]],
) -> NLP:
    offset = own
    for _, lower, upper in b.x_extra:
        lbx[offset : offset + len(lower)] = lower
        ubx[offset : offset + len(upper)] = upper
        offset += len(lower)
    f = b.form
    return assemble(
        name,
        tuple(b.groups),
        x0=np.clip(x0, lbx, ubx),
        lbx=lbx,
        ubx=ubx,
        lbg=np.concatenate(b.lbg),
        ubg=np.concatenate(b.ubg),
        theta=dict(zip(THETA, (f.eps, f.eps_pixel, f.theta, f.ridge))),
        hessian=f.hessian,
        x_names=lambda: _names(names(), b.x_blocks),
        g_names=partial(_names, [], b.g_blocks),
        compiled=f.compiled,
    )


def _with_slacks(nlp: NLP, own: int) -> NLP:
    """Start slack variables at the norms' values and switches where they are optimal."""
    if nlp.nx == own:
        return nlp
    x0 = nlp.x0.copy()
    for group in nlp.groups:
        kernel, table = group.kernel, group.table
        extra = np.flatnonzero(table.index[0] >= own)
        if not len(extra):
            continue
        _fill(kernel, table, extra, x0, nlp.p[: len(nlp.theta)])
    from dataclasses import replace

    return replace(nlp, x0=x0)


def _fill(kernel: Kernel, table: Table, extra: Int, x0: Float, theta: Float) -> None:
    size = len(table)
    th = np.repeat(theta[:, None], size, axis=1)
    slacks = [j for j in extra if kernel.x[int(j)].name().startswith("s_")]
    switches = [j for j in extra if kernel.x[int(j)].name().startswith("z_")]
    if slacks and kernel.constraints is not None:
        # constraint is s^2 - |v|^2, so at s = 0 its negative is |v|^2
        con = ca.Function("c", [kernel.x, kernel.row, kernel.theta], [kernel.constraints])
        local = x0[table.index].copy()
        local[:, slacks] = 0.0
        value = np.asarray(con.map(size)(local.T, table.data.T, th)).reshape(len(slacks), size)
        for j, v in zip(slacks, value):
            x0[table.index[:, j]] = np.sqrt(np.maximum(-v, 0.0)) + 1e-6
    if switches and kernel.objective is not None:
        # the objective is linear in a switch: its slope says which end is better
        slope = ca.gradient(kernel.objective, kernel.x)
        fun = ca.Function("s", [kernel.x, kernel.row, kernel.theta], [slope])
        value = np.asarray(fun.map(size)(x0[table.index].T, table.data.T, th))
        for j in switches:
            x0[table.index[:, j]] = np.where(value[j] < 0, 0.99, 0.01)
