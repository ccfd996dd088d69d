"""Clouds as PLY, meshes as GLB (glTF 2.0, binary), COLMAP's text model, images and masks."""

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.errors import DataError, printable
from soup_nlp.evaluation.confidence import MIN_CONFIDENCE
from soup_nlp.geometry.camera import project
from soup_nlp.geometry.surface import triangles, whole_cells
from soup_nlp.report.chain import AXES, Chain, Frame, Lazy
from soup_nlp.report.figures import write_png
from soup_nlp.storage.files import PathLike, write_bytes, write_text

VOXEL = 0.004
"""Side of a voxel relative to the median distance of the points from the first camera."""
MOST_POINTS = 300_000
"""Largest number of points that enter the fusion, all frames together."""
IN_FRONT = 0.8
"""A point contradicts a frame if its depth is below this share of the depth of the frame there."""

Cloud: TypeAlias = NDArray[np.void]
"""(M,) points with the fields of POINT."""
POINT = np.dtype([("points", float, 3), ("colours", "u1", 3), ("sigma", float), ("frame", int)])
"""Position in world coordinates in the unit of the chain, RGB, standard deviation of log depth, and
the frame that a point is from."""


def write_ply(
    path: PathLike,
    xyz: ArrayLike,
    rgb: ArrayLike,
    normals: ArrayLike | None = None,
    scalars: Mapping[str, ArrayLike] | None = None,
    comments: Sequence[str] = (),
) -> int:
    """Write a coloured point cloud (binary little endian, float32 and uchar); returns its size.

    Positions, colours (uint8) and unit normals are (..., 3), scalars (...) by the name of their
    property, such as "component"; comments are lines of the header. Points with a number that is
    not a finite float32 are left out.
    """
    parts = [np.reshape(part, (-1, 3)) for part in (xyz, normals) if part is not None]
    parts += [np.reshape(part, (-1, 1)) for part in (scalars or {}).values()]
    numbers = np.concatenate(parts, 1, dtype=np.float64)
    colours = np.reshape(np.asarray(rgb, np.uint8), (-1, 3))
    good = (np.abs(numbers) <= np.finfo(np.float32).max).all(axis=1)
    floats = ["x", "y", "z", *(["nx", "ny", "nz"] if normals is not None else [])]
    floats += list(scalars or {})
    table = np.empty(int(good.sum()), [("numbers", "<f4", (len(floats),)), ("colour", "u1", (3,))])
    table["numbers"], table["colour"] = numbers[good], colours[good]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {printable(line)}" for line in comments),
        f"element vertex {len(table)}",
        *(f"property float {name}" for name in floats),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header",
    ]
    text = "\n".join(header) + "\n"
    write_bytes(path, text.encode("ascii", "backslashreplace") + table.tobytes())
    return len(table)


def write_points(path: Path, frame: Frame) -> None:
    """Write the sure points of a frame as PLY, with normal, colour, component and sigma."""
    keep = frame.sure
    scalars: dict[str, ArrayLike] = {"component": frame.components[keep]}
    scalars["sigma_log_depth"] = frame.sigma[keep]
    comments = [
        f"points of frame {frame.name}",
        f"axes: the first frame's camera, {AXES}",
        f"unit: {frame.unit}",
        "component: what moves as one, 0 is the background",
        f"{keep.mean():.1%} of the pixels: without hidden ones, those at jumps of the depth, and"
        f" those of less confidence than {MIN_CONFIDENCE:g}",
    ]
    write_ply(path, frame.points[keep], frame.image[keep], frame.normals[keep], scalars, comments)


def write_fused(path: Path, chain: Chain) -> None:
    """Write the static scene of all frames as one cloud."""
    cloud = fuse(chain)
    comments = [
        f"{chain.name}: static scene of {len(chain)} frames, one point per voxel",
        f"axes: the first frame's camera, {AXES}",
        f"unit: {chain.unit}",
        "sigma_log_depth: of the frame that the point is from, at most 0.25",
    ]
    scalars = {"sigma_log_depth": cloud["sigma"], "frame": cloud["frame"]}
    write_ply(path, cloud["points"], cloud["colours"], None, scalars, comments)


