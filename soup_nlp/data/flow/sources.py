"""Sources of the flow of a pair: DIS and other methods, a file, the truth, or a plug-in.

A plug-in is a function of two images that returns a `Flow`, or what makes one. An installed package
registers it as an entry point of the group `soup_nlp.flow`, whose name is that of the source.
"""

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import cv2
import numpy as np

from soup_nlp.data.flow.consistency import check_flow, confidence_of, round_trip_error
from soup_nlp.data.flow.dis import dis_flow
from soup_nlp.data.formats.map_files import read_confidence, read_flow
from soup_nlp.data.network import learned_flow
from soup_nlp.data.pair import Flow, Pair, check_size
from soup_nlp.data.working_size import at_common_focal, resized_flow
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.schema.section import Section
from soup_nlp.storage.files import PathLike, is_file

METHODS = ("dis", "truth")
"""Flow methods of this package."""

NOISE, CORRELATION = "truth+noise:", 5.0
"""Prefix of the source "true flow with noise", followed by the standard deviation in pixels, and
that of the Gaussian that blurs the noise, pixels."""
BLACK = 24
"""Largest grey level of a black bar: black of limited range is 16, and its coding has errors."""


def load_flow(path: PathLike) -> Flow:
    """The Flow of a file (.flo, KITTI .png, .npy), confidence 1 where known; some must be known."""
    flow = Flow(read_flow(path).astype(np.float32), source=Path(path).name)
    if not flow.confidence.any():
        raise DataError("flow file marks every pixel as unknown", where=path)
    return flow


def flow_from_truth(pair: Pair, source: str = "truth") -> Flow:
    """The true flow of a pair, with confidence 0 where it is unknown; DataError without one.

    The source is "truth", or with Gaussian noise such as "truth+noise:0.5", the standard deviation
    of either component in pixels. The noise is correlated over a few pixels, like errors of real
    flows: white noise would average out within a superpixel. Every call adds the same noise.
    """
    if pair.truth is None or pair.truth.flow is None:
        raise DataError(
            "pair has no true flow",
            where=pair.name,
            found=pair.truth or "no truth",
            hint="use the flow source 'dis' or give a flow file",
        )
    flow = Flow(pair.truth.flow.astype(np.float32), source="truth")
    if source == "truth":
        return flow
    try:
        sigma = float(source.removeprefix(NOISE))
    except ValueError:
        sigma = np.nan
    if not 0 <= sigma < 1000:
        what = "noise of the flow is not a number of pixels"
        raise DataError(what, found=source, expected=f"{NOISE}0.5")
    (height, width), pad = flow.confidence.shape, int(4 * CORRELATION)
    shape = (height + 2 * pad, width + 2 * pad, 2)
    noise = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    blurred = cv2.GaussianBlur(noise, (0, 0), CORRELATION)
    noise = np.asarray(blurred[pad : pad + height, pad : pad + width], np.float32)
    # normalise: the deviation of blurred noise differs from its expectation in a small image
    noise = noise * np.float32(sigma / max(float(noise.std()), 1e-12))
    uv = np.where(flow.confidence[:, :, None] > 0, flow.uv + noise, flow.uv)
    return Flow(uv.astype(np.float32), flow.confidence, f"truth+noise:{sigma:g}")


