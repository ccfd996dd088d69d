"""Flow of a trained network: RAFT of torchvision, or any ONNX file (optional extras)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.flow.consistency import FloatMap, checked_flow
from soup_nlp.data.pair import Flow
from soup_nlp.errors import DataError

Image = NDArray[np.uint8]
Network = Callable[[Image, Image], FloatMap]

MODELS: Mapping[str, str] = MappingProxyType(
    {"raft_small": "Raft_Small_Weights", "raft_large": "Raft_Large_Weights"}
)
"""Networks of torchvision by name, with the name of their weights (fetched once by torchvision)."""

RANGES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"255": (0.0, 255.0), "unit": (0.0, 1.0), "signed": (-1.0, 1.0)}
)
"""What black and white are to an ONNX network; a file says which by the metadata key
`input_range`, "255" where it does not."""

RAFT_SIDE = 128
"""Smallest image side of RAFT, pixels: its correlation pyramid has four levels of 1/8 size."""


def learned_flow(source: str, image_ref: Image, image_next: Image) -> Flow:
    """Flow of a network in both directions, with forward-backward confidence.

    Args:
        source: "raft_small", "raft_large", a .pth file with the state of either, or an .onnx file.
        image_ref: (H, W, 3) uint8 RGB reference image.
        image_next: (H, W, 3) uint8 RGB next image of the same size.

    Raises:
        DataError: the library or the file is missing, or the network does not map two images to a
            flow.
    """
    if image_ref.shape != image_next.shape or image_ref.shape[2:] != (3,):
        raise DataError(
            "a network needs two RGB images of one size",
            found=f"{image_ref.shape} and {image_next.shape}",
        )
    if source not in MODELS and not Path(source).is_file():
        raise DataError("file of a network is missing", where=source)
    network = onnx_network(Path(source)) if source.endswith(".onnx") else raft_network(source)
    forward, backward = network(image_ref, image_next), network(image_next, image_ref)
    return checked_flow(forward, backward, Path(source).name)


def onnx_network(path: Path) -> Network:
    """A network of an ONNX file, run by onnxruntime on the CPU.

    It takes two images (1, 3, H, W) or one stack (1, 6, H, W), float, RGB, and gives one or more
    flows (1, 2, h, w) in pixels; the largest one, the last of equals, is taken. Images are padded
    to multiples of 8, or resized where the file fixes H and W; the flow is brought back to the
    image's size and pixels.

    Raises:
        DataError: onnxruntime is not installed, or the file is no such network.
    """
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
    except Exception as error:  # onnxruntime has many of its own
        raise DataError(
            "file is no network that onnxruntime can run", where=path, found=_first_line(error)
        ) from error
    inputs = session.get_inputs()
    channels = [i.shape[1] if len(i.shape) == 4 else None for i in inputs]
    if channels not in ([3, 3], [6]):
        raise DataError(
            "network does not take two images",
            where=path,
            found=[i.shape for i in inputs],
            expected="two inputs (1, 3, H, W), or one (1, 6, H, W)",
        )
    meta = session.get_modelmeta().custom_metadata_map
    word = meta.get("input_range", "255")
    if word not in RANGES:
        raise DataError(
            "unknown input range of a network", where=path, found=word, expected=", ".join(RANGES)
        )
    black, white = RANGES[word]
    kind = np.float16 if "float16" in inputs[0].type else np.float32
    fixed = tuple(inputs[0].shape[2:])

    def run(first: Image, second: Image) -> FloatMap:
        size = first.shape[:2]
        work = fixed if all(isinstance(s, int) for s in fixed) else _multiple(size, 8)
        resized = work == fixed
        planes = [_fit(image, work, resized) for image in (first, second)]
        planes = [((p / 255.0) * (white - black) + black).astype(kind) for p in planes]
        feed = planes if len(inputs) == 2 else [np.concatenate(planes, axis=1)]
        try:
            out = session.run(None, {i.name: p for i, p in zip(inputs, feed, strict=True)})
        except Exception as error:
            raise DataError("network failed", where=path, found=_first_line(error)) from error
        return _flow_of(out, size, work, resized, str(path))

    return run


def raft_network(source: str) -> Network:
    """RAFT of torchvision with its published weights, or with those of a .pth file.

    Raises:
        DataError: torchvision is not installed, or the weights cannot be loaded.
    """
    try:
        import torch
        from torchvision.models import optical_flow
    except ImportError as error:
        raise DataError(
            "RAFT needs torch and torchvision", where=source, hint="pip install soup-nlp[raft]"
        ) from error
    try:
        if source in MODELS:
            weights: Any = getattr(optical_flow, MODELS[source]).DEFAULT
            model = getattr(optical_flow, source)(weights=weights, progress=False)
        else:
            state = torch.load(source, map_location="cpu", weights_only=True)
            # only the large network has batch normalisation in its context encoder
            large = any("context_encoder" in k and "running_mean" in k for k in state)
            model = (optical_flow.raft_large if large else optical_flow.raft_small)(weights=None)
            model.load_state_dict(state)
    except Exception as error:  # urllib, pickle and torch each raise their own
        raise DataError(
            "weights of RAFT cannot be loaded",
            where=source,
            found=_first_line(error),
            hint="give a .pth file with the state of torchvision's raft_small or raft_large",
        ) from error
    model.eval()

    def run(first: Image, second: Image) -> FloatMap:
        size = first.shape[:2]
        work = _multiple((max(size[0], RAFT_SIDE), max(size[1], RAFT_SIDE)), 8)
        planes = [_fit(image, work, False) / 127.5 - 1.0 for image in (first, second)]
        with torch.inference_mode():
            out = model(*(torch.from_numpy(p.astype(np.float32)) for p in planes))
        return _flow_of([out[-1].numpy()], size, work, False, source)

    return run


def _multiple(size: tuple[int, int], of: int) -> tuple[int, int]:
    return (-(-size[0] // of) * of, -(-size[1] // of) * of)


def _fit(image: Image, size: tuple[int, int], resize: bool) -> FloatMap:
    """(1, 3, H, W) image of a size, resized or padded at its right and lower edge."""
    if resize:
        out = cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA)
    else:
        below, right = size[0] - image.shape[0], size[1] - image.shape[1]
        out = np.pad(image, ((0, below), (0, right), (0, 0)), mode="edge")
    return np.ascontiguousarray(np.moveaxis(out, 2, 0)[None], dtype=np.float32)


def _flow_of(
    outputs: list[Any], size: tuple[int, int], work: tuple[int, int], resized: bool, where: str
) -> FloatMap:
    """(H, W, 2) flow in pixels of the image from a network's outputs."""
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
    target = size if resized else work
    h, w = flow.shape[:2]
    if (h, w) != target:
        flow = cv2.resize(flow, (target[1], target[0]), interpolation=cv2.INTER_LINEAR)
    # displacements are in pixels of the images that the network saw
    scale = (size[1] / work[1], size[0] / work[0]) if resized else (1.0, 1.0)
    out = flow[: size[0], : size[1]] * np.array(scale, np.float32)
    return np.ascontiguousarray(out, dtype=np.float32)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
