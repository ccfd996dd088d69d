"""The exact energy of a soup in NumPy, for reports and as reference of the symbolic model."""

from collections.abc import Mapping

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.elements import PROJ, TERMS, present
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulas import Ends, GraphName, ends_of, reprojection


def energy(soup: Soup, data: EnergyData, weights: Weights) -> dict[str, float]:
    """E ("total") and every term that is present, with its factor.

    Only the geometry of the soup matters, not its gauge nor its global scale.
    """
    ends = ends_of(soup, data)
    terms = {
        name: getattr(weights, name) * float(values(name, soup, data, weights, ends).sum())
        for name in present(data)
    }
    return {"total": sum(terms.values()), **terms}


def values(
    name: str,
    soup: Soup,
    data: EnergyData,
    weights: Weights,
    ends: Mapping[GraphName, Ends] | None = None,
) -> Float:
    """A term of `elements.TERMS` of every superpixel ("proj", (N,)), edge (E,) or neighbour pair
    (P,), without factor; `ends` are `ends_of` the soup where they are known."""
    term = TERMS[name]
    if term is PROJ:
        H = soup.R - soup.t[:, :, None] * soup.n[:, None, :] / soup.d[:, None, None]
        return reprojection(H[:, None], data, weights)[0][:, 0]
    assert term.cost
    assert term.graph
    cost = term.cost((ends or ends_of(soup, data))[term.graph], weights)[:, 0, 0]
    return np.asarray(np.abs(getattr(data, term.weight)) * cost)
