"""Point clouds as PLY (binary, 1.0), meshes as GLB (glTF 2.0, binary), COLMAP's text model."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from soup_nlp.arrays import Float, Image, Int, Mask
from soup_nlp.errors import DataError
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.surface import triangles, whole_cells
from soup_nlp.report.figures import write_png
from soup_nlp.report.result import Result
from soup_nlp.storage.files import PathLike, write_bytes, write_text

AXES = "x right, y down, z ahead"
"""Axes of a camera, in words."""
CELLS = 250_000
"""Largest number of cells of a mesh; larger images are subsampled."""
QUALITY = 92
"""JPEG quality of the texture."""
GLTF = np.diag([1.0, -1.0, -1.0])
"""glTF has y up and looks along -z: half a turn about x from a camera's axes."""


def write_ply(
    path: PathLike,
    xyz: ArrayLike,
    rgb: ArrayLike,
    normals: ArrayLike | None = None,
    scalars: Mapping[str, ArrayLike] | None = None,
    comments: Sequence[str] = (),
) -> int:
    """Write a coloured point cloud (binary little endian, float32 and uchar).

    Points with a number that is not a finite float32 are left out.

    Args:
        path: File to write; its folder must exist.
        xyz: (..., 3) positions, camera frame (x right, y down, z forward), any length unit.
        rgb: (..., 3) uint8 colours, same leading shape.
        normals: (..., 3) unit normals, same leading shape, or None.
        scalars: (...) numbers by the name of their property, such as "confidence".
        comments: Lines of the header, ASCII.

    Returns:
        The number of points written.

    Raises:
        DataError: the folder cannot be written.
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
        *(f"comment {line}" for line in comments),
        f"element vertex {len(table)}",
        *(f"property float {name}" for name in floats),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header",
    ]
    text = "\n".join(header) + "\n"
    write_bytes(path, text.encode("ascii", "replace") + table.tobytes())
    return len(table)


def write_cloud(path: PathLike, result: Result, frame: int) -> None:
    """Write the points of the reference image in frame 0 or 1 as PLY.

    Properties beside position, normal and colour: `confidence` of the flow, `component` and
    `sigma_log_depth`. Points that are not `result.sure` are left out.
    """
    keep = result.sure
    scalars = {
        "confidence": result.flow_confidence,
        "component": result.components.of_pixel,
        "sigma_log_depth": result.sigma,
    }
    name = ("reference", "next")[frame]
    comments = [
        f"{result.name}: points of the reference image in the {name} frame",
        f"frame: camera of the {name} frame, {AXES}",
        f"unit: {result.unit}",
        "confidence: of the flow, 0 to 1; component: what moves as one, 0 is the background",
        f"{keep.mean():.1%} of the pixels: without hidden ones, those at jumps of the depth, and"
        " guesses (output.min_confidence=0 keeps them)",
    ]
    write_ply(
        path,
        result.points[frame][keep],
        result.images[0][keep],
        result.normals[frame][keep],
        {key: value[keep] for key, value in scalars.items()},
        comments,
    )


def surface_mesh(result: Result, frame: int) -> tuple[Float, Int, Float]:
    """The surface of the reference image in frame 0 (reference) or 1 (next).

    It is cut at jumps of the depth, between components, and where depth is unknown.

    Returns:
        (V, 3) vertices in camera coordinates, (M, 3) triangles, counter-clockwise from the
        camera, and (V, 2) pixels (u, v) of the reference image.
    """
    points = result.points[frame]
    known = np.isfinite(points).all(axis=2) & (points[..., 2] > 0)
    height, width = known.shape
    step = int(np.ceil(np.sqrt(height * width / CELLS)))
    faces = triangles(whole_cells(*result.surface, known, step), width, step)
    used, faces = np.unique(faces, return_inverse=True)
    pixels = np.stack([used % width, used // width], axis=1).astype(float)
    return points.reshape(-1, 3)[used], faces.reshape(-1, 3), pixels


def thinned(mask: Mask, most: float) -> Mask:
    """The pixels of a mask (H, W) in every k-th row and column, about `most` of them or fewer."""
    step = max(1, int(np.ceil(np.sqrt(mask.sum() / most))))
    out = np.zeros_like(mask)
    out[::step, ::step] = mask[::step, ::step]
    return out


def write_glb(path: PathLike, result: Result, frame: int) -> None:
    """Write the mesh of frame 0 or 1, textured with the image.

    Axes are those of glTF: x right, y up, the camera looks along -z from the origin. Lengths are
    in the unit of the reconstruction, which the extras of the asset name.
    """
    import trimesh
    from PIL import Image

    vertices, faces, pixels = surface_mesh(result, frame)
    image = result.images[0]
    packed = io.BytesIO()
    Image.fromarray(image).save(packed, "JPEG", quality=QUALITY)
    height, width = image.shape[:2]
    # trimesh has v upwards, as OBJ does
    uv = (pixels + 0.5) / [width, height] * [1, -1] + [0, 1]
    material = trimesh.visual.material.PBRMaterial(
        name="image",
        baseColorTexture=Image.open(packed),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    mesh = trimesh.Trimesh(
        vertices @ GLTF,
        faces,
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    name = ("reference", "next")[frame]
    extras = {"unit": result.unit, "frame": f"camera of the {name} frame, y up, looking along -z"}
    scene = trimesh.Scene(metadata=extras)
    scene.add_geometry(mesh, node_name=f"{name} frame", geom_name=f"{name} frame")
    write_bytes(path, scene.export(file_type="glb"))


# --- COLMAP's text model -------------------------------------------------------------------------

POINTS = 50_000
"""Largest number of points of a model."""
IMAGES = ("ref.png", "next.png")
"""Names of the images in a model."""


def write_colmap(folder: Path, result: Result) -> None:
    """Write `images/`, `masks/` and `sparse/0/` into a folder.

    The world is the reference camera (x right, y down, z ahead); both images have poses
    cam_from_world. COLMAP models are static: the points are background points visible in both
    images, and the masks are black where something moves by itself.

    Raises:
        DataError: a camera has skew, which none of COLMAP's models has.
    """
    moving = result.components.of_pixel > 0
    uv, points, colours = _points(result, ~moving)
    every = np.arange(len(points))
    write_model(
        folder,
        IMAGES,
        result.images,
        result.K,
        [RigidMotion(np.eye(3), np.zeros(3)), result.components.camera],
        [moving, _moved(result, moving)],
        (points, colours),
        [(every, uv[0]), (every, uv[1])],
        f"{result.name}; unit: {result.unit}",
    )


def write_model(
    folder: Path,
    names: Sequence[str],
    images: Sequence[Image],
    cameras: Sequence[Float],
    poses: Sequence[RigidMotion],
    moving: Sequence[Mask],
    cloud: tuple[Float, NDArray[np.uint8]],
    seen: Sequence[tuple[Int, Float]],
    title: str,
) -> None:
    """Write a model of any number of images.

    Args:
        folder: Gets `images/`, `masks/` and `sparse/0/`.
        names: Names of the images.
        images: (H, W, 3) uint8 RGB.
        cameras: (3, 3) intrinsics by image; the centre of the first pixel is (0, 0).
        poses: cam_from_world by image.
        moving: (H, W) what moves by itself, by image.
        cloud: (P, 3) points and their colours.
        seen: Indices of the points that an image sees, and their pixels (u, v).
        title: Comment of the points' file.

    Raises:
        DataError: a camera has skew, which none of COLMAP's models has.
    """
    for K in cameras:
        if K[0, 1] != 0:
            raise DataError("COLMAP has no camera with skew", found=K.tolist(), expected="s = 0")
    model = folder / "sparse" / "0"
    for directory in (model, folder / "images", folder / "masks"):
        directory.mkdir(parents=True, exist_ok=True)
    for name, image, mask in zip(names, images, moving, strict=True):
        write_png(folder / "images" / name, image)
        black = np.where(mask, 0, 255)[..., None]
        write_png(folder / "masks" / f"{name}.png", np.repeat(black, 3, 2).astype("u1"))
    write_text(model / "cameras.txt", _cameras(cameras, images))
    write_text(model / "images.txt", _images(names, poses, seen))
    tracks: list[list[str]] = [[] for _ in cloud[0]]
    for i, (points, _) in enumerate(seen, 1):
        for k, point in enumerate(points):
            tracks[point].append(f"{i} {k}")
    rows = [
        f"{i} {x:.9g} {y:.9g} {z:.9g} {r} {g} {b} 0 {' '.join(track)}"
        for i, ((x, y, z), (r, g, b), track) in enumerate(zip(*cloud, tracks), 1)
    ]
    head = [
        f"# {title}",
        "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ]
    write_text(model / "points3D.txt", "\n".join([*head, *rows]) + "\n")


def _cameras(cameras: Sequence[Float], images: Sequence[Image]) -> str:
    """PINHOLE cameras; the first pixel's centre is (0.5, 0.5) in COLMAP, (0, 0) here."""
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] as fx, fy, cx, cy"]
    for i, (K, image) in enumerate(zip(cameras, images), 1):
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5
        size = f"{image.shape[1]} {image.shape[0]}"
        lines.append(f"{i} PINHOLE {size} {fx:.17g} {fy:.17g} {cx:.17g} {cy:.17g}")
    return "\n".join(lines) + "\n"


