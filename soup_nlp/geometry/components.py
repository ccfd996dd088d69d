"""The rigid components of a solved soup: their pixels and their motions."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.errors import DataError, printable, repr_of
from soup_nlp.geometry.camera import project, rays
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.rotation import RigidMotion, fit_motion
from soup_nlp.geometry.soup import Soup

SAME_PX = 0.5
"""Two motions count as one if they map a component's points within this distance, pixels."""
LEAST_PX = 0.05
"""Distance below which the weight of a point in a robust fit no longer grows, pixels."""
FITS = 20
"""Re-weighted fits of a motion."""


@dataclass(frozen=True, eq=False)
class Component:
    """A group of superpixels with one rigid motion.

    Attributes:
        label: Its number in the maps; 0 is the background.
        motion: next_from_ref, the camera's motion included, in the unit of the reconstruction.
        superpixels: Number of its superpixels.
        pixels: Number of its pixels.
        residual_px: Median distance, in the next image, between the component's points moved by
            `motion` and by their superpixels' motions, pixels; large if it is not rigid.
        interpolated: Share of its pixels whose depth is that of neighbours.
        centre: (3,) median of its points in the reference frame.
    """

    label: int
    motion: RigidMotion
    superpixels: int
    pixels: int
    residual_px: float
    interpolated: float
    centre: Float

    def __repr__(self) -> str:
        return (
            f"Component({self.label}, {self.superpixels} superpixels, {self.pixels} pixels,"
            f" {self.motion}, residual {self.residual_px:.2g} px)"
        )

    def scaled(self, factor: float) -> "Component":
        """The same in another unit of length, of which `factor` are one of now."""
        motion = RigidMotion(self.motion.R, factor * self.motion.t)
        return replace(self, motion=motion, centre=factor * self.centre)


@dataclass(frozen=True, eq=False)
class Components:
    """All rigid components: that of the static scene, then by decreasing number of pixels.

    Attributes:
        of_superpixel: (N,) label of every superpixel.
        of_pixel: (H, W) label of every pixel of the reference image.
        members: The components; `members[c].label == c`.
    """

    of_superpixel: Int
    of_pixel: NDArray[np.int32]
    members: tuple[Component, ...]

    def __len__(self) -> int:
        return len(self.members)

    def __getitem__(self, label: int) -> Component:
        try:
            return self.members[label]
        except (IndexError, TypeError):
            raise DataError(
                "there is no such component",
                found=f"{type(label).__name__} {printable(repr_of(label), 60)}",
                expected=f"0 (the background) to {len(self) - 1}",
            ) from None

    def __iter__(self) -> Iterator[Component]:
        return iter(self.members)

    def __repr__(self) -> str:
        share = self.background.pixels / self.of_pixel.size
        return f"Components({len(self)}, background {share:.0%} of the pixels)"

    @property
    def background(self) -> Component:
        """The component of the static scene."""
        return self.members[0]

    @property
    def camera(self) -> RigidMotion:
        """next_from_ref of the static scene; its `centre` is the next camera's."""
        return self.background.motion

    def own_motion(self, label: int) -> RigidMotion:
        """Motion of a component relative to the static scene, as seen by a camera at rest; the
        identity for the background."""
        return self.camera.inverse @ self[label].motion


def find_components(
    soup: Soup,
    seg: Segmentation,
    group: Int,
    K_ref: Float,
    K_next: Float,
    interpolated: Mask | None = None,
) -> Components:
    """One rigid motion for every group of superpixels; groups with the same motion are joined.

    A motion is fitted to the anchors and rims as their superpixels' motions move them: least
    absolute distances in the next image by re-weighted Procrustes fits; without a point in front of
    both cameras it is that of the first superpixel. The first of the groups (N,) is the background;
    `interpolated` (N,) marks superpixels with the depth of neighbours.
    """
    ray = rays(K_ref, np.concatenate([seg.anchors[:, None], seg.rim], axis=1))
    before = soup.points(ray)
    after = soup.moved(before)
    # points in front of both cameras are used
    front = (before[..., 2] > 0) & (after[..., 2] > 0)
    front &= np.isfinite(before).all(axis=2) & np.isfinite(after).all(axis=2)
    weight = np.broadcast_to(seg.sizes[:, None].astype(float), front.shape)
    label = np.unique(group, return_inverse=True)[1].ravel()
    count = np.bincount(label)
    motions: list[RigidMotion] = []
    joined = np.empty(len(count), np.int64)
    # then large groups first: a small group joins the large one with the same motion
    for c in [0, *(1 + np.argsort(-count[1:], kind="stable"))]:
        mask = label == c
        used = front & mask[:, None]
        x, y = before[used], after[used]
        gap = [float(np.median(_gap(m, x, y, K_next))) if len(x) else np.inf for m in motions]
        if gap and min(gap) <= SAME_PX:
            joined[c] = int(np.argmin(gap))
            continue
        joined[c] = len(motions)
        first = int(np.argmax(mask))
        own = RigidMotion(soup.R[first], soup.translation[first])
        motions.append(_fit(x, y, weight[used], K_next) if len(x) else own)
    label = joined[label]
    pixels = np.bincount(label, seg.sizes, len(motions)).astype(np.int64)
    order = np.concatenate([[0], 1 + np.argsort(-pixels[1:], kind="stable")])
    label = np.argsort(order)[label]
    by_others = np.zeros(len(soup), bool) if interpolated is None else interpolated
    members = []
    for c, old in enumerate(order):
        mask = label == c
        used = front & mask[:, None]
        x, motion = before[used], motions[old]
        off = _gap(motion, x, after[used], K_next)
        members.append(
            Component(
                label=c,
                motion=motion,
                superpixels=int(mask.sum()),
                pixels=int(pixels[old]),
                residual_px=float(np.median(off)) if len(x) else np.nan,
                interpolated=float(seg.sizes[mask & by_others].sum() / pixels[old]),
                centre=np.median(x, axis=0) if len(x) else np.full(3, np.nan),
            )
        )
    return Components(label, label[seg.labels].astype(np.int32), tuple(members))


def _gap(motion: RigidMotion, x: Float, y: Float, K: Float) -> Float:
    """(M,) distance in the image of points x, moved, from points y, pixels."""
    moved = motion(x)
    with np.errstate(divide="ignore", invalid="ignore"):
        gap = np.linalg.norm(project(K, moved) - project(K, y), axis=1)
    return np.where(moved[:, 2] > 0, gap, np.inf)


def _fit(x: Float, y: Float, size: Float, K: Float) -> RigidMotion:
    """The motion of least absolute distances in the image."""
    # lengths are relative to the depth of their points
    base = size / y[:, 2] ** 2
    motion = fit_motion(x, y, base)
    for _ in range(FITS):
        motion = fit_motion(x, y, base / np.maximum(_gap(motion, x, y, K), LEAST_PX))
    return motion
