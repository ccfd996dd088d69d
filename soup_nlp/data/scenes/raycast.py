"""A small ray caster for dynamic scenes: exact depth and flow, textured images.

A `Scene` consists of bodies, a body of parts that move together, and a part is a shape with a pose
and a texture. Rays are `K^-1 (u, v, 1)`, so the ray parameter of a hit is its depth z. Depth, flow
and labels are computed at pixel centres in closed form; only colour is averaged over the pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from soup_nlp.arrays import Float, FloatMap, Image, Int
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.data.scenes.surfaces import NEAR, Shape, Texture
from soup_nlp.errors import DataError
from soup_nlp.geometry import camera

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


def moved(pose: Float, points: Float) -> Float:
    """Points (N, 3) under a rigid transform (4, 4)."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def moved_back(pose: Float, points: Float) -> Float:
    """Points (N, 3) under the inverse of a rigid transform (4, 4)."""
    return (points - pose[:3, 3]) @ pose[:3, :3]


@dataclass(frozen=True)
class Part:
    """A textured shape at a pose.

    Attributes:
        shape: The surface, in its own coordinates.
        scene_from_part: (4, 4) rigid pose at the reference time.
        texture: Colours by material coordinates.
        glow: Share of the colour that does not depend on the light; 1 for no shading (sky).
        motion: (4, 4) motion in scene coordinates before that of the body, such as of a limb.
        bent: The surface at the next time if it bends, with the same material coordinates.
    """

    shape: Shape
    scene_from_part: Float
    texture: Texture
    glow: float = 0.45
    motion: Float = field(default_factory=lambda: np.eye(4))
    bent: Shape | None = None

    def colour(self, shape: Shape, points: Float, footprint: Float) -> FloatMap:
        """Colours (N, 3) of points (N, 3) of its shape at a time; shading moves with them."""
        material = shape.material(points)
        normals = self.shape.normals(self.shape.place(material))
        light = self.scene_from_part[:3, :3].T @ LIGHT
        shade = self.glow + (1 - self.glow) * (0.5 + 0.5 * normals @ light)
        colour = self.texture.colour(material, shape.chart(material), footprint)
        return colour * shade[:, None].astype(np.float32)


@dataclass(frozen=True)
class Body:
    """Parts that move together, by `motion` (4, 4) in scene coordinates to the next time."""

    parts: Sequence[Part]
    motion: Float = field(default_factory=lambda: np.eye(4))

    @property
    def bends(self) -> bool:
        """Whether the body has no rigid motion: a part bends, or parts move differently."""
        return any(p.bent is not None or (p.motion != np.eye(4)).any() for p in self.parts)


@dataclass(frozen=True)
class Scene:
    """Bodies and a camera (4, 4) at two times, in any right-handed scene coordinates.

    The component label of a body is its index.
    """

    bodies: Sequence[Body]
    ref_from_scene: Float
    next_from_scene: Float

    def motions(self) -> Float:
        """(B, 4, 4) next_from_ref of each body, camera motion included; NaN where not rigid."""
        scene_from_ref = inverse(self.ref_from_scene)
        out = np.array([self.next_from_scene @ b.motion @ scene_from_ref for b in self.bodies])
        out[[b.bends for b in self.bodies]] = np.nan
        return out

    def advanced(self, steps: int) -> "Scene":
        """The scene `steps` frames later; camera and bodies repeat their motion of one frame."""
        if steps and any(body.bends for body in self.bodies):
            # bending is defined between two shapes
            what = "a scene that bends has two frames"
            raise DataError(what, found=f"frame {steps}", expected="0")
        go_on = self.next_from_scene @ inverse(self.ref_from_scene)
        ref = np.linalg.matrix_power(go_on, steps) @ self.ref_from_scene
        bodies = []
        for body in self.bodies:
            so_far = np.linalg.matrix_power(body.motion, steps)
            parts = [replace(p, scene_from_part=so_far @ p.scene_from_part) for p in body.parts]
            bodies.append(replace(body, parts=parts))
        return Scene(bodies, ref, go_on @ ref)


