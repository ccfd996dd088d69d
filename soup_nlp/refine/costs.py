"""Costs of particles: E_proj of every label, the other terms of every pair of labels, in numpy.

The sum of the costs of chosen labels equals `oracle.energy` of the soup that they make: it is the
same energy as a pairwise MRF, and its terms are those of `model.oracle`.
"""

import numpy as np

from soup_nlp.arrays import AnyFloat, Float, Int, Mask
from soup_nlp.model.elements import TERMS
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulas import Ends, GraphName, States, reprojection
from soup_nlp.refine.particles import Particles

BLOCK_BYTES = 1 << 18  # one of the half dozen buffers of a block of edges
UNARY_BYTES = 1 << 23  # one of the arrays of a block of superpixels


def feasible(p: Particles, visibility_ray: Float, min_facing: float) -> Mask:
    """(N, L) whether `-n . v >= min_facing` on every row of `EnergyData.visibility_ray`.

    SO(3), unit normals and positive scales hold for every particle by construction.
    """
    facing = -np.matmul(p.n, np.swapaxes(visibility_ray, 1, 2))
    return np.asarray((facing.min(axis=2) >= min_facing) & (p.D > 0))


def unary_costs(
    p: Particles, data: EnergyData, weights: Weights, superpixels: Int | None = None
) -> tuple[Float, Mask]:
    """(N, L) alpha1 E_proj of every particle, and whether it keeps its pixels in front of the
    camera; the particles are those of `superpixels` (N,), by default of all in order."""
    n_nodes, n_labels = p.shape
    out, ahead = np.empty(p.shape), np.empty(p.shape, bool)
    index = np.arange(n_nodes) if superpixels is None else superpixels
    step = max(1, UNARY_BYTES // (8 * 3 * n_labels * max(1, data.pixel_ray.shape[1])))
    for a in range(0, n_nodes, step):
        b = slice(a, a + step)
        out[b], ahead[b] = reprojection(p.subset(b).homographies, data, weights, index[b])
    out *= weights.proj
    return out, ahead & np.isfinite(out)


class PairCosts:
    """Pairwise costs over the union of the K-NN and the neighbour graph.

    Attributes:
        edges: (E, 2) union of `data.edges` and `data.pairs`, i < k, each pair once.
        rows: For both graphs by name, (E,) the row of each of these, -1 where there is none.
    """

    def __init__(self, data: EnergyData, weights: Weights) -> None:
        self.data, self.weights = data, weights
        n = len(data)
        graphs: dict[GraphName, Int] = {"edges": data.edges, "pairs": data.pairs}
        keys = {name: e[:, 0] * n + e[:, 1] for name, e in graphs.items()}
        key = np.union1d(*keys.values())
        self.edges: Int = np.stack([key // n, key % n], axis=1)
        self.rows = {name: np.full(len(key), -1) for name in keys}
        for name, own in keys.items():
            self.rows[name][np.searchsorted(key, own)] = np.arange(len(own))

    def tables(
        self, p: Particles, unit: float = 1.0, dtype: type | np.dtype = np.float64
    ) -> AnyFloat:
        """(E, L, L) weighted sum of all terms but E_proj, by edge and pair of labels.

        `unit` is the scene's, `sum_i c_i D_i`, where lengths are not local; float32 takes half the
        memory of float64.
        """
        data, labels = self.data, p.shape[1]
        out = np.zeros((len(self.edges), labels, labels), dtype)
        states = States(p.n, p.D, p.R, p.T, data.anchor_ray, dtype)
        step = max(1, BLOCK_BYTES // (out.itemsize * labels * labels))
        for graph, rows in self.rows.items():
            present = np.flatnonzero(rows >= 0)
            terms = [
                (term, getattr(self.weights, name) * np.abs(getattr(data, term.weight)))
                for name, term in TERMS.items()
                if term.graph == graph
            ]
            for a in range(0, len(present), step):
                at = present[a : a + step]
                ends = Ends(states, data, graph, unit, rows[at])
                for term, weight in terms:
                    if weight[rows[at]].any():
                        assert term.cost
                        out[at] += ends.column(weight) * term.cost(ends, self.weights)
        return out
