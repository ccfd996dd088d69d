"""Motions of the camera and of every rigid component: motions.json and a TUM trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.rotation import log
from soup_nlp.report.pointcloud import AXES
from soup_nlp.report.result import Result

CONVENTIONS = {
    "axes": f"of a camera: {AXES}",
    "matrix": "row-major 4x4 of homogeneous points: X_next = next_from_ref X_ref",
    "next_from_ref": "moves points from the reference camera's coordinates to the next camera's;"
    " of a component it includes the motion of the camera",
    "own_motion": "what a component does by itself, in the reference camera's coordinates:"
    " inverse(camera.next_from_ref) component.next_from_ref",
    "quaternion_xyzw": "of the rotation, scalar last",
    "rotation_deg": "rotation vector: axis times angle, degrees",
    "position_in_ref": "where the next camera is, in the reference camera's coordinates",
    "label": "value in components/of_superpixel of result.h5; 0 is the background",
    "residual_px": "median distance in the next image between this one motion and those of the"
    " superpixels; large where the component is not rigid",
    "borrowed": "share of its pixels whose depth is a guess from neighbours",
    "scale": "a component that moves by itself has a scale of its own, which no flow determines:"
    " its translation is as good as its depth",
}
"""Meaning of the entries of motions.json."""


def motions(result: Result) -> dict[str, Any]:
    """Contents of motions.json."""
    parts = result.components
    camera = parts.camera
    return {
        "name": result.name,
        "unit": result.unit,
        "conventions": CONVENTIONS,
        "camera": {**_motion(camera), "position_in_ref": camera.centre},
        "components": [
            {
                "label": part.label,
                "background": part.label == 0,
                "superpixels": part.superpixels,
                "pixels": part.pixels,
                "share": part.pixels / parts.of_pixel.size,
                "centre_ref": part.centre,
                "centre_next": part.motion(part.centre),
                **_motion(part.motion),
                "own_motion": {
                    **_turn(parts.own_motion(part.label)),
                    "matrix": parts.own_motion(part.label).matrix,
                    "displacement": parts.own_motion(part.label)(part.centre) - part.centre,
                },
                "residual_px": part.residual_px,
                "borrowed": part.borrowed,
            }
            for part in parts
        ],
    }


def trajectory(result: Result) -> str:
    """Poses of the camera in the format of the TUM benchmark, ref_from_camera, frames 0 and 1."""
    still = RigidMotion(np.eye(3), np.zeros(3))
    lines = [
        "# timestamp tx ty tz qx qy qz qw: position and orientation of the camera in the"
        " reference frame's camera coordinates",
        f"# axes: {AXES}; timestamp: frame number; unit: {result.unit}",
    ]
    return tum_text(lines, (still, result.components.camera.inverse))


def tum_text(comments: Sequence[str], poses: Sequence[RigidMotion]) -> str:
    """Poses in the format of the TUM benchmark, below some comments."""
    lines = [
        f"{k} " + " ".join(f"{x:.9g}" for x in (*pose.t, *pose.quaternion))
        for k, pose in enumerate(poses)
    ]
    return "\n".join([*comments, *lines]) + "\n"


def _motion(motion: RigidMotion) -> dict[str, Any]:
    return {"next_from_ref": motion.matrix, "translation": motion.t, **_turn(motion)}


def _turn(motion: RigidMotion) -> dict[str, Any]:
    return {"rotation_deg": np.degrees(log(motion.R)), "quaternion_xyzw": motion.quaternion}