def fuse(chain: Chain, most: int = MOST_POINTS) -> Cloud:
    """The static scene of all frames: sure points without conflicts, one per voxel.

    A point in front of the static surface of a neighbouring frame is removed if that frame is more
    certain there. A voxel keeps its most certain point. Of more than `most` points each k-th one is
    returned. The last frame shows what the one before it shows.
    """
    count = len(chain.pairs)
    frames = Lazy(chain.__getitem__, count)
    step = max(1, math.ceil(math.sqrt(count * frames[0].depth.size / MOST_POINTS)))
    clouds = []
    for k, frame in enumerate(frames):
        chosen = np.zeros_like(frame.sure)
        chosen[::step, ::step] = frame.static[::step, ::step]
        cloud = np.empty(int(chosen.sum()), POINT)
        cloud["points"], cloud["colours"] = frame.points[chosen], frame.image[chosen]
        cloud["sigma"], cloud["frame"] = frame.sigma[chosen], k
        fits = np.ones(len(cloud), bool)
        for other in (k - 2, k - 1, k + 1, k + 2):
            if 0 <= other < count:
                fits &= ~_contradicts(cloud, frames[other])
        clouds.append(cloud[fits])
    cloud = np.concatenate(clouds)
    if not len(cloud):
        return cloud
    side = VOXEL * float(np.median(np.linalg.norm(cloud["points"], axis=1)))
    cloud = cloud[np.argsort(cloud["sigma"], kind="stable")]
    voxel = np.floor(cloud["points"][:, ::-1] / side).astype(np.int64)
    _, first = np.unique(voxel, axis=0, return_index=True)
    return cloud[first][:: max(1, -(-len(first) // most))]


def _projected(frame: Frame, points: Float) -> tuple[Mask, tuple[Int, Int], Float, Float]:
    """Points (M, 3) of the world in a frame: which are in its image, rows and columns, z, uv."""
    local = frame.pose.inverse(points)
    height, width = frame.depth.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = project(frame.K, local)
        inside = (uv >= -0.5).all(1) & (uv < [width - 0.5, height - 0.5]).all(1)
    inside &= local[:, 2] > 0
    u, v = np.rint(np.where(inside[:, None], uv, 0)).astype(np.int64).T
    return inside, (v, u), local[:, 2], uv


def _contradicts(cloud: Cloud, frame: Frame) -> Mask:
    """(M,) points in front of the static surface of a frame that is more certain there."""
    inside, at, z, _ = _projected(frame, cloud["points"])
    with np.errstate(invalid="ignore"):
        inside &= (z < IN_FRONT * frame.depth[at]) & (frame.sigma[at] <= cloud["sigma"])
    return inside & frame.static[at]


# --- meshes ---------------------------------------------------------------------------------------

CELLS = 250_000
"""Largest number of cells of a mesh; larger images are subsampled."""
QUALITY = 92
"""JPEG quality of the texture."""
GLTF = np.diag([1.0, -1.0, -1.0])
"""glTF has y up and looks along -z: half a turn about x from a camera's axes."""


def surface_mesh(frame: Frame) -> tuple[Float, Int, Float]:
    """The surface of a frame, cut at jumps of the depth and between components.

    Returns:
        (V, 3) vertices in the world, (M, 3) triangles, counter-clockwise from the camera, and
        (V, 2) pixels (u, v).
    """
    known = frame.depth > 0
    height, width = known.shape
    step = int(np.ceil(np.sqrt(height * width / CELLS)))
    faces = triangles(whole_cells(*frame.surface, known, step), width, step)
    used, faces = np.unique(faces, return_inverse=True)
    pixels = np.stack([used % width, used // width], axis=1).astype(float)
    return frame.points.reshape(-1, 3)[used], faces.reshape(-1, 3), pixels


def write_glb(path: Path, frame: Frame) -> None:
    """Write the surface of a frame, textured with its image.

    Axes are those of glTF: x right, y up; the first frame's camera looks along -z from the origin.
    Extras of the asset name the unit of length.
    """
    import trimesh
    from PIL import Image

    vertices, faces, pixels = surface_mesh(frame)
    packed = io.BytesIO()
    Image.fromarray(frame.image).save(packed, "JPEG", quality=QUALITY)
    height, width = frame.depth.shape
    # trimesh has v upwards, as OBJ does
    uv = (pixels + 0.5) / [width, height] * [1, -1] + [0, 1]
    material = trimesh.visual.material.PBRMaterial(
        name="image",
        baseColorTexture=Image.open(packed),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh = trimesh.Trimesh(vertices @ GLTF, faces, visual=visual, process=False)
    axes = "camera of the first frame, y up, looking along -z"
    scene = trimesh.Scene(metadata={"unit": frame.unit, "frame": axes})
    name = f"frame {frame.name}"
    scene.add_geometry(mesh, node_name=name, geom_name=name)
    write_bytes(path, scene.export(file_type="glb"))


# --- COLMAP's text model -------------------------------------------------------------------------

POINTS = 50_000
"""Largest number of points of a model."""
VISIBLE = 0.03
"""A point is visible in a frame if log depths of point and frame differ by less than this."""


def write_views(folder: Path, chain: Chain) -> None:
    """Write `images/`, and `masks/` that are black where something moves by itself.

    A camera with skew, which the models of other programs do not have, is a DataError.
    """
    for frame in chain:
        if frame.K[0, 1] != 0:
            raise DataError("camera has skew", found=frame.K.tolist(), expected="s = 0")
        for name in ("images", "masks"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        write_png(folder / "images" / f"{frame.name}.png", frame.image)
        black = np.where(frame.components > 0, 0, 255).astype(np.uint8)
        write_png(folder / "masks" / f"{frame.name}.png.png", np.repeat(black[..., None], 3, 2))


def write_colmap(folder: Path, chain: Chain) -> None:
    """Write `images/`, `masks/` and `sparse/0/` into a folder.

    The world is the first camera (x right, y down, z ahead); images have poses cam_from_world.
    COLMAP models are static: the points are those of the static scene.
    """
    write_views(folder, chain)
    model, cloud = folder / "sparse" / "0", fuse(chain, POINTS)
    model.mkdir(parents=True, exist_ok=True)
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] as fx, fy, cx, cy"]
    images = [
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME (cam_from_world)",
        "# POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    points = [
        printable(f"# {chain.name}; unit: {chain.unit}"),
        "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ]
    tracks: list[list[str]] = [[] for _ in cloud]
    for i, frame in enumerate(chain, 1):
        K, (height, width), pose = frame.K, frame.depth.shape, frame.pose.inverse
        # the first pixel's centre is (0.5, 0.5) in COLMAP, (0, 0) here
        lens = " ".join(f"{x:.17g}" for x in (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
        cameras.append(f"{i} PINHOLE {width} {height} {lens}")
        x, y, z, w = pose.quaternion
        place = " ".join(f"{a:.17g}" for a in (w, x, y, z, *pose.t))
        inside, at, depth, uv = _projected(frame, cloud["points"])
        with np.errstate(invalid="ignore", divide="ignore"):
            inside &= np.abs(np.log(depth / frame.depth[at])) < VISIBLE
        seen = np.flatnonzero(inside)
        shown = (f"{u:.6g} {v:.6g} {point + 1}" for point, (u, v) in zip(seen, uv[seen] + 0.5))
        images += [f"{i} {place} {i} {frame.name}.png", " ".join(shown)]
        for k, point in enumerate(seen):
            tracks[point].append(f"{i} {k}")
    for i, (point, track) in enumerate(zip(cloud, tracks, strict=True), 1):
        (x, y, z), (r, g, b) = point["points"], point["colours"]
        points.append(f"{i} {x:.9g} {y:.9g} {z:.9g} {r} {g} {b} 0 {' '.join(track)}")
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        write_text(model / f"{name}.txt", "\n".join(lines) + "\n")
