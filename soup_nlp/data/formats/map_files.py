"""Flow and depth files: Middlebury .flo, Sintel .dpt, .pfm, 16-bit PNG, NumPy arrays.

A flow is (H, W, 2) float64 of float32 precision, displacement (u right, v down) in pixels, NaN in
both components where unknown; a depth is (H, W) float64, z along the optical axis, NaN where
unknown, as for zero, negative and infinite values.

Every reader raises `DataError` for a file that is missing, empty, of another format, of an
impossible size, or longer or shorter than its header says.
"""

import io
import re
import struct
import zipfile
from collections.abc import Callable, Mapping
from numbers import Real
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from soup_nlp.arrays import Float, FloatMap
from soup_nlp.data.formats.images import array_of, check_body, decode, decode_png16, is_path, warn
from soup_nlp.errors import DataError, repr_of
from soup_nlp.schema.section import MAX_PIXELS, check_image_size
from soup_nlp.storage.files import PathLike, as_path, read_bytes

FlowLike: TypeAlias = Any
"""Displacements in pixels, (H, W, 2) or (2, H, W), or a file (.flo, KITTI .png, .npy)."""
Reader = Callable[[PathLike], NDArray[Any]]

MAGIC = b"PIEH"
"""First four bytes of .flo, .dpt and .cam files; as a little-endian float32 they read 202021.25."""
UNKNOWN_FLOW = 1e9
"""A component larger than this marks an unknown flow."""
VKITTI_SKY = 65535
"""Value of Virtual KITTI for depths of 655.35 m and more, such as the sky."""
KITTI_DISPARITY = 256.0
"""Values per pixel of a KITTI disparity image."""
MILLIMETRES = 1000.0
"""Values per unit of length of a depth image that is assumed if none are given."""


def after_magic(path: PathLike, what: str) -> bytes:
    """Content of a file of Sintel or Middlebury behind `MAGIC`, which it must start with."""
    content = read_bytes(path, what)
    if not content.startswith(MAGIC):
        raise DataError(
            f"{what} has the wrong magic number",
            where=path,
            found=repr(content[:4]),
            expected=f"{MAGIC!r} (float 202021.25)",
            hint=f"is it really a {Path(path).suffix} file?",
        )
    return content[4:]


def _floats(body: bytes, size: tuple[int, ...], order: str, path: PathLike, what: str) -> FloatMap:
    """The float32 numbers (H, W, ...), of byte order `order`, behind the header of a file."""
    check_image_size(size[1], size[0], what, path)
    check_body(len(body), 4 * int(np.prod(size)), path, what)
    return np.frombuffer(body, f"{order}f4").reshape(size).astype(np.float32)


def _read_pieh(path: PathLike, what: str, *channels: int) -> FloatMap:
    """(H, W, *channels) of a .flo or .dpt file: magic, int32 width and height, float32 by rows."""
    content = after_magic(path, what)
    check_body(min(len(content), 8), 8, path, f"{what} header")
    width, height = struct.unpack("<ii", content[:8])
    return _floats(content[8:], (height, width, *channels), "<", path, what)


def read_arrays(path: PathLike, what: str) -> dict[str, NDArray[Any]]:
    """The arrays of real numbers of a .npz file, by name, or that of a .npy file under ""."""
    content, most = read_bytes(path, what), 32 * MAX_PIXELS
    try:
        stored = {"": content}
        if content.startswith(b"PK"):
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                # a small file may be large when unpacked
                size = sum(entry.file_size for entry in archive.infolist())
                if size > most:
                    raise ValueError(f"{size} bytes in it, at most {most} are read")
                stored = {name: archive.read(name) for name in archive.namelist()}
        streams = {name.removesuffix(".npy"): io.BytesIO(part) for name, part in stored.items()}
        arrays = {n: npy.read_array(part, allow_pickle=False) for n, part in streams.items()}
    except Exception as error:  # parsing a header, a Python literal, raises many types
        raise DataError(f"{what} holds no readable array", where=path, found=error) from error
    for name, array in arrays.items():
        found = array.dtype if array.dtype.kind not in "fiu" else ""
        if found or streams[name].read(1):
            raise DataError(
                f"{what} does not hold numbers" if found else f"{what} has bytes left over",
                where=f"{path}, {name}" if name else path,
                found=found or None,
                expected="arrays of real numbers",
            )
    return arrays


def _array(path: PathLike, what: str) -> NDArray[Any]:
    arrays = read_arrays(path, what)
    if "" not in arrays:
        raise DataError(f"{what} is not one array", where=path, expected="a .npy file")
    return arrays[""]


