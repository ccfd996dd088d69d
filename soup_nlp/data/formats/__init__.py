"""Readers and writers of the file formats of the field, under one name.

The parts live beside this file: images in `formats_image`, flow in `formats_flow`, depth and
disparity in `formats_depth`, cameras in `formats_camera`. Every reader raises `DataError` for a
file that is missing, truncated or of another format; every writer leaves a whole file or none.
"""

from __future__ import annotations

from soup_nlp.data.formats.camera_files import (
    read_cam,
    read_intrinsics,
    read_kitti_calib,
    read_vkitti2_intrinsics,
    vkitti1_intrinsics,
    write_cam,
)
from soup_nlp.data.formats.depth_files import (
    read_depth,
    read_depth_png16,
    read_dpt,
    read_kitti_disparity,
    read_pfm,
    read_vkitti_depth,
    write_depth_png16,
    write_dpt,
    write_kitti_disparity,
    write_pfm,
)
from soup_nlp.data.formats.flow_files import (
    read_flo,
    read_flow,
    read_kitti_flow,
    read_vkitti_flow,
    write_flo,
    write_kitti_flow,
)
from soup_nlp.data.formats.images import read_image, read_mask

__all__ = [
    "read_cam",
    "read_depth",
    "read_depth_png16",
    "read_dpt",
    "read_flo",
    "read_flow",
    "read_image",
    "read_intrinsics",
    "read_kitti_calib",
    "read_kitti_disparity",
    "read_kitti_flow",
    "read_mask",
    "read_pfm",
    "read_vkitti2_intrinsics",
    "read_vkitti_depth",
    "read_vkitti_flow",
    "vkitti1_intrinsics",
    "write_cam",
    "write_depth_png16",
    "write_dpt",
    "write_flo",
    "write_kitti_disparity",
    "write_kitti_flow",
    "write_pfm",
]
