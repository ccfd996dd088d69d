"""Where the flow of a pair comes from: DIS, a file, the truth, or a plug-in.

A plug-in is a function `(image_ref, image_next) -> Flow` that an installed package announces as an
entry point of the group `soup_nlp.flow`; the name of the entry point is the name of the source.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.flow.consistency import FloatMap, confidence_of
from soup_nlp.data.flow.dis_options import DisOptions
from soup_nlp.data.flow.guided import guided_flow
from soup_nlp.data.flow.learned import learned_flow
from soup_nlp.data.flow.rlof import rlof_flow
from soup_nlp.data.formats.images import PathLike
from soup_nlp.data.formats.map_files import read_flow
from soup_nlp.data.pair import Flow, Pair, check_size
from soup_nlp.errors import DataError
from soup_nlp.schema.section import Positive, Section, Share

Image = NDArray[np.uint8]
FlowSource = Callable[[Image, Image], Flow]

ENTRY_POINTS = "soup_nlp.flow"
"""Entry-point group in which other packages announce flow methods."""

NOISE = "truth+noise:"
"""Name of the true flow with noise, followed by the standard deviation in pixels."""

MIN_SIDE = 16
"""Smallest image side for DIS, pixels."""

_FLAT = 1.0  # standard deviation, grey levels, below which an image holds nothing to match
_WORK_SIDE = 64  # DIS gets images of at least this side; smaller ones are padded


def dis_flow(image_ref: Image, image_next: Image, **options: Any) -> Flow:
    """Dense inverse search flow (Kroeger et al., ECCV 2016) with forward-backward confidence.

    The flow is computed in both directions, and once more after each of the dominant homographies
    (`planes`) has aligned the images; the better one is taken pixel by pixel (`guided_flow`): near
    a driving camera displacements are too large for the coarse-to-fine search alone.

    Its confidence is that of its round-trip error (`confidence_of`). A wrong flow that both
    directions agree on, as on weak texture, keeps its confidence. An image without contrast
    (standard deviation under one grey level) gives a zero flow with confidence 0 everywhere.

    Args:
        image_ref: (H, W, 3) or (H, W) uint8 reference image.
        image_next: (H', W', 3) or (H', W') uint8 next image; it may differ in size.
        **options: Of `DisOptions`.

    Returns:
        Flow of source "dis", size of the reference image.

    Raises:
        ConfigError: an option is unknown or out of range.
        DataError: an image is not uint8 or too small.
    """
    o = DisOptions.make(options)
    ref, nxt = _grey(image_ref, "image_ref"), _grey(image_next, "image_next")
    height, width = ref.shape
    if min(float(ref.std()), float(nxt.std())) < _FLAT:
        zero = np.zeros((height, width), np.float32)
        return Flow(np.zeros((height, width, 2), np.float32), zero, "dis")
    if o.equalize:
        clahe = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8))
        ref, nxt = clahe.apply(ref), clahe.apply(nxt)
    dis = cv2.DISOpticalFlow.create(getattr(cv2, f"DISOPTICAL_FLOW_PRESET_{o.preset.upper()}"))
    dis.setFinestScale(o.finest_scale)
    dis.setPatchSize(o.patch_size)
    dis.setPatchStride(o.patch_stride)
    dis.setVariationalRefinementIterations(o.refinement_iterations)
    dis.setVariationalRefinementAlpha(o.alpha)
    dis.setVariationalRefinementDelta(o.delta)
    dis.setVariationalRefinementGamma(o.gamma)
    side = max(_WORK_SIDE, 2 * o.patch_size << o.finest_scale)

    def match(first: Image, second: Image) -> tuple[FloatMap, FloatMap]:
        size = np.maximum(np.maximum(first.shape, second.shape), side)
        # the last row and column are repeated up to a common size
        a, b = (
            np.pad(image, [(0, n - m) for n, m in zip(size, image.shape, strict=True)], mode="edge")
            for image in (first, second)
        )
        (h1, w1), (h2, w2) = first.shape, second.shape
        return dis.calc(a, b, None)[:h1, :w1], dis.calc(b, a, None)[:h2, :w2]

    try:
        forward, backward = match(ref, nxt)
        uv, gap = guided_flow(ref, nxt, match, forward, backward, o.planes)
    except cv2.error as error:
        raise DataError(
            "DIS flow failed", where=f"images {width}x{height}", found=str(error).strip()
        ) from error
    return Flow(np.ascontiguousarray(uv), confidence_of(gap, o.tau, o.limit, o.support), "dis")


def _grey(image: Image, where: str) -> Image:
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)) or image.ndim < 2:
        raise DataError(
            "image must be 8-bit, grey or RGB",
            where=where,
            found=f"{image.dtype} {image.shape}",
            expected="uint8 (H, W) or (H, W, 3)",
        )
    if min(image.shape[:2]) < MIN_SIDE:
        raise DataError(
            "image is too small for DIS flow",
            where=where,
            found=f"{image.shape[1]}x{image.shape[0]}",
            expected=f"at least {MIN_SIDE} pixels on each side",
        )
    if image.ndim == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    return np.ascontiguousarray(image)


def flow_from_array(uv: NDArray[np.floating], source: str) -> Flow:
    """A Flow of an array in which NaN means unknown: confidence 1 where known, 0 elsewhere.

    Args:
        uv: (H, W, 2), pixels; not finite where unknown.
        source: Name for reports.
    """
    known = np.isfinite(uv).all(axis=2)
    filled = np.where(known[:, :, None], uv, 0.0).astype(np.float32)
    return Flow(filled, known.astype(np.float32), source)


def load_flow(path: PathLike) -> Flow:
    """A Flow of a file (.flo, KITTI .png, .npy): confidence 1 where the file knows it, else 0.

    Raises:
        DataError: the file is wrong (`read_flow`), or knows no pixel.
    """
    flow = flow_from_array(read_flow(path), Path(path).name)
    if not flow.confidence.any():
        raise DataError("flow file marks every pixel as unknown", where=path)
    return flow


def flow_from_truth(pair: Pair, occluded_confidence: float = 1.0) -> Flow:
    """The true flow of a pair as its Flow; confidence 0 where the truth is unknown.

    Args:
        pair: A pair whose truth has a flow.
        occluded_confidence: Confidence of pixels that `truth.occluded` marks, in [0, 1]. The true
            flow is known there too, so they are kept by default; 0 leaves them out, as any method
            that matches images must.

    Raises:
        DataError: the pair has no true flow.
    """
    if pair.truth is None or pair.truth.flow is None:
        raise DataError(
            "pair has no true flow",
            where=pair.name,
            found=pair.truth or "no truth",
            hint="use the flow source 'dis' or give a flow file",
        )
    flow = flow_from_array(pair.truth.flow, "truth")
    if pair.truth.occluded is not None:
        flow.confidence[pair.truth.occluded] *= np.float32(occluded_confidence)
    return flow


def add_noise(flow: Flow, sigma: float, correlation: float = 5.0) -> Flow:
    """A flow with Gaussian noise that is correlated over a few pixels, as errors of real flows are.

    White noise would average out within a superpixel. The noise is the same in every call.

    Args:
        flow: Any flow.
        sigma: Standard deviation of either component, pixels.
        correlation: Standard deviation of the Gaussian that blurs white noise, pixels; 0 for none.
    """
    height, width = flow.confidence.shape
    pad = int(np.ceil(4 * correlation))
    shape = (height + 2 * pad, width + 2 * pad, 2)
    noise = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    if correlation > 0:
        noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), correlation), np.float32)
    noise = noise[pad : pad + height, pad : pad + width]
    # in a small image the deviation of blurred noise differs from its expectation
    noise = noise * np.float32(sigma / max(float(noise.std()), 1e-12))
    uv = np.where(flow.confidence[:, :, None] > 0, flow.uv + noise, flow.uv)
    return Flow(uv.astype(np.float32), flow.confidence.copy(), f"{flow.source}+noise:{sigma:g}")


def _noise_level(source: str) -> float:
    """Standard deviation in pixels that a source such as "truth+noise:0.5" names."""
    try:
        sigma = float(source.removeprefix(NOISE))
    except ValueError:
        sigma = np.nan
    if not 0 <= sigma < 1000:
        raise DataError(
            "noise of the flow is not a number of pixels", found=source, expected=f"{NOISE}0.5"
        )
    return sigma


class FlowOptions(Section):
    """Where the flow comes from."""

    source: str = "dis"
    """dis, truth, a file (.flo, KITTI .png, .npy), or the name of a plug-in."""
    occluded_confidence: Share = 1.0
    """Confidence of occluded pixels when the source is truth."""
    reweight_px: Positive | None = None
    """Pixels that disagree with their superpixel's affine flow by more than about this count
    less; null for never."""
    dis: DisOptions = DisOptions()
    """Options of OpenCV's DIS flow and of its forward-backward check."""

    def load(self, pair: Pair, path: Callable[[str], Path]) -> Flow:
        """The flow of a pair.

        Args:
            pair: Images, and the truth where `source` is "truth".
            path: Resolves the name of a file.

        Raises:
            DataError: the source is unknown, or its flow is damaged or does not fit.
        """
        if self.source == "dis":
            return dis_flow(pair.image_ref, pair.image_next, **dict(self.dis))
        if self.source == "truth":
            return flow_from_truth(pair, self.occluded_confidence)
        return resolve_flow(pair, str(path(self.source)) if is_path(self.source) else self.source)


