"""A small ray caster for dynamic scenes: exact depth, flow and visibility, textured images.

A `Scene` consists of bodies, a body of parts that move together, and a part is a shape with a pose
and a texture. Rays are `K^-1 (u, v, 1)`, so the ray parameter of a hit is its depth z. Depth, flow,
labels and visibility are computed at pixel centres in closed form; only colour is averaged over the
pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, FloatMap, Image, Int, Mask
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.data.scenes.shapes import NEAR, Shape
from soup_nlp.data.scenes.texture import Texture
from soup_nlp.errors import DataError
from soup_nlp.geometry import camera

SAME_DEPTH = 1e-6
"""Largest relative difference of depth of two hits of the same point."""

TAPS = 3
"""Colour samples of a pixel along the direction of foreshortening."""

TILTED = 0.75
"""Cosine between normal and ray below which a surface gets `TAPS` colour samples."""

LIGHT = np.array([0.75, -0.85, -0.35]) / np.linalg.norm([0.75, -0.85, -0.35])
"""Direction towards the light in scene coordinates at the reference time."""


def inverse(pose: Float) -> Float:
    """The inverse (4, 4) of a rigid transform (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -out[:3, :3] @ pose[:3, 3]
    return out


@dataclass(frozen=True)
class Part:
    """A textured shape at a pose.

    Attributes:
        shape: The surface, in its own coordinates.
        scene_from_part: (4, 4) rigid pose at the reference time.
        texture: Colours by material coordinates.
        glow: Share of the colour that does not depend on the light; 1 for no shading (sky).
        motion: (4, 4) motion in scene coordinates before that of the body, such as of a limb.
    """

    shape: Shape
    scene_from_part: Float
    texture: Texture
    glow: float = 0.45
    motion: Float = field(default_factory=lambda: np.eye(4))

    def colour(self, points: Float, footprint: Float, frame: int) -> FloatMap:
        """Colours (N, 3) of points (N, 3) in part coordinates; shading moves with the surface."""
        material = self.shape.material(points, frame)
        normals = self.shape.normals(self.shape.place(material, 0), 0)
        light = self.scene_from_part[:3, :3].T @ LIGHT
        shade = self.glow + (1 - self.glow) * (0.5 + 0.5 * normals @ light)
        colour = self.texture.colour(material, self.shape.chart(material), footprint)
        return colour * shade[:, None].astype(np.float32)


@dataclass(frozen=True)
class Body:
    """Parts that move together.

    Attributes:
        parts: Parts of the body.
        motion: (4, 4) motion in scene coordinates from the reference to the next time.
    """

    parts: Sequence[Part]
    motion: Float = field(default_factory=lambda: np.eye(4))

    @property
    def bends(self) -> bool:
        """Whether the body has no rigid motion: a part bends, or parts move differently."""
        return any(not p.shape.rigid or (p.motion != np.eye(4)).any() for p in self.parts)


@dataclass(frozen=True)
class Scene:
    """Bodies and a camera at two times, in any right-handed scene coordinates.

    Attributes:
        bodies: The bodies; the component label of a body is its index.
        ref_from_scene: (4, 4) camera pose at the reference time.
        next_from_scene: (4, 4) camera pose at the next time.
    """

    bodies: Sequence[Body]
    ref_from_scene: Float
    next_from_scene: Float

    @property
    def parts(self) -> list[Part]:
        """All parts, body by body."""
        return [part for body in self.bodies for part in body.parts]

    @property
    def body_of_part(self) -> NDArray[np.int32]:
        """(P,) body label of each part."""
        return np.repeat(
            np.arange(len(self.bodies), dtype=np.int32), [len(b.parts) for b in self.bodies]
        )

    def camera_from_part(self, frame: int) -> Float:
        """(P, 4, 4) poses of all parts in the camera of a frame."""
        poses = []
        for body in self.bodies:
            view = self.next_from_scene @ body.motion if frame else self.ref_from_scene
            for part in body.parts:
                part_view = view @ part.motion if frame else view
                poses.append(part_view @ part.scene_from_part)
        return np.array(poses)

    def motions(self) -> Float:
        """(B, 4, 4) next_from_ref of each body, camera motion included; NaN where not rigid."""
        scene_from_ref = inverse(self.ref_from_scene)
        out = np.array([self.next_from_scene @ b.motion @ scene_from_ref for b in self.bodies])
        out[[b.bends for b in self.bodies]] = np.nan
        return out

    def trace(self, K: Float, uv: Float, frame: int) -> tuple[Float, Int]:
        """First hit of the rays through pixels.

        Args:
            K: (3, 3) intrinsics.
            uv: (N, 2) pixels, any real numbers.
            frame: 0 for the reference, 1 for the next frame.

        Returns:
            Depth z (N,), inf where nothing is hit, and part index (N,), -1 there.
        """
        rays = camera.rays(K, uv)
        depth = np.full(len(uv), np.inf)
        index = np.full(len(uv), -1, dtype=np.int64)
        for p, (part, pose) in enumerate(zip(self.parts, self.camera_from_part(frame))):
            near = _may_hit(part.shape, pose, K, uv)
            R, t = pose[:3, :3], pose[:3, 3]
            hit = part.shape.intersect(-R.T @ t, rays[near] @ R, frame)
            closer = hit < depth[near]
            depth[near[closer]] = hit[closer]
            index[near[closer]] = p
        return depth, index


def advanced(scene: Scene, steps: int) -> Scene:
    """The scene `steps` frames later; camera and bodies repeat their motion from frame 0 to 1.

    Raises:
        DataError: a body bends; bending is defined for the first two frames only.
    """
    if steps and any(body.bends for body in scene.bodies):
        raise DataError("a scene that bends has two frames", found=f"frame {steps}", expected="0")
    go_on = scene.next_from_scene @ inverse(scene.ref_from_scene)
    ref = np.linalg.matrix_power(go_on, steps) @ scene.ref_from_scene
    bodies = []
    for body in scene.bodies:
        so_far = np.linalg.matrix_power(body.motion, steps)
        parts = [replace(p, scene_from_part=so_far @ p.scene_from_part) for p in body.parts]
        bodies.append(replace(body, parts=parts))
    return Scene(bodies, ref, go_on @ ref)


def _may_hit(shape: Shape, camera_from_part: Float, K: Float, uv: Float) -> Int:
    """Indices of the pixels (N, 2) within the bounding rectangle of a shape's projection."""
    corners = shape.corners()
    if corners is not None:
        seen = corners @ camera_from_part[:3, :3].T + camera_from_part[:3, 3]
        if seen[:, 2].min() > NEAR:
            at = camera.project(K, seen)
            lo, hi = at.min(axis=0) - 1e-6, at.max(axis=0) + 1e-6
            u, v = uv[:, 0], uv[:, 1]
            return np.flatnonzero((u >= lo[0]) & (u <= hi[0]) & (v >= lo[1]) & (v <= hi[1]))
    return np.arange(len(uv))


def render(scene: Scene, K: Float, height: int, width: int, name: str = "scene") -> Pair:
    """Both images of a scene and its exact truth.

    Args:
        scene: The scene.
        K: (3, 3) intrinsics of both frames, pixels.
        height: Rows of the images.
        width: Columns of the images.
        name: Name of the pair.

    Returns:
        A `Pair` without a flow but with full truth in the unit of the scene. A reference pixel is
        occluded if its point is hidden in the next frame, projects outside the rectangle of the
        pixel centres, or is behind the camera (with a flow of NaN). Every ray must hit a surface,
        such as an infinite plane behind the bodies.
    """
    uv = camera.pixel_grid(height, width).reshape(-1, 2)
    depths, images, hits = [], [], []
    for frame in (0, 1):
        depth, part = scene.trace(K, uv, frame)
        images.append(_paint(scene, K, depth, part, (height, width), frame))
        depths.append(depth)
        hits.append(part)
    X = depths[0][:, None] * camera.rays(K, uv)
    X_next = _move(scene, X, hits[0])
    in_front = X_next[:, 2] > NEAR
    target = np.full_like(uv, np.nan)
    target[in_front] = camera.project(K, X_next[in_front])
    # tolerates rounding at the border
    edge = np.array([width, height]) - 1 + 1e-6
    inside = in_front & ((target >= -1e-6) & (target <= edge)).all(axis=1)
    visible = inside.copy()
    first, _ = scene.trace(K, target[inside], 1)
    visible[inside] = X_next[inside, 2] <= first * (1 + SAME_DEPTH)
    shape = (height, width)
    truth = Truth(
        depth_ref=depths[0].reshape(shape),
        depth_next=depths[1].reshape(shape),
        flow=(target - uv).reshape(*shape, 2),
        occluded=~visible.reshape(shape),
        components=scene.body_of_part[hits[0]].reshape(shape),
        motions=scene.motions(),
        scene_flow=(X_next - X).reshape(*shape, 3),
        unit="m",
    )
    return Pair(images[0], images[1], K.copy(), K.copy(), truth=truth, name=name)


def _move(scene: Scene, X: Float, part: Int) -> Float:
    """Next-frame positions (N, 3) of reference points (N, 3) on parts (N,)."""
    out = np.empty_like(X)
    before, after = scene.camera_from_part(0), scene.camera_from_part(1)
    motions = scene.motions()[scene.body_of_part]
    for p in np.unique(part):
        on = part == p
        shape = scene.parts[p].shape
        if shape.rigid and np.isfinite(motions[p]).all():
            out[on] = X[on] @ motions[p, :3, :3].T + motions[p, :3, 3]
        else:
            local = (X[on] - before[p, :3, 3]) @ before[p, :3, :3]
            local = shape.place(shape.material(local, 0), 1)
            out[on] = local @ after[p, :3, :3].T + after[p, :3, 3]
    return out


def _paint(
    scene: Scene, K: Float, depth: Float, part: Int, shape: tuple[int, int], frame: int
) -> Image:
    """The image (H, W, 3); pixels on edges are averages of TAPS x TAPS traced samples."""
    uv = camera.pixel_grid(*shape).reshape(-1, 2)
    colour, normals = _shade(scene, K, uv, depth, part, frame, TAPS)
    edge = np.flatnonzero(_on_edge(part.reshape(shape), normals.reshape(*shape, 3)))
    steps = (np.arange(TAPS) + 0.5) / TAPS - 0.5
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, -1, 2)
    at = (uv[edge, None] + offsets).reshape(-1, 2)
    z, p = scene.trace(K, at, frame)
    samples, _ = _shade(scene, K, at, z, p, frame, 1)
    colour[edge] = np.clip(samples, 0, 1).reshape(-1, TAPS**2, 3).mean(axis=1)
    return np.round(255 * np.clip(colour, 0, 1)).astype(np.uint8).reshape(*shape, 3)