def _by_suffix(path: PathLike, readers: Mapping[str, Reader], what: str) -> NDArray[Any]:
    suffix = as_path(path, f"{what} file").suffix.lower()
    if suffix not in readers:
        raise DataError(
            f"{what} file has an unknown suffix",
            where=path,
            found=suffix or "no suffix",
            expected=", ".join(readers),
        )
    return readers[suffix](path)


def flow_layout(flow: NDArray[Any], where: PathLike) -> NDArray[Any]:
    """A flow (H, W, 2), or (2, H, W) whose last axis has another length than 2, as (H, W, 2)."""
    if flow.ndim == 3 and flow.shape[0] == 2 and flow.shape[2] != 2:
        flow = np.moveaxis(flow, 0, 2)
    if flow.ndim != 3 or flow.shape[2] != 2:
        batch = flow.ndim == 4 and len(flow) == 1
        raise DataError(
            "flow has the wrong shape",
            where=where,
            found=flow.shape,
            expected="(H, W, 2) or (2, H, W)",
            hint="flow[0] takes it out of its batch" if batch else None,
        )
    return flow


def _known_flow(flow: NDArray[Any], path: PathLike) -> Float:
    """The flow with NaN in both components where one of them is unknown; see `flow_layout`."""
    flow = flow_layout(flow, path)
    check_image_size(flow.shape[1], flow.shape[0], "flow", path)
    with np.errstate(over="ignore"):
        out = np.array(flow, dtype=np.float32)
    out[~(np.abs(out) <= UNKNOWN_FLOW).all(axis=2)] = np.nan
    return out.astype(np.float64)


def _read_flow_png(path: PathLike, what: str) -> Float:
    """(H, W, 2) values of a 16-bit flow PNG, R and G; NaN where B is 0."""
    bgr = decode_png16(path, 3, what)
    code = bgr[:, :, :0:-1].astype(np.float64)
    valid = bgr[:, :, 0] > 0
    if valid.any() and code[valid, 0].max() <= 1:
        raise DataError(
            f"{what} has its channels exchanged",
            where=path,
            found="R of 0 and 1 only, which are the values of the mask",
            expected="R and G for u and v, B for the mask",
            hint="OpenCV writes channels in the order B, G, R: reverse them before",
        )
    code[~valid] = np.nan
    return code


def read_vkitti_flow(path: PathLike) -> Float:
    """Read a Virtual KITTI flow PNG, u = (2 R / 65535 - 1) (W - 1), v likewise, B = 0 unknown."""
    unit = 2.0 / 65535.0 * _read_flow_png(path, "Virtual KITTI flow") - 1.0
    return _known_flow(unit * np.subtract(unit.shape[1::-1], 1), path)


def read_flow(path: PathLike) -> Float:
    """Read a flow by the suffix of its file.

    - `.flo` is Middlebury's, also used by Sintel; NaN and values above 1e9 are unknown.
    - `.png` is KITTI's (Virtual KITTI needs `read_vkitti_flow`): 16-bit RGB, u = (R - 2^15) / 64,
      v = (G - 2^15) / 64, B > 0 valid.
    - `.npy` is an array (H, W, 2) or (2, H, W) in pixels, unknown as in `.flo`.
    """
    readers: dict[str, Reader] = {
        ".flo": lambda p: _read_pieh(p, "flow file", 2),
        ".png": lambda p: (_read_flow_png(p, "KITTI flow") - 2.0**15) / 64.0,
        ".npy": lambda p: _array(p, "flow file"),
    }
    return _known_flow(_by_suffix(path, readers, "flow"), path)


def read_confidence(path: PathLike) -> NDArray[Any]:
    """The confidence of a .npy file, or of a grey image of 8 or 16 bits (black is 0, white 1)."""
    if Path(path).suffix == ".npy":
        return _array(path, "confidence file")
    image = decode(path, "confidence map")
    return image / np.iinfo(image.dtype).max if image.dtype.kind == "u" else image


def known_depth(depth: NDArray[Any], path: PathLike) -> Float:
    """A map (H, W) as float64 with NaN where it is not positive and finite."""
    if depth.ndim != 2 or depth.size == 0:
        one = np.squeeze(depth).ndim == 2
        raise DataError(
            "depth has the wrong shape",
            where=path,
            found=depth.shape,
            expected="(H, W)",
            hint="numpy.squeeze(depth) takes it out of its batch" if one else None,
        )
    check_image_size(depth.shape[1], depth.shape[0], "depth", path)
    out = np.array(depth, dtype=np.float64)
    finite = out[np.isfinite(out)]
    if finite.size and finite.min() < 0 >= finite.max():
        raise DataError(
            "depth is negative everywhere",
            where=path,
            found=f"values {finite.min():.4g} to {finite.max():.4g}",
            expected="positive numbers, 0 or NaN where unknown",
            hint="give its negative: it seems to be z of axes that point back (OpenGL), or a"
            " disparity of the other sign (a depth prior of kind inverse)",
        )
    out[~(np.isfinite(out) & (out > 0))] = np.nan
    return out