def flow_sources() -> dict[str, EntryPoint]:
    """Flow methods that installed packages announce, by name."""
    return {point.name: point for point in entry_points(group=ENTRY_POINTS)}


def is_named(source: str) -> bool:
    """Whether a flow source is a name rather than the path of a file."""
    return source in METHODS or source.startswith(NOISE) or source in flow_sources()


def is_path(source: str) -> bool:
    """Whether a flow source is a path: no known name, and with a suffix or a folder."""
    return not is_named(source) and bool(Path(source).suffix or "/" in source)


def is_network(source: str) -> bool:
    """Whether a flow source is the path of a network."""
    return Path(source).suffix in (".onnx", ".pth")


METHODS: dict[str, Callable[[Pair], Flow]] = {
    "dis": lambda pair: dis_flow(pair.image_ref, pair.image_next),
    "truth": flow_from_truth,
    "rlof": lambda pair: rlof_flow(pair.image_ref, pair.image_next),
    "raft_small": lambda pair: learned_flow("raft_small", pair.image_ref, pair.image_next),
    "raft_large": lambda pair: learned_flow("raft_large", pair.image_ref, pair.image_next),
}
"""Flow methods of this package by name; rlof needs opencv-contrib, raft needs torchvision."""


def resolve_flow(pair: Pair, source: str) -> Flow:
    """The flow of a pair from a named source.

    Args:
        pair: The pair; its own `flow` is not looked at.
        source: One of `METHODS`, with their defaults, "truth+noise:SIGMA" (`add_noise`), the name
            of an installed plug-in (entry-point group `soup_nlp.flow`), the path of a network
            (.onnx, or .pth for RAFT) or of a flow file.

    Raises:
        DataError: the source is unknown or fails, or its flow does not fit the pair.
    """
    if source in METHODS:
        return METHODS[source](pair)
    if source.startswith(NOISE):
        return add_noise(flow_from_truth(pair), _noise_level(source))
    if is_network(source):
        return learned_flow(source, pair.image_ref, pair.image_next)
    plugins = flow_sources()
    if source in plugins:
        return _run_plugin(plugins[source], pair)
    if not Path(source).suffix and not Path(source).exists():
        names = [*METHODS, f"{NOISE}SIGMA", *sorted(plugins)]
        raise DataError(
            "unknown flow source",
            found=repr(source),
            expected=f"{', '.join(names)}, or the path of a flow file or network",
        )
    flow = load_flow(source)
    pair.with_flow(flow)  # checks its size
    return flow


def _run_plugin(point: EntryPoint, pair: Pair) -> Flow:
    where = f"flow plug-in {point.name!r} ({point.value})"
    try:
        method: FlowSource = point.load()
        flow = method(pair.image_ref, pair.image_next)
    except DataError:
        raise
    except Exception as error:
        raise DataError(
            "flow plug-in failed", where=where, found=f"{type(error).__name__}: {error}"
        ) from error
    if not isinstance(flow, Flow):
        raise DataError(
            "flow plug-in returned no Flow",
            where=where,
            found=type(flow).__name__,
            expected="soup_nlp.data.pair.Flow",
        )
    check_size("flow and reference image", flow.uv.shape, pair.size, where)
    return flow
