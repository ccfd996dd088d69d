"""Flow of a trained network in an ONNX file (extra `onnx`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from soup_nlp.arrays import FloatMap, Image
from soup_nlp.data.flow.consistency import checked_flow
from soup_nlp.data.pair import Flow
from soup_nlp.errors import DataError
from soup_nlp.storage.files import require_file

RANGES = {"255": (0.0, 255.0), "unit": (0.0, 1.0), "signed": (-1.0, 1.0)}
"""Input values of black and white by the metadata `input_range` of an ONNX file; default "255"."""


class Network(NamedTuple):
    """A network that maps two images to a flow.

    Attributes:
        predict: Makes outputs, flows (1, 2, h, w) in pixels among them, of two images (1, 3, H, W).
        levels: Input values of black and white.
        size: Fixed (H, W) of the images, to which they are resized; None if they are padded to a
            multiple of 8.
    """

    predict: Callable[[list[FloatMap]], list[Any]]
    levels: tuple[float, float]
    size: tuple[int, int] | None = None


def learned_flow(source: str, image_ref: Image, image_next: Image) -> Flow:
    """Flow of a network in both directions, with forward-backward confidence.

    Args:
        source: Path of an .onnx file.
        image_ref: (H, W, 3) uint8 RGB reference image.
        image_next: (H, W, 3) uint8 RGB next image of the same size.

    Raises:
        DataError: the library or the file is missing, or the network gives no flow.
    """
    if image_ref.shape != image_next.shape or image_ref.shape[2:] != (3,):
        raise DataError(
            "a network needs two RGB images of one size",
            found=f"{image_ref.shape} and {image_next.shape}",
        )
    network = onnx_network(Path(source))
    forward = _run(network, image_ref, image_next, source)
    backward = _run(network, image_next, image_ref, source)
    return checked_flow(forward, backward, Path(source).name)


def learned_map(source: str, image: Image) -> FloatMap:
    """(h, w) depth or inverse depth of one image by a network; NaN where it is not positive.

    Args:
        source: Path of an .onnx file with one input (1, 3, H, W) and an output (1, h, w) or
            (1, 1, h, w), the last one of several.
        image: (H, W, 3) uint8 RGB image.

    Raises:
        DataError: the library or the file is missing, or the network gives no map.
    """
    network = onnx_network(Path(source), images=1)
    outputs, (rows, cols) = _outputs(network, (image,), source)
    maps = [np.squeeze(o) for o in outputs if np.ndim(o) in (3, 4)]
    maps = [m for m in maps if m.ndim == 2]
    if not maps:
        raise DataError(
            "network gives no map",
            where=source,
            found=[np.shape(o) for o in outputs],
            expected="an output (1, 1, h, w)",
        )
    found = cv2.resize(maps[-1].astype(np.float32), (cols, rows), interpolation=cv2.INTER_LINEAR)
    # what was added to reach a multiple of 8 goes again
    whole = found if network.size else found[: image.shape[0], : image.shape[1]]
    return np.where(np.isfinite(whole) & (whole > 0), whole, np.nan).astype(np.float32)


def onnx_network(path: Path, images: int = 2) -> Network:
    """A network of an ONNX file, run by onnxruntime on the CPU.

    Its inputs are two images (1, 3, H, W) or one stack (1, 6, H, W), float, RGB, or one image. Of
    the outputs for two the largest flow (1, 2, h, w) in pixels is used, and the last one of equal
    size.

    Raises:
        DataError: onnxruntime is not installed, or the file is missing or no such network.
    """
    require_file(path, "file of a network")
    try:
        import onnxruntime
    except ImportError as error:
        raise DataError(
            "an .onnx network needs onnxruntime", where=path, hint="pip install soup-nlp[onnx]"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime raises many types
        raise DataError(
            "file is no network that onnxruntime can run", where=path, found=_first_line(error)
        ) from error
    inputs = session.get_inputs()
    channels = [i.shape[1] if len(i.shape) == 4 else None for i in inputs]
    if channels not in ([[3, 3], [6]] if images == 2 else [[3]]):
        raise DataError(
            f"network does not take {'two images' if images == 2 else 'one image'}",
            where=path,
            found=[i.shape for i in inputs],
            expected="two inputs (1, 3, H, W), or one (1, 6, H, W)"
            if images == 2
            else "one input (1, 3, H, W)",
        )
    word = session.get_modelmeta().custom_metadata_map.get("input_range", "255")
    if word not in RANGES:
        raise DataError(
            "unknown input range of a network", where=path, found=word, expected=", ".join(RANGES)
        )
    kind = np.float16 if "float16" in inputs[0].type else np.float32
    height, width = inputs[0].shape[2:]

    def predict(images: list[FloatMap]) -> list[Any]:
        feed = images if len(inputs) == len(images) else [np.concatenate(images, axis=1)]
        named = {i.name: x.astype(kind) for i, x in zip(inputs, feed, strict=True)}
        return list(session.run(None, named))

    fixed = isinstance(height, int) and isinstance(width, int)
    return Network(predict, RANGES[word], (height, width) if fixed else None)


def _outputs(
    network: Network, given: tuple[Image, ...], where: str
) -> tuple[list[Any], tuple[int, int]]:
    """Outputs of a network for images (H, W, 3), and the (rows, columns) that it saw."""
    height, width = given[0].shape[:2]
    rows, cols = network.size or (-(-n // 8) * 8 for n in (height, width))
    black, white = network.levels
    images = []
    for image in given:
        if network.size:
            seen = cv2.resize(image, (cols, rows), interpolation=cv2.INTER_AREA)
        else:
            seen = np.pad(image, ((0, rows - height), (0, cols - width), (0, 0)), mode="edge")
        plane = np.ascontiguousarray(np.moveaxis(seen, 2, 0)[None], dtype=np.float32)
        images.append((plane / np.float32(255.0)) * np.float32(white - black) + np.float32(black))
    try:
        return network.predict(images), (rows, cols)
    except Exception as error:  # libraries raise many types
        raise DataError("network failed", where=where, found=_first_line(error)) from error


def _run(network: Network, first: Image, second: Image, where: str) -> FloatMap:
    """(H, W, 2) flow of a network, in pixels of the images (H, W, 3)."""
    height, width = first.shape[:2]
    outputs, (rows, cols) = _outputs(network, (first, second), where)
    flows = [o for o in outputs if np.ndim(o) == 4 and o.shape[:2] == (1, 2)]
    if not flows:
        raise DataError(
            "network gives no flow",
            where=where,
            found=[np.shape(o) for o in outputs],
            expected="an output (1, 2, h, w)",
        )
    best = max(reversed(flows), key=lambda o: o.shape[2] * o.shape[3])
    flow = np.moveaxis(best[0].astype(np.float32), 0, 2)
    # displacements are in pixels of the images that the network saw
    target = (width, height) if network.size else (cols, rows)
    scale = np.array([target[0] / cols, target[1] / rows], np.float32)
    if flow.shape[1::-1] != target:
        flow = cv2.resize(flow, target, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(flow[:height, :width] * scale, dtype=np.float32)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