def _read_pfm(path: PathLike) -> FloatMap:
    """The map of a grey .pfm file, row 0 at the top; the sign of its scale is the byte order."""
    content = read_bytes(path, "PFM file")
    number = rb"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"
    gap = rb"\s+(?:#[^\n]*\n\s*)*"
    pattern = gap.join([rb"Pf", rb"(-?\d+)", rb"(-?\d+)", number]) + rb"[ \t]*\r?\n"
    header = re.match(pattern, content[:4096])
    scale = float(header.group(3)) if header else 0.0
    if header is None or scale == 0.0:
        raise DataError(
            "PFM file has a damaged header",
            where=path,
            found=repr(content[:24]),
            expected="'Pf' (grey), width height, scale (negative: little endian)",
        )
    size = int(header.group(2)), int(header.group(1))
    order = "<" if scale < 0 else ">"
    return _floats(content[header.end() :], size, order, path, "PFM file")[::-1]


def read_depth_png16(path: PathLike, scale: float) -> Float:
    """Read a 16-bit grey PNG of depth = value / scale, 0 where unknown.

    The scale is 1000 for millimetres, 5000 for TUM RGB-D, 256 for KITTI depth, 100 for Virtual
    KITTI; `KITTI_DISPARITY` gives disparities in pixels.
    """
    if not (isinstance(scale, Real) and 0 < scale < 1e300):
        raise DataError(
            "depth scale must be positive",
            where=path,
            found=repr_of(scale),
            expected="values per unit of length, e.g. 1000 for millimetres",
        )
    return known_depth(decode_png16(path, 1, "depth image") / float(scale), path)


def read_vkitti_depth(path: PathLike) -> Float:
    """Depth in metres of a Virtual KITTI PNG: 16-bit grey, centimetres, 65535 for the sky."""
    depth = read_depth_png16(path, 100.0)
    depth[depth >= VKITTI_SKY / 100.0] = np.nan
    return depth


def read_depth(path: PathLike, scale: float | None = None, usual: float = MILLIMETRES) -> Float:
    """Read a depth by the suffix of its file: .dpt (Sintel), .npy, .npz, .pfm or 16-bit .png.

    `scale` are the values per unit of length of a .png; without it `usual` is assumed, with a
    warning. The magnitude of the scale in a .pfm is ignored.
    """

    def by_scale(path: PathLike) -> Float:
        if scale is None:
            taken = f"{usual:g} values per unit of length; depth_scale (--depth-scale) sets them"
            warn(Path(path).parent, f"the scale of its 16-bit depth is not given; assumed: {taken}")
        return read_depth_png16(path, usual if scale is None else scale)

    readers: dict[str, Reader] = {
        ".dpt": lambda p: _read_pieh(p, "depth file"),
        ".npy": lambda p: _array(p, "depth file"),
        ".npz": _one_map,
        ".pfm": _read_pfm,
        ".png": by_scale,
    }
    return known_depth(_by_suffix(path, readers, "depth"), path)


def _one_map(path: PathLike) -> NDArray[Any]:
    """The array named depth of a .npz file, or the only one of two axes."""
    arrays = read_arrays(path, "depth file")
    maps = {name: a for name, a in arrays.items() if np.squeeze(a).ndim == 2}
    if "depth" not in arrays and len(maps) != 1:
        raise DataError(
            "depth file does not hold one map",
            where=path,
            found=", ".join(f"{name} {a.shape}" for name, a in arrays.items()) or "no array",
            expected="one array (H, W), or one of the name depth",
        )
    return arrays["depth"] if "depth" in arrays else maps.popitem()[1]


def prior_of(source: Any) -> Float:
    """(H, W) values of a depth prior, NaN where they are not positive and finite.

    It is an array, a depth file of any scale, or an 8-bit grey picture.
    """
    if not is_path(source):
        values = array_of(source, "depth prior", "prior", "numbers (H, W), or a path")
        return known_depth(values, "prior")
    path = str(source)
    image = decode(path, "depth prior") if Path(path).suffix.lower() == ".png" else np.empty(0)
    # a grey picture may be stored in colour
    grey = image[:, :, 0] if image.ndim == 3 else image
    if image.dtype != np.uint8 or (image.ndim == 3 and (image[:, :, :3] != grey[..., None]).any()):
        return read_depth(path, 1.0)
    few = f"a depth prior of 8 bits has {len(np.unique(grey))} different values; assumed: its grey"
    warn(path, f"{few} values, of which black is unknown; a file of numbers is more exact")
    return known_depth(grey, path)
