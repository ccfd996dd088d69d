"""The terms of the energy: one object each, by which program, oracle and refinement find it."""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from soup_nlp.arrays import AnyFloat, Float, Int
from soup_nlp.model import formulas, terms
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulas import Ends, GraphName
from soup_nlp.model.layout import Layout
from soup_nlp.model.norms import Norm


@dataclass(frozen=True)
class Element:
    """One kind of element: its superpixels (E, a), data (E, ...) by column, and the function of
    `terms` that makes its norms from their views, its row and further arguments `given`."""

    superpixels: Int
    columns: dict[str, Float]
    norms: Callable[..., list[Norm]]
    given: tuple[Hashable, ...] = ()

    @property
    def fields(self) -> dict[str, int]:
        """Width of every data column."""
        return {k: int(np.prod(v.shape[1:], dtype=int)) for k, v in self.columns.items()}


@dataclass(frozen=True)
class Term:
    """A term of the energy: the sum over its elements of factor x weight x truncated norms.

    Attributes:
        name: Also the field of `Weights` with its factor.
        table: Its elements: superpixels, data with truncations, and the formula in symbols.
        weight: Field of `EnergyData` whose absolute value multiplies its elements.
        graph: Graph whose rows they are; None for the pixels of superpixels.
        cost: (b, L, L) the formula in numpy without weight, truncated, for rows of the graph.
        given: Whether its data is missing, all weights 0, for most pairs.
        optional: Whether a factor of 0 leaves it out.
    """

    name: str
    table: Callable[[EnergyData, Weights], Element]
    weight: str
    graph: GraphName | None = None
    cost: Callable[[Ends, Weights], AnyFloat] | None = None
    given: bool = False
    optional: bool = True


def present(data: EnergyData) -> tuple[str, ...]:
    """Names of the terms that the energy of a pair has."""
    return tuple(k for k, t in TERMS.items() if not t.given or getattr(data, t.weight).any())


def elements(data: EnergyData, w: Weights, layout: Layout) -> dict[str, Element]:
    """The elements of the paper's terms, and of others that are present and have a factor, with the
    columns that the layout's views need."""
    used = [TERMS[k] for k in present(data) if not TERMS[k].optional or getattr(w, k) > 0]
    out = {term.name: term.table(data, w) for term in used}
    for element in out.values():
        for a, i in enumerate(element.superpixels.T):
            element.columns.update({f"{k}_{a}": v for k, v in layout.columns(i).items()})
    return out


def _truncations(count: int, **sigma: float) -> dict[str, Float]:
    """Constant columns of the truncations that are finite; a norm without one is not truncated."""
    return {k: np.full(count, v) for k, v in sigma.items() if np.isfinite(v)}


def _rays(data: EnergyData, ends: Int) -> dict[str, Float]:
    """Anchor rays of both superpixels of pairs (E, 2)."""
    return {"ray_i": data.anchor_ray[ends[:, 0]], "ray_k": data.anchor_ray[ends[:, 1]]}


def _pixel(data: EnergyData, unit: Float) -> dict[str, Float]:
    """A pixel as a length at the mean plane distance 1 / unit, and as an angle, for the smoothing
    of norms that are not in pixels."""
    if data.local_units:
        return {}
    angle = np.full(len(unit), 1.0 / data.K_next[0, 0])
    return {"pixel": angle / unit, "angle": angle}


def _arap(data: EnergyData, w: Weights) -> Element:
    e = data.edges
    columns = {
        "weight": w.arap * data.edge_weight,
        "unit": data.edge_unit,
        "turn": data.rotation_scale,
        **_truncations(len(e), sigma=w.sigma_arap),
        "leak": np.full(len(e), w.leak_arap),
        **_rays(data, e),
        **_pixel(data, data.edge_unit),
    }
    return Element(e, columns, terms.arap, (data.arap_at_anchors,))


def _proj(data: EnergyData, w: Weights) -> Element:
    used = data.pixel_weight > 0
    owner, count = np.nonzero(used)[0][:, None], int(used.sum())
    # intrinsics are data, so that kernels derived once serve every camera
    K = data.K_next[:2]
    nonzero = np.nonzero(K.T)[::-1]
    columns = {
        "weight": w.proj * data.pixel_weight[used],
        **_truncations(count, sigma=w.sigma_proj),
        "ray": data.pixel_ray[used],
        "target": data.pixel_target[used],
        "K": np.tile(K[nonzero], (count, 1)),
    }
    places = tuple(zip(*(index.tolist() for index in nonzero)))
    return Element(owner, columns, terms.reprojection, (places,))


def _cont(data: EnergyData, w: Weights) -> Element:
    pairs = data.pairs
    columns = {
        "weight": w.cont * data.pair_weight,
        "factor": data.pair_factor / data.pair_unit,
        **_truncations(len(pairs), sigma_ref=w.sigma_cont_ref, sigma=w.sigma_cont),
        **_rays(data, pairs),
        "rays": data.boundary_ray.reshape(len(pairs), 3 * data.boundary_ray.shape[1]),
        **_pixel(data, data.pair_unit),
    }
    return Element(pairs, columns, terms.continuity)


def _prior(data: EnergyData, w: Weights) -> Element:
    rays = _rays(data, data.edges)
    columns = {
        "weight": w.prior * data.prior_weight,
        "reach": np.linalg.norm(rays["ray_i"] - rays["ray_k"], axis=1),
        **rays,
    }
    if data.prior_relief.any():
        columns["relief"] = data.prior_relief
    return Element(data.edges, columns, terms.prior)


def _depth(data: EnergyData, w: Weights) -> Element:
    used = data.depth_weight > 0
    edges = data.edges[used]
    columns = {
        "weight": w.depth * data.depth_weight[used],
        "change": data.depth_change[used],
        **_rays(data, edges),
    }
    return Element(edges, columns, terms.depth)


def _order(data: EnergyData, w: Weights) -> Element:
    used = np.flatnonzero(data.order_weight)
    pairs, sign = data.pairs[used], np.sign(data.order_weight[used])
    # the covered superpixel first
    pairs = np.where(sign[:, None] > 0, pairs, pairs[:, ::-1])
    columns = {
        "weight": w.order * np.abs(data.order_weight[used]),
        "step": data.order_step[used],
        "ray": data.boundary_ray[used].mean(axis=1),
        **_rays(data, pairs),
    }
    return Element(pairs, columns, terms.order)


def _orient(data: EnergyData, w: Weights) -> Element:
    columns = {
        "weight": w.orient * data.orient_weight,
        **_truncations(len(data.pairs), sigma=w.sigma_orient),
    }
    if data.orient_turn.any():
        columns["turn"] = data.orient_turn
    return Element(data.pairs, columns, terms.orientation)


PROJ = Term("proj", _proj, "pixel_weight", optional=False)
"""The one term of single superpixels: `formulas.reprojection`."""
TERMS: Mapping[str, Term] = {
    term.name: term
    for term in (
        Term("arap", _arap, "edge_weight", "edges", formulas.arap, optional=False),
        PROJ,
        Term("cont", _cont, "pair_weight", "pairs", formulas.continuity, optional=False),
        Term("orient", _orient, "orient_weight", "pairs", formulas.orientation, optional=False),
        Term("prior", _prior, "prior_weight", "edges", formulas.prior),
        Term("depth", _depth, "depth_weight", "edges", formulas.depth, given=True),
        Term("order", _order, "order_weight", "pairs", formulas.order, given=True),
    )
}
"""All terms, in the order of printing."""
