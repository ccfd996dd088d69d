"""Records of the family in the package: superpixels, start and best known point by problem."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int
from soup_nlp.config.problem import Problem, make_problem
from soup_nlp.errors import DataError
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_options import Weights
from soup_nlp.storage.files import write_bytes


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
        prior_weight: (E,) weight of E_prior of every edge. It is stored, so that the rules for it
            can change without a new version of the family.
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
    proposal: Float
    minimum: Float

    @cached_property
    def problem(self) -> Problem:
        """The merged problem."""
        raw = yaml.safe_load(self.text)
        # options of earlier code, whose weights and start are stored in the record
        return make_problem(_present({k: v for k, v in raw.items() if k != "start"}, Problem))

    def weights(self, own: Weights) -> Weights:
        """Constants of the energy: those of the record where surfaces bend, else `own`.

        Early records list all constants for surfaces that bend, E_orient's for N = 1,000.
        """
        energy = yaml.safe_load(self.text)["energy"]
        if not self.bending or "bending" not in energy:
            return own
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


def encoded(soup: Soup) -> Float:
    """(N, 10) numbers of a soup with proper rotations."""
    R = soup.R
    trace = R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2]
    # w > 0, since rotations between two frames are far from 180 degrees
    w = np.sqrt(1 + trace) / 2
    turn = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    return np.column_stack([soup.distance, soup.n, turn / (4 * w[:, None]), soup.translation])


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


def save_frozen(path: Path, record: Frozen) -> None:
    """Write a record, whole or not at all; the same record gives the same bytes."""
    arrays: dict[str, NDArray[Any]] = {
        "problem": np.frombuffer(record.text.encode(), np.uint8),
        # differences along rows are mostly 0
        "labels": np.diff(record.labels, axis=1, prepend=0).astype(np.int16),
        "component": record.component.astype(np.int16),
        "surface": record.surface.astype(np.int16),
        "error": record.error.astype(np.float32),
        "bending": np.array(record.bending),
        "pair_weight": record.pair_weight.astype(np.float64),
        "prior_weight": record.prior_weight.astype(np.float64),
        "proposal": record.proposal.astype(np.float32),
        "minimum": record.minimum.astype(np.float64),
    }
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_LZMA) as archive:
        for name, value in arrays.items():
            part = io.BytesIO()
            np.save(part, value, allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), part.getvalue(), zipfile.ZIP_LZMA)
    write_bytes(path, target.getvalue())


def load_frozen(scene: str, size: int) -> Frozen:
    """The package's record of a scene and size.

    Raises:
        DataError: there is no such record.
    """
    return read_frozen(Path(str(files("soup_nlp.family") / "records" / f"{scene}-{size}.npz")))


def read_frozen(path: Path) -> Frozen:
    """A record of a file.

    Raises:
        DataError: the file is missing or cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as a:
            return Frozen(
                text=a["problem"].tobytes().decode(),
                labels=np.cumsum(a["labels"].astype(np.int32), axis=1, dtype=np.int32),
                component=a["component"].astype(np.int64),
                surface=a["surface"].astype(np.int64),
                error=a["error"].astype(np.float64),
                bending=bool(a["bending"]),
                pair_weight=a["pair_weight"],
                prior_weight=a["prior_weight"],
                proposal=a["proposal"].astype(np.float64),
                minimum=a["minimum"],
            )
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise DataError("record of the family cannot be read", where=path, found=error) from error
