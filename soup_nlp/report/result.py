"""A solved pair for pictures, the page and files, from a run in memory or from a result folder."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from PIL.Image import Image as Picture
from PIL.Image import fromarray

from soup_nlp.arrays import Float, Image, Mask
from soup_nlp.errors import DataError
from soup_nlp.evaluation.confidence import KINDS, MOST_SIGMA
from soup_nlp.evaluation.metrics import DepthMetrics
from soup_nlp.evaluation.scoring import DEPTHS
from soup_nlp.geometry.components import Components, find_components
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.plane import inverse_depth
from soup_nlp.geometry.rotation import RigidMotion
from soup_nlp.geometry.soup import Reconstruction, Soup, reconstruct
from soup_nlp.geometry.surface import at_jumps, hidden, joined
from soup_nlp.pipeline.record import Run
from soup_nlp.report.chain import UNIT, Chain
from soup_nlp.report.figures import shown
from soup_nlp.report.findings import drawn_line
from soup_nlp.report.layout import Stored, result_tree
from soup_nlp.report.pictures import overview, pictures
from soup_nlp.storage.files import plain
from soup_nlp.storage.store import ReadTree, require

PAGE = "report.html"
RENAMED = {"interpolated": "borrowed", "origin": "tie"}
"""Arrays of "start", and their names in results before December 2026."""


@dataclass(frozen=True, eq=False)
class Result:
    """What is stored of a solved pair, with its dense 3D and components.

    Attributes:
        tree: Arrays as in result.h5.
        summary: Contents of summary.json.
        reconstruction: Dense 3D of both frames.
        components: Rigid components with their motions.
        metrics: Scores against the truth, as those of a `Run`.
        kind: (H, W) by what the depth of the reference frame is known, an index of `KINDS`.
    """

    tree: ReadTree
    summary: Mapping[str, Any]
    reconstruction: Reconstruction
    components: Components
    metrics: Mapping[str, DepthMetrics]
    kind: Image

    def __repr__(self) -> str:
        h, w = self.images[0].shape[:2]
        return f"Result({self.name}, {w}x{h}, {self.reconstruction}, {self.components})"

    def plot(self) -> Picture:
        """The overview as a picture: notebooks show it, `.save` writes it."""
        return fromarray(overview(pictures(Chain.of(self)), self.title))

    def _repr_html_(self) -> str:
        return shown(str(self), np.asarray(self.plot()))

    @property
    def title(self) -> str:
        """The name, and the share that is drawn."""
        return ": ".join(filter(None, [self.name, drawn_line(self.summary["certainty"])]))

    @property
    def name(self) -> str:
        """Name for titles."""
        return str(self.summary.get("name", ""))

    @property
    def images(self) -> tuple[Image, Image]:
        """(H, W, 3) and (H', W', 3) uint8 RGB."""
        return self.tree["input"]["image_ref"], self.tree["input"]["image_next"]

    @property
    def K(self) -> Float:
        """(3, 3) intrinsics of the reference frame, pixels."""
        return np.asarray(self.tree["input"]["K_ref"], float)

    @property
    def K_next(self) -> Float:
        """(3, 3) intrinsics of the next frame, pixels."""
        return np.asarray(self.tree["input"]["K_next"], float)

    @property
    def flow(self) -> NDArray[np.floating]:
        """(H, W, 2) flow from the reference to the next frame, pixels."""
        return np.asarray(self.tree["input"]["flow"])

    @property
    def flow_confidence(self) -> NDArray[np.floating]:
        """(H, W) confidence of the flow, 0 to 1."""
        return np.asarray(self.tree["input"]["confidence"])

    @property
    def camera(self) -> RigidMotion:
        """next_from_ref of the static scene."""
        return self.components.camera

    @property
    def depths(self) -> tuple[Float, Float]:
        """z of both frames, each at its own pixels; NaN where unknown."""
        return self.reconstruction.depth_ref, self.reconstruction.depth_next

    @property
    def depth_maps(self) -> dict[str, Float]:
        """(H, W) z of the reference frame, as those of a `Run`."""
        stored = self.tree.get("depth", {})
        return {name: stored[key] for name, key in DEPTHS.items() if key in stored}

    @property
    def true_depth(self) -> Float | None:
        """(H, W) true z of the reference frame, NaN where unknown; None without dense truth."""
        return self.tree["truth"].get("depth_ref")

    @property
    def unit(self) -> str:
        """Unit of length as a phrase for headers of files."""
        if self.metre is None:
            return UNIT
        return f"{UNIT}; about {self.metre:.6g} {self.metre_unit} by the truth of this pair"

    @property
    def sigma(self) -> Float:
        """(H, W) standard deviation of log depth of the reference frame."""
        assert self.reconstruction.sigma_ref is not None
        return self.reconstruction.sigma_ref

    @property
    def drawn(self) -> Mask:
        """(H, W) True where nothing tells the depth of the reference frame."""
        return np.asarray(self.kind == KINDS.index("drawn"))

    def in_next(self, values: NDArray[Any], unknown: float) -> NDArray[Any]:
        """(H', W') values of the reference frame where the next frame shows their points."""
        source = self.reconstruction.source_next
        return np.where(source >= 0, values.ravel()[source], unknown)

    @cached_property
    def planes(self) -> tuple[Float, Float]:
        """(N, 3) m of every superpixel with depth 1 / (m . ray), in both frames."""
        soup = self.soup
        ref = inverse_depth(soup.n, soup.distance)
        turned = np.einsum("nij,nj->ni", soup.R, ref)
        ahead = 1.0 + np.einsum("nj,nj->n", turned, soup.translation)
        return ref, turned / ahead[:, None]

    @property
    def metre(self) -> float | None:
        """Units of the truth in one unit of length of the result; None where it is not known."""
        scale = self.metrics["solution"].scale if "solution" in self.metrics else np.nan
        return scale if np.isfinite(scale) else None

    @property
    def metre_unit(self) -> str:
        """Name of the unit of the truth."""
        return str(self.summary.get("truth_unit") or "m")

    @property
    def detail(self) -> Float:
        """(H, W) log depth of the reference frame relative to the planes."""
        found = self.reconstruction.detail
        return np.zeros(self.labels.shape) if found is None else found

    @property
    def labels(self) -> NDArray[np.integer]:
        """(H, W) superpixel of every pixel."""
        return self.reconstruction.labels

    @property
    def bends(self) -> Mask:
        """(N,) True for the superpixels of regions that bend; if all do, no component is rigid."""
        return np.asarray(self.tree["start"]["bends"], bool)

    @property
    def soup(self) -> Soup:
        """Planes and motions of the superpixels."""
        return self.reconstruction.soup

    def scaled(self, factor: float) -> Self:
        """The same result in another unit of length, of which `factor` are one of now."""
        rec, soup, parts = self.reconstruction, self.soup, self.components
        lengths = ("depth_ref", "depth_next", "points_ref", "points_next")
        changes = {name: factor * getattr(rec, name) for name in lengths}
        rec = replace(rec, soup=replace(soup, lam=factor * soup.lam), **changes)
        members = tuple(part.scaled(factor) for part in parts)
        metrics = {k: replace(m, scale=m.scale / factor) for k, m in self.metrics.items()}
        parts = replace(parts, members=members)
        return replace(self, reconstruction=rec, components=parts, metrics=metrics)

    @cached_property
    def surface(self) -> tuple[Mask, Mask]:
        """Continuity of the surface to the right and downwards, see `geometry.surface.joined`."""
        return joined(self.planes[0], self.labels, self.components.of_pixel, self.K, self.detail)

    @cached_property
    def sure(self) -> Mask:
        """(H, W) pixels of clouds: visible in both frames, confident, not at a depth jump."""
        return (self.sigma <= MOST_SIGMA) & ~hidden(self.reconstruction) & ~at_jumps(*self.surface)

    @property
    def static(self) -> Mask:
        """(H, W) confident pixels of the static scene."""
        return np.asarray(self.sure & (self.components.of_pixel == 0))


def result_of(run: Run, summary: Mapping[str, Any]) -> Result:
    """The result of a run; `summary` are the contents of summary.json."""
    return Result(
        tree=result_tree(run),
        summary=plain(summary),
        reconstruction=run.reconstruction,
        components=run.components,
        metrics=run.metrics,
        kind=run.confidence.kind,
    )


def load(folder: str | Path) -> Result:
    """The result of a folder, see `sequence.folder.load`."""
    stored = Stored.read(folder)
    tree, summary = stored.tree, stored.claims
    try:
        needed = ("image_ref", "image_next", "confidence", "K_ref", "K_next")
        *_, K_ref, K_next = (require(tree, f"input/{name}") for name in needed)
        soup = Soup(**stored.soup("solution"))
        planes = np.isfinite(soup.lam * soup.d).all()
        if not planes or not (np.abs(np.linalg.det(soup.R) - 1) < 1e-3).all():
            raise ValueError("planes or rotations of the solution are none")
        sigma = require(tree, "depth/sigma_ref")
        given = {f.name: tree["segmentation"].get(f.name) for f in fields(Segmentation)}
        seg, (height, width) = Segmentation(**given), tree["depth"]["next"].shape
        detail = tree["depth"].get("detail")
        rec = reconstruct(soup, seg.labels, K_ref, K_next, (height, width), detail)
        start = tree["start"]
        for name, older in RENAMED.items():
            if older in start:
                start[name] = start.pop(older)
        parts = start["part"], K_ref, K_next, start["interpolated"].astype(bool)
        return Result(
            tree=tree,
            summary=summary,
            reconstruction=replace(rec, sigma_ref=sigma),
            components=find_components(soup, seg, *parts),
            metrics={name: _metrics(row) for name, row in summary["metrics"].items()},
            kind=require(tree, "confidence/kind"),
        )
    except (LookupError, ValueError, TypeError, AttributeError) as error:
        what = "result does not hold together"
        raise DataError(what, where=stored.folder, found=error) from error


def _metrics(row: Mapping[str, Any]) -> DepthMetrics:
    """Scores of summary.json, in which null stands for NaN."""
    names = [f.name for f in fields(DepthMetrics) if f.name != "shift"]
    scores: dict[str, Any] = {k: np.nan if row[k] is None else row[k] for k in names}
    return DepthMetrics(**(scores | {"cap": row["cap"]}))
