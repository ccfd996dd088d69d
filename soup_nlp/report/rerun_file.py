"""A recording of both frames for the Rerun viewer (extra `rerun`)."""

from __future__ import annotations

import numpy as np

from soup_nlp.errors import DataError
from soup_nlp.report.result import Result
from soup_nlp.storage.atomic import PathLike, atomic_path


def write_rrd(path: PathLike, result: Result) -> None:
    """Write images, depth, cameras, points and components of both frames, on a timeline `frame`.

    The world is the reference camera (x right, y down, z ahead); the static scene does not move.

    Raises:
        DataError: the package rerun-sdk is not installed.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise DataError(
            "recordings need the package rerun-sdk",
            where=path,
            hint="pip install 'soup-nlp[rerun]'",
        ) from error
    poses = np.eye(4), result.components.camera.inverse.matrix
    with atomic_path(path) as temporary:
        out = rr.RecordingStream("soup_nlp")
        out.save(temporary)
        out.log("world", rr.ViewCoordinates.RDF, static=True)
        for frame in (0, 1):
            out.set_time("frame", sequence=frame)
            pose, image = poses[frame], result.images[frame]
            camera = rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
            out.log("world/camera", camera)
            size = [image.shape[1], image.shape[0]]
            out.log(
                "world/camera/image", rr.Pinhole(image_from_camera=result.K[frame], resolution=size)
            )
            out.log("world/camera/image/rgb", rr.Image(image).compress(jpeg_quality=92))
            depth = np.nan_to_num(result.depths[frame]).astype(np.float32)
            out.log("world/camera/image/depth", rr.DepthImage(depth, meter=1.0))
            points = result.points[frame] @ pose[:3, :3].T + pose[:3, 3]
            of_pixel = result.components.of_pixel
            for part in result.components:
                own = result.sure & (of_pixel == part.label)
                name = "background" if part.label == 0 else f"component_{part.label}"
                cloud = rr.Points3D(points[own], colors=result.images[0][own])
                out.log(f"world/{name}", cloud)
        out.flush()
        out.disconnect()
