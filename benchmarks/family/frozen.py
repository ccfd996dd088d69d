"""Records of the family: superpixels, start and best known point by problem."""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from soup_nlp import Problem, Soup, make_problem
from soup_nlp.arrays import Float, Int
from soup_nlp.errors import DataError
from soup_nlp.model.energy_options import Weights


@dataclass(frozen=True)
class Frozen:
    """Record of one scene and size.

    Soups are stored as (N, 10): plane distance, normal, vector part of the quaternion of the
    rotation, translation. Decoding uses only sums, products, quotients and square roots, which by
    IEEE 754 have the same results on every processor.

    Attributes:
        text: The whole problem file, so that it does not depend on the defaults of the package.
        labels: (H, W) int32 superpixels.
        component: (N,) rigid component of every superpixel in the proposal.
        surface: (N,) surface, see `Start`.
        error: (N,) mean re-projection error of the proposal, pixels.
        bending: Whether surfaces are treated as bending.
        pair_weight: (P,) colour weight w4 of every pair of neighbours. It is stored, since a few
            pixels of the rendered image lie between two grey levels, and the processor's rounding
            decides which one they take.
        prior_weight: (E,) weight of E_prior of every edge. It and the shares are stored, so that
            the rules for them can change without a new version of the family.
        edge_share: (E,) factor of w1 and w2.
        pair_share: (P,) factor of w4.
        orient_share: (P,) factor of the weight of E_orient.
        proposal: (N, 10) the proposal.
        minimum: (N, 10) the best known point, an answer of Ipopt.
    """

    text: str
    labels: NDArray[np.int32]
    component: Int
    surface: Int
    error: Float
    bending: bool
    pair_weight: Float
    prior_weight: Float
    edge_share: Float
    pair_share: Float
    orient_share: Float
    proposal: Float
    minimum: Float

    @cached_property
    def problem(self) -> Problem:
        """The merged problem."""
        raw = yaml.safe_load(self.text)
        # options of earlier code, whose weights and start are stored in the record
        return make_problem(_present({k: v for k, v in raw.items() if k != "start"}, Problem))

    def weights(self, default: Weights) -> Weights:
        """Constants of the energy: those of the record where surfaces bend, else `default`.

        Early records list all constants for surfaces that bend, E_orient's for N = 1,000.
        """
        energy = yaml.safe_load(self.text)["energy"]
        if not self.bending or "bending" not in energy:
            return default
        stored = Weights(**energy["bending"]["weights"])
        return stored.replace(orient=stored.orient * (self.labels.max() + 1) / 1000)

    @property
    def start(self) -> Soup:
        """The proposal."""
        return decoded(self.proposal)

    @property
    def best(self) -> Soup:
        """The best known point."""
        return decoded(self.minimum)


def _present(raw: Mapping[str, Any], section: Any) -> dict[str, Any]:
    """The options that a section and its own sections still have."""
    out = {}
    for key, value in raw.items():
        if key in section.model_fields:
            inner = section.model_fields[key].annotation
            out[key] = _present(value, inner) if hasattr(inner, "model_fields") else value
    return out


def decoded(numbers: Float) -> Soup:
    """The soup of (N, 10) numbers, with normals and rotations exact to rounding."""
    D, T = numbers[:, 0], numbers[:, 7:]
    a, b, c = numbers[:, 1:4].T
    n = numbers[:, 1:4] / np.sqrt(a * a + b * b + c * c)[:, None]
    x, y, z = numbers[:, 4:7].T
    w = np.sqrt(1 - (x * x + y * y + z * z))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    R = np.stack([np.stack(row, axis=1) for row in rows], axis=1)
    return Soup(D, n, np.ones(len(D)), R, T / D[:, None])


STORED = {
    **dict.fromkeys(("component", "surface"), np.int16),
    **dict.fromkeys(("error", "proposal"), np.float32),
    **dict.fromkeys(("pair_weight", "prior_weight", "minimum"), np.float64),
    **dict.fromkeys(("edge_share", "pair_share", "orient_share"), np.float64),
    "bending": np.bool_,
}
"""Types of the arrays of a record in its file. The file also has the text, and the labels as
differences along rows, which are mostly 0."""
WIDE = {"i": np.int64, "f": np.float64, "b": np.bool_}
"""Types in memory by kind."""
RECORDS = Path(__file__).with_name("records")


def load_frozen(scene: str, size: int) -> Frozen:
    """The record of a scene and size, from its file."""
    path = RECORDS / f"{scene}-{size}.npz"
    try:
        with np.load(path, allow_pickle=False) as a:
            return Frozen(
                text=a["problem"].tobytes().decode(),
                labels=np.cumsum(a["labels"].astype(np.int32), axis=1, dtype=np.int32),
                **{name: a[name].astype(WIDE[a[name].dtype.kind])[()] for name in STORED},
            )
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise DataError("record of the family cannot be read", where=path, found=error) from error
