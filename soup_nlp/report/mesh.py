"""Textured meshes of both frames as GLB (glTF 2.0, binary)."""

from __future__ import annotations

import io

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.geometry.surface import triangles
from soup_nlp.report.result import Result
from soup_nlp.storage.atomic import PathLike, write_bytes

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