class FlowOptions(Section):
    """Where the flow comes from."""

    source: str = "dis"
    """dis, truth, a file (.flo, KITTI .png, .npy), or the name of a plug-in."""
    backward: str | None = None
    """File of the flow from the next to the reference image, beside a `source` that is a file: its
    round trip becomes the confidence, which is 1 everywhere without it."""
    confidence: str | None = None
    """File of the confidence of a `source` that is a file: .npy in [0, 1], or a grey picture,
    black for unusable."""
    consistency: bool = True
    """Weight a vector of DIS, or of a file with a backward flow, by how well its round trip closes;
    if false, all vectors that stay in the image have the same weight, as in the paper, and no flow
    is searched for behind a layer that stands still, such as a reflection in a windscreen."""

    def load(self, pair: Pair, path: Callable[[str], Path]) -> Flow:
        """The flow of a pair, see `resolve_flow`; `path` resolves the name of a file."""
        source = str(path(self.source)) if is_path(self.source) else self.source
        if self.backward or self.confidence:
            return self._with_confidence(pair, source, path)
        given = self.is_file() or source.startswith("truth")
        near = pair if given else at_common_focal(pair)
        flow = resolve_flow(near, source, self.consistency)
        return flow if near is pair else resized_flow(flow, near, pair)

    def _with_confidence(self, pair: Pair, source: str, path: Callable[[str], Path]) -> Flow:
        """The flow of a file, its confidence from a backward flow and a map."""
        if not self.is_file():
            raise ConfigError(
                "a backward flow or a confidence goes with the file of a flow only",
                where="flow.source",
                found=self.source,
                expected="a .flo, KITTI .png or .npy file",
                hint="every other source has a confidence of its own",
            )
        flow = resolve_flow(pair, source)
        confidence = flow.confidence.copy()
        if self.backward:
            back, size = load_flow(path(self.backward)), pair.image_next.shape
            check_size("backward flow and next image", back.uv.shape, size, self.backward)
            check_flow(back, pair, backward=True)
            known = back.confidence[..., None] > 0
            gap = round_trip_error(flow.uv, np.where(known, back.uv, np.nan))
            confidence *= confidence_of(gap) if self.consistency else np.isfinite(gap)
        if self.confidence:
            sure = read_confidence(path(self.confidence))
            confidence *= Flow(flow.uv, sure, self.confidence).confidence
        if not confidence.any():
            raise DataError(
                "the flow has confidence 0 everywhere",
                where=self.backward or self.confidence,
                expected="a backward flow that leads back, or a map that is not black",
                hint="the backward flow is from the next image to the reference image, in pixels",
            )
        return Flow(flow.uv, confidence, flow.source)

    def is_file(self) -> bool:
        """Whether the source is the file of a flow."""
        return is_path(self.source) and not is_network(self.source)

    def files(self) -> list[str]:
        """Names that may be files, including a source that is a method such as "dis"."""
        return [name for name in (self.source, self.backward, self.confidence) if name]


def flow_sources() -> dict[str, EntryPoint]:
    """Flow methods of installed plug-ins by name."""
    return {point.name: point for point in entry_points(group="soup_nlp.flow")}


def is_named(source: str) -> bool:
    """Whether a flow source is a name rather than the path of a file."""
    return source in METHODS or source.startswith(NOISE) or source in flow_sources()


def is_path(source: str) -> bool:
    """Whether a flow source is a path: not a known name, and with a suffix or a folder."""
    return not is_named(source) and bool(Path(source).suffix or "/" in source)


def is_network(source: str) -> bool:
    """Whether a flow source is the path of a network."""
    return Path(source).suffix == ".onnx"


def resolve_flow(pair: Pair, source: str, consistency: bool = True) -> Flow:
    """The flow of a pair from a named source; DataError if it is unknown, fails, or does not fit.

    The source is "dis", "truth", "truth+noise:SIGMA" (`flow_from_truth`), the name of a plug-in, or
    the path of a network (.onnx) or of a flow file. For `consistency` see `dis_flow`.
    """
    if source == "dis":
        return _without_bars(dis_flow(pair.image_ref, pair.image_next, consistency), pair)
    if source == "truth" or source.startswith(NOISE):
        return flow_from_truth(pair, source)
    if is_network(source):
        return _without_bars(learned_flow(source, pair.image_ref, pair.image_next), pair)
    plugins = flow_sources()
    if source in plugins:
        return _run_plugin(plugins[source], pair)
    if not Path(source).suffix and not is_file(source):
        names = [*METHODS, f"{NOISE}SIGMA", *sorted(plugins)]
        raise DataError(
            "unknown flow source",
            found=repr(source),
            expected=f"{', '.join(names)}, or the path of a flow file or network",
        )
    flow = load_flow(source)
    pair.with_flow(flow)  # checks its size
    check_flow(flow, pair)
    return flow


def _without_bars(flow: Flow, pair: Pair) -> Flow:
    """A flow with confidence 0 in rows and columns that are black in both frames."""
    if pair.image_ref.shape != pair.image_next.shape:
        return flow
    light = np.maximum(pair.image_ref, pair.image_next).max(axis=2) > BLACK
    inside = light.any(axis=1)[:, None] & light.any(axis=0)
    return Flow(flow.uv, flow.confidence * inside, flow.source)


def _run_plugin(point: EntryPoint, pair: Pair) -> Flow:
    try:
        found = point.load()(pair.image_ref, pair.image_next)
    except DataError:
        raise
    except Exception as error:
        raise DataError(
            "flow plug-in failed",
            where=f"flow plug-in {point.name!r} ({point.value})",
            found=f"{type(error).__name__}: {error}",
        ) from error
    flow = found if isinstance(found, Flow) else Flow(found, source=point.name)
    pair.with_flow(flow)  # checks its size
    return flow