def _on_edge(part: Int, normals: Float) -> Mask:
    """Pixels (H, W) whose 4-neighbours show another part or another face."""
    edge = np.zeros(part.shape, bool)
    for first, second in (np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:]):
        turned = np.einsum("...i,...i", normals[first], normals[second]) < 0.7
        differ = (part[first] != part[second]) | turned
        edge[first] |= differ
        edge[second] |= differ
    return edge


def _shade(
    scene: Scene, K: Float, uv: Float, depth: Float, part: Int, frame: int, taps: int
) -> tuple[FloatMap, Float]:
    """Colours and normals of hits.

    A tilted surface is foreshortened in one image direction only. Its texture has the finer
    resolution of the other direction, and TAPS samples are averaged along the first.

    Args:
        scene: The scene.
        K: (3, 3) intrinsics.
        uv: (N, 2) pixels.
        depth: (N,) depth of the surface there.
        part: (N,) part index.
        frame: 0 or 1.
        taps: Samples along the foreshortened direction; 1 if the caller averages samples.

    Returns:
        Colours (N, 3) and unit normals (N, 3) in camera coordinates.
    """
    colour = np.zeros((len(uv), 3), np.float32)
    normals = np.zeros((len(uv), 3))
    rays = camera.rays(K, uv)
    poses = scene.camera_from_part(frame)
    for p in np.unique(part):
        on = np.flatnonzero(part == p)
        item, R, t = scene.parts[p], poses[p, :3, :3], poses[p, :3, 3]
        ray = rays[on]
        local = (depth[on, None] * ray - t) @ R
        n = item.shape.normals(local, frame) @ R.T
        normals[on] = n
        towards = np.einsum("ni,ni->n", n, ray)
        cosine = np.maximum(abs(towards) / np.linalg.norm(ray, axis=1), 0.02)
        across = depth[on] / K[0, 0]
        footprint = np.maximum(across, across / cosine / TAPS)
        several = (cosine < TILTED) & (taps > 1)
        shown = np.empty((len(on), 3), np.float32)
        shown[~several] = item.colour(local[~several], footprint[~several], frame)
        if several.any():
            # direction of foreshortening within the surface
            along = (ray - towards[:, None] * n)[several]
            along *= ((across / cosine)[several] / np.linalg.norm(along, axis=1))[:, None]
            step, start = along @ R, local[several]
            offsets = (np.arange(taps) + 0.5) / taps - 0.5
            samples = [item.colour(start + o * step, footprint[several], frame) for o in offsets]
            shown[several] = np.mean(samples, axis=0)
        colour[on] = shown
    return colour, normals
