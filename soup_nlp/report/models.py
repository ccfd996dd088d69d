"""Meshes as GLB (glTF 2.0, binary), COLMAP's text model, images and masks for other programs."""

import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.errors import DataError, printable
from soup_nlp.geometry.camera import project
from soup_nlp.geometry.surface import triangles, whole_cells
from soup_nlp.report.chain import STILL, Chain, Frame
from soup_nlp.report.clouds import Cloud, fuse, projected
from soup_nlp.report.figures import write_png
from soup_nlp.report.result import Result
from soup_nlp.storage.files import PathLike, write_bytes, write_text

CELLS = 250_000
"""Largest number of cells of a mesh; larger images are subsampled."""
QUALITY = 92
"""JPEG quality of the texture."""
GLTF = np.diag([1.0, -1.0, -1.0])
"""glTF has y up and looks along -z: half a turn about x from a camera's axes."""


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


def write_glb(path: PathLike, chain: Chain, number: int) -> None:
    """Write the surface of a frame, textured with its pair's reference image.

    Axes are those of glTF: x right, y up; the frame's camera of a pair, the first one of a chain,
    looks along -z from the origin. Extras of the asset name the unit of length.
    """
    import trimesh
    from PIL import Image

    k, side = chain.seen(number)
    vertices, faces, pixels = surface_mesh(chain.pairs[k], side)
    pose = STILL if chain.single else chain.world_from_camera[number]
    image = chain.pairs[k].images[0]
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
        pose(vertices) @ GLTF,
        faces,
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    name = f"frame {chain.names[number]}"
    camera = name if chain.single else "the first frame"
    extras = {"unit": chain.unit, "frame": f"camera of {camera}, y up, looking along -z"}
    scene = trimesh.Scene(metadata=extras)
    scene.add_geometry(mesh, node_name=name, geom_name=name)
    write_bytes(path, scene.export(file_type="glb"))


# --- COLMAP's text model -------------------------------------------------------------------------

POINTS = 50_000
"""Largest number of points of a model."""
VISIBLE = 0.03
"""A point is visible in a frame if log depths of point and frame differ by less than this."""


def write_views(folder: Path, chain: Chain) -> None:
    """Write `images/`, and `masks/` that are black where something moves by itself.

    Raises:
        DataError: a camera has skew, which the models of other programs do not have.
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

    Raises:
        DataError: a camera has skew, which none of COLMAP's models has.
    """
    write_views(folder, chain)
    model, cloud = folder / "sparse" / "0", fuse(chain, POINTS)
    model.mkdir(parents=True, exist_ok=True)
    seen = [_seen(cloud, frame) for frame in chain]
    write_text(model / "cameras.txt", _cameras(chain))
    write_text(model / "images.txt", _images(chain, seen))
    tracks: list[list[str]] = [[] for _ in cloud]
    for i, (points, _) in enumerate(seen, 1):
        for k, point in enumerate(points):
            tracks[point].append(f"{i} {k}")
    rows = [
        f"{i} {x:.9g} {y:.9g} {z:.9g} {r} {g} {b} 0 {' '.join(track)}"
        for i, ((x, y, z), (r, g, b), track) in enumerate(
            zip(cloud["points"], cloud["colours"], tracks), 1
        )
    ]
    head = [
        printable(f"# {chain.name}; unit: {chain.unit}"),
        "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ]
    write_text(model / "points3D.txt", "\n".join([*head, *rows]) + "\n")


def _seen(cloud: Cloud, frame: Frame) -> tuple[Int, Float]:
    """Indices of the points that a frame shows, and their pixels (M, 2)."""
    inside, v, u, z = projected(frame, cloud["points"])
    with np.errstate(invalid="ignore", divide="ignore"):
        near = np.abs(np.log(z / frame.depth[v, u])) < VISIBLE
    at = np.flatnonzero(inside & near)
    return at, project(frame.K, frame.pose.inverse(cloud["points"][at]))


def _cameras(frames: Iterable[Frame]) -> str:
    """PINHOLE cameras; the first pixel's centre is (0.5, 0.5) in COLMAP, (0, 0) here."""
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] as fx, fy, cx, cy"]
    for i, frame in enumerate(frames, 1):
        K, (height, width) = frame.K, frame.depth.shape
        numbers = " ".join(f"{x:.17g}" for x in (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
        lines.append(f"{i} PINHOLE {width} {height} {numbers}")
    return "\n".join(lines) + "\n"


def _images(frames: Iterable[Frame], seen: Sequence[tuple[Int, Float]]) -> str:
    lines = [
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME (cam_from_world)",
        "# POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for i, (frame, (points, uv)) in enumerate(zip(frames, seen, strict=True), 1):
        pose = frame.pose.inverse
        x, y, z, w = pose.quaternion
        numbers = " ".join(f"{a:.17g}" for a in (w, x, y, z, *pose.t))
        lines.append(f"{i} {numbers} {i} {frame.name}.png")
        lines.append(" ".join(f"{u:.6g} {v:.6g} {k + 1}" for k, (u, v) in zip(points, uv + 0.5)))
    return "\n".join(lines) + "\n"