def _images(
    names: Sequence[str], poses: Sequence[RigidMotion], seen: Sequence[tuple[Int, Float]]
) -> str:
    lines = [
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME (cam_from_world)",
        "# POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for i, (pose, name, (points, uv)) in enumerate(zip(poses, names, seen), 1):
        x, y, z, w = pose.quaternion
        numbers = " ".join(f"{a:.17g}" for a in (w, x, y, z, *pose.t))
        lines.append(f"{i} {numbers} {i} {name}")
        lines.append(" ".join(f"{u:.6g} {v:.6g} {k + 1}" for k, (u, v) in zip(points, uv + 0.5)))
    return "\n".join(lines) + "\n"


def _points(result: Result, still: Mask) -> tuple[tuple[Float, Float], Float, NDArray[np.uint8]]:
    """Pixels (P, 2) in both images, points (P, 3) and colours (P, 3) on an even grid."""
    v, u = np.nonzero(thinned(still & result.sure, POINTS))
    rec = result.reconstruction
    uv = np.stack([u, v], axis=1).astype(float)
    return (uv, uv + rec.flow[v, u]), rec.points_ref[v, u], result.images[0][v, u]


def _moved(result: Result, moving: Mask) -> Mask:
    """(H', W') pixels of the next image that show independently moving parts, gaps closed."""
    rec = result.reconstruction
    height, width = rec.depth_next.shape
    v, u = np.nonzero(moving & np.isfinite(rec.flow).all(axis=2))
    at = np.floor(np.stack([u, v], 1) + rec.flow[v, u] + 0.5)
    # only points that are not hidden by the static scene
    inside = (at >= 0).all(1) & (at < [width, height]).all(1)
    u2, v2 = at[inside].astype(np.int64).T
    z = rec.points_next[v[inside], u[inside], 2]
    seen = z <= 1.05 * rec.depth_next[v2, u2]
    out = np.zeros((height, width), np.uint8)
    out[v2[seen], u2[seen]] = 1
    return np.asarray(cv2.morphologyEx(out, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0)