class Frame:
    """Parts of a scene, body by body, in the camera of a frame: 0 the reference, 1 the next.

    `poses` (P, 4, 4) are camera_from_part, `body` (P,) the component labels.
    """

    def __init__(self, scene: Scene, K: Float, frame: int) -> None:
        self.K = K
        numbered = [(k, part) for k, body in enumerate(scene.bodies) for part in body.parts]
        self.body = np.array([k for k, _ in numbered], np.int32)
        self.parts = [part for _, part in numbered]
        self.shapes = [(frame and part.bent) or part.shape for part in self.parts]
        moving = [scene.next_from_scene @ body.motion for body in scene.bodies]
        views = [moving[k] @ p.motion if frame else scene.ref_from_scene for k, p in numbered]
        self.poses = np.array([v @ p.scene_from_part for v, p in zip(views, self.parts)])

    def trace(self, uv: Float) -> tuple[Float, Int]:
        """Depth z (N,) and part (N,) of the first hits of pixels (N, 2); inf and -1 without."""
        rays = camera.rays(self.K, uv)
        depth = np.full(len(uv), np.inf)
        index = np.full(len(uv), -1, dtype=np.int64)
        for p, (shape, pose) in enumerate(zip(self.shapes, self.poses)):
            near = self._may_hit(shape, pose, uv)
            R, t = pose[:3, :3], pose[:3, 3]
            hit = shape.intersect(-R.T @ t, rays[near] @ R)
            closer = hit < depth[near]
            depth[near[closer]] = hit[closer]
            index[near[closer]] = p
        return depth, index

    def _may_hit(self, shape: Shape, pose: Float, uv: Float) -> Int:
        """Indices of the pixels (N, 2) within the bounding rectangle of a shape's projection."""
        if shape.bound is not None:
            corners = np.array(list(product((-1, 1), repeat=3))) * shape.bound
            seen = moved(pose, corners)
            if seen[:, 2].min() > NEAR:
                at = camera.project(self.K, seen)
                inside = (uv >= at.min(axis=0) - 1e-6) & (uv <= at.max(axis=0) + 1e-6)
                return np.flatnonzero(inside[:, 0] & inside[:, 1])
        return np.arange(len(uv))

    def image(self, depth: Float, part: Int, size: tuple[int, int]) -> Image:
        """The image (H, W, 3) of the hits of all pixels, with TAPS x TAPS samples at edges."""
        uv = camera.pixel_grid(*size).reshape(-1, 2)
        colour, normals = self._shade(uv, depth, part, TAPS)
        parts, faces, edge = part.reshape(size), normals.reshape(*size, 3), np.zeros(size, bool)
        for first, second in (np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:]):
            turned = np.einsum("...i,...i", faces[first], faces[second]) < 0.7
            differ = (parts[first] != parts[second]) | turned
            edge[first] |= differ
            edge[second] |= differ
        steps = (np.arange(TAPS) + 0.5) / TAPS - 0.5
        offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, -1, 2)
        at = (uv[edge.ravel(), None] + offsets).reshape(-1, 2)
        samples, _ = self._shade(at, *self.trace(at), 1)
        colour[edge.ravel()] = np.clip(samples, 0, 1).reshape(-1, TAPS**2, 3).mean(axis=1)
        return np.round(255 * np.clip(colour, 0, 1)).astype(np.uint8).reshape(*size, 3)

    def _shade(self, uv: Float, depth: Float, part: Int, taps: int) -> tuple[FloatMap, Float]:
        """Colours (N, 3) and unit normals (N, 3), in camera coordinates, of hits.

        A tilted surface has the finer resolution of the direction that is not foreshortened, and
        `taps` samples are averaged along the other one.
        """
        colour, normals = np.zeros((len(uv), 3), np.float32), np.zeros((len(uv), 3))
        rays = camera.rays(self.K, uv)
        for p in np.unique(part):
            on = np.flatnonzero(part == p)
            shape, R, ray = self.shapes[p], self.poses[p][:3, :3], rays[on]
            local = moved_back(self.poses[p], depth[on, None] * ray)
            normals[on] = n = shape.normals(local) @ R.T
            towards = np.einsum("ni,ni->n", n, ray)
            cosine = np.maximum(abs(towards) / np.linalg.norm(ray, axis=1), 0.02)
            across = depth[on] / self.K[0, 0]
            footprint = np.maximum(across, across / cosine / TAPS)
            several = (cosine < TILTED) & (taps > 1)
            # direction of foreshortening within the surface
            along = (ray - towards[:, None] * n)[several]
            along *= ((across / cosine)[several] / np.linalg.norm(along, axis=1))[:, None]
            step, start = along @ R, local[several]
            offsets = (np.arange(taps) + 0.5) / taps - 0.5
            # one call for all: it costs more than its points in small images
            points = np.concatenate([local[~several], *(start + o * step for o in offsets)])
            sizes = np.concatenate([footprint[~several], np.tile(footprint[several], taps)])
            seen = self.parts[p].colour(shape, points, sizes)
            one = len(on) - len(start)
            colour[on[~several]] = seen[:one]
            colour[on[several]] = np.mean(seen[one:].reshape(taps, -1, 3), axis=0)
        return colour, normals


def render(scene: Scene, K: Float, height: int, width: int) -> Pair:
    """Both images of a scene, with intrinsics K (3, 3), and its exact truth; no flow.

    The flow is NaN where a point comes to lie behind the camera. Every ray must hit a surface, such
    as an infinite plane behind the bodies.
    """
    size, uv = (height, width), camera.pixel_grid(height, width).reshape(-1, 2)
    ref, following = Frame(scene, K, 0), Frame(scene, K, 1)
    (depth, part), (depth_next, part_next) = ref.trace(uv), following.trace(uv)
    motions = scene.motions()
    X = depth[:, None] * camera.rays(K, uv)
    X_next = np.empty_like(X)
    for p in np.unique(part):
        on, motion = part == p, motions[ref.body[p]]
        if np.isfinite(motion).all():
            X_next[on] = moved(motion, X[on])
        else:
            material = ref.shapes[p].material(moved_back(ref.poses[p], X[on]))
            X_next[on] = moved(following.poses[p], following.shapes[p].place(material))
    in_front = X_next[:, 2] > NEAR
    target = np.full_like(uv, np.nan)
    target[in_front] = camera.project(K, X_next[in_front])
    truth = Truth(
        depth_ref=depth.reshape(size),
        depth_next=depth_next.reshape(size),
        flow=(target - uv).reshape(*size, 2),
        components=ref.body[part].reshape(size),
        motions=motions,
        scene_flow=(X_next - X).reshape(*size, 3),
    )
    images = ref.image(depth, part, size), following.image(depth_next, part_next, size)
    return Pair(*images, K.copy(), K.copy(), truth=truth)
