"""Flow and depth of a trained network in an ONNX file (extra `onnx`)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from soup_nlp.arrays import FloatMap, Image
from soup_nlp.data.flow.consistency import confidence_of, round_trip_error
from soup_nlp.data.pair import Flow
from soup_nlp.errors import DataError, optional
from soup_nlp.storage.files import require_file

RANGES = {"255": (0.0, 255.0), "unit": (0.0, 1.0), "signed": (-1.0, 1.0)}
"""Input values of black and white by the metadata `input_range` of an ONNX file; default "255"."""


class Network:
    """A network that onnxruntime runs on the CPU.

    Its inputs are one or two images (1, 3, H, W), `count`, or one stack (1, 6, H, W) of two, float,
    RGB. Images are resized to a fixed size of the inputs, or else padded to a multiple of 8.
    """

    def __init__(self, source: str, count: int) -> None:
        self.source = source
        require_file(source, "file of a network")
        onnxruntime = optional("onnxruntime", "onnx")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        try:
            self.session = onnxruntime.InferenceSession(
                source, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime raises many types
            what = "file is no network that onnxruntime can run"
            raise DataError(what, where=source, found=_first_line(error)) from error
        inputs = self.session.get_inputs()
        shapes = [i.shape for i in inputs]
        channels = [shape[1] if len(shape) == 4 else None for shape in shapes]
        if channels not in ([3] * count, [3 * count]):
            what = f"network does not take {('one image', 'two images')[count - 1]}"
            expected = f"{count} x (1, 3, H, W), or one input (1, {3 * count}, H, W)"
            raise DataError(what, where=source, found=shapes, expected=expected)
        word = self.session.get_modelmeta().custom_metadata_map.get("input_range", "255")
        if word not in RANGES:
            what = "unknown input range of a network"
            raise DataError(what, where=source, found=word, expected=", ".join(RANGES))
        self.levels = RANGES[word]
        self.names = [i.name for i in inputs]
        self.kind = np.float16 if "float16" in inputs[0].type else np.float32
        height, width = shapes[0][2:]
        self.size = (height, width) if isinstance(height, int) and isinstance(width, int) else None

    def outputs(
        self, fits: Callable[[Any], bool], kind: str, *images: Image
    ) -> tuple[list[Any], tuple[int, int]]:
        """Outputs for images (H, W, 3) that fit a kind, "map (1, 1, h, w)"; the size of inputs."""
        height, width = images[0].shape[:2]
        rows, cols = self.size or (-(-n // 8) * 8 for n in (height, width))
        black, white = self.levels
        planes = []
        for image in images:
            if self.size:
                seen = cv2.resize(image, (cols, rows), interpolation=cv2.INTER_AREA)
            else:
                seen = np.pad(image, ((0, rows - height), (0, cols - width), (0, 0)), mode="edge")
            plane = np.ascontiguousarray(np.moveaxis(seen, 2, 0)[None], dtype=np.float32)
            planes.append((plane / np.float32(255.0)) * np.float32(white - black) + black)
        feed = planes if len(self.names) == len(planes) else [np.concatenate(planes, axis=1)]
        named = {name: x.astype(self.kind) for name, x in zip(self.names, feed, strict=True)}
        try:
            outputs = self.session.run(None, named)
        except Exception as error:  # onnxruntime raises many types
            reason = _first_line(error)
            raise DataError("network failed", where=self.source, found=reason) from error
        fitting = [o for o in outputs if fits(o)]
        if not fitting:
            name, _, shape = kind.partition(" ")
            what, shapes = f"network gives no {name}", [np.shape(o) for o in outputs]
            raise DataError(what, where=self.source, found=shapes, expected=f"an output {shape}")
        return fitting, (rows, cols)

    def flow(self, first: Image, second: Image) -> FloatMap:
        """(H, W, 2) flow, in pixels of the images (H, W, 3)."""
        height, width = first.shape[:2]
        flows, (rows, cols) = self.outputs(
            lambda o: np.ndim(o) == 4 and o.shape[:2] == (1, 2), "flow (1, 2, h, w)", first, second
        )
        best = max(reversed(flows), key=lambda o: o.shape[2] * o.shape[3])
        flow = np.moveaxis(best[0].astype(np.float32), 0, 2)
        # displacements are in pixels of the images that the network saw
        target = (width, height) if self.size else (cols, rows)
        scale = np.array([target[0] / cols, target[1] / rows], np.float32)
        flow = cv2.resize(flow, target, interpolation=cv2.INTER_LINEAR)
        return np.ascontiguousarray(flow[:height, :width] * scale, dtype=np.float32)


def learned_flow(source: str, image_ref: Image, image_next: Image) -> Flow:
    """Flow of a network in both directions, with forward-backward confidence.

    Of the outputs of the .onnx file for two images (H, W, 3) of one size the largest flow
    (1, 2, h, w) in pixels is used, and the last one of equal size.
    """
    if image_ref.shape != image_next.shape:
        shapes = f"{image_ref.shape} and {image_next.shape}"
        raise DataError("a network needs two RGB images of one size", found=shapes)
    network = Network(source, 2)
    forward = network.flow(image_ref, image_next)
    backward = network.flow(image_next, image_ref)
    confidence = confidence_of(round_trip_error(forward, backward))
    forward[~np.isfinite(forward).all(axis=2)] = 0.0
    return Flow(forward, confidence, Path(source).name)


def learned_map(source: str, image: Image) -> FloatMap:
    """(h, w) depth or inverse depth of an image (H, W, 3), NaN where it is not positive.

    It is the last output (1, h, w) or (1, 1, h, w) of the network in an .onnx file.
    """
    network = Network(source, 1)
    maps, (rows, cols) = network.outputs(
        lambda o: np.ndim(o) in (3, 4) and np.squeeze(o).ndim == 2, "map (1, 1, h, w)", image
    )
    last = np.squeeze(maps[-1]).astype(np.float32)
    resized = cv2.resize(last, (cols, rows), interpolation=cv2.INTER_LINEAR)
    # cut off the padding to a multiple of 8
    whole = resized if network.size else resized[: image.shape[0], : image.shape[1]]
    return np.where(np.isfinite(whole) & (whole > 0), whole, np.nan).astype(np.float32)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
