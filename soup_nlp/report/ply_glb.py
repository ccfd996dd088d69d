"""Coloured point clouds as PLY (binary, 1.0), textured meshes as GLB (glTF 2.0, binary)."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Float, Int
from soup_nlp.geometry.surface import triangles
from soup_nlp.report.result import Result
from soup_nlp.storage.files import PathLike, write_bytes

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
    """Write a coloured point cloud (binary little endian, float32 and uchar) atomically.

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


def write_cloud(path: PathLike, result: Result, frame: int) -> int:
    """Write the points of the reference image in frame 0 or 1 as PLY; returns their number.

    Properties beside position, normal and colour: `confidence` of the flow, `component`, and
    `sigma_log_depth` if it is known. Points that are not `result.sure` are left out.
    """
    keep = result.sure
    scalars = {"confidence": result.flow_confidence, "component": result.components.of_pixel}
    if result.sigma is not None:
        scalars["sigma_log_depth"] = result.sigma
    name = ("reference", "next")[frame]
    comments = [
        f"{result.name}: points of the reference image in the {name} frame",
        f"frame: camera of the {name} frame, {AXES}",
        f"unit: {result.unit}",
        "confidence: of the flow, 0 to 1; component: what moves as one, 0 is the background",
        f"{keep.mean():.1%} of the pixels: without hidden ones, those at jumps of the depth, and"
        " guesses (output.min_confidence=0 keeps them)",
    ]
    return write_ply(
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
    faces = triangles(*result.surface, known, step)
    used, faces = np.unique(faces, return_inverse=True)
    pixels = np.stack([used % width, used // width], axis=1).astype(float)
    return points.reshape(-1, 3)[used], faces.reshape(-1, 3), pixels


def write_glb(path: PathLike, result: Result, frame: int) -> int:
    """Write the mesh of frame 0 or 1, textured with the image; returns the number of triangles.

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
    return len(faces)
