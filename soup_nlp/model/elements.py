"""The four terms of the energy as kinds of elements: their norms, data columns and views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.model import terms
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.layout import MatrixLayout, TangentLayout
from soup_nlp.model.norms import Norm
from soup_nlp.model.superpixel import View

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True)
class Element:
    """One kind of element: its local superpixel views and where their variables are.

    Attributes:
        arity: Superpixels of an element, a.
        fields: Width of every data column, in their order.
        columns: (E, ...) data by column.
        index: (E, a) superpixels, or once placed (E, a k) variables, of every element.
        norms: Makes the norms from the a views, a data row, eps and eps_pixel.
    """

    arity: int
    fields: dict[str, int]
    columns: dict[str, Float]
    index: Int
    norms: Callable[[list[View], dict[str, ca.SX], ca.SX, ca.SX], list[Norm]]

    def placed(self, layout: TangentLayout | MatrixLayout) -> Element:
        """The element with variables of a layout in the place of superpixels."""
        of = [layout.of(c) for c in self.index.T]
        return replace(self, index=np.concatenate(of, axis=1))


def elements(
    data: EnergyData, w: Weights, layout: TangentLayout | MatrixLayout
) -> dict[str, Element]:
    """The four terms as element kinds, with the columns that the layout's views need.

    Args:
        data: Pixels, graphs and weights of the pair.
        w: Constants of the energy.
        layout: Whose variables the views are made of.

    Returns:
        "arap", "proj", "cont", "orient".
    """

    def base(columns: dict[str, Float], sp: Int) -> tuple[dict[str, int], dict[str, Float]]:
        extra: dict[str, Float] = {}
        for a in range(sp.shape[1]):
            i = sp[:, a]
            if isinstance(layout, TangentLayout):
                extra[f"anchor_{a}"] = layout.anchor[i]
                extra[f"radius_{a}"] = layout.radius[i]
                extra[f"depth_{a}"] = layout.depth[i]
                extra[f"R0_{a}"] = layout.R0[i].transpose(0, 2, 1).reshape(-1, 9)
                extra[f"t0_{a}"] = layout.t0[i]
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
    out["arap"] = Element(
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
    # intrinsics are data, so that kernels compiled once serve every camera
    K = ca.sparsify(ca.DM(data.K_next[:2]))
    fields, columns = base(
        {
            "weight": w.proj * data.pixel_weight.ravel()[used],
            "sigma": full(int(used.sum()), w.sigma_proj),
            "ray": data.pixel_ray.reshape(-1, 3)[used],
            "target": data.pixel_target.reshape(-1, 2)[used],
            "K": np.tile(K.nonzeros(), (len(owner), 1)),
        },
        owner,
    )
    out["proj"] = Element(
        1,
        fields,
        columns,
        owner,
        lambda v, row, _, eps: terms.reprojection(
            v[0], row, eps, K.sparsity(), bool(np.isfinite(w.sigma_proj))
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
    out["cont"] = Element(
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
        {"weight": w.orient * data.orient_weight, "sigma": full(len(pairs), w.sigma_orient)}, pairs
    )
    out["orient"] = Element(
        2,
        fields,
        columns,
        pairs,
        lambda v, row, eps, _: terms.orientation(
            v[0], v[1], row, eps, bool(np.isfinite(w.sigma_orient))
        ),
    )
    return out
