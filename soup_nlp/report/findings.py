"""What a run found, how sure that is, what limits it and what to try, in words."""

from collections.abc import Mapping

import numpy as np

from soup_nlp.arrays import Float, Mask
from soup_nlp.data.formats.cameras import written
from soup_nlp.data.working_size import scaled_camera
from soup_nlp.evaluation.confidence import MOST_SIGMA
from soup_nlp.pipeline.record import Run
from soup_nlp.start.camera_error import better_camera
from soup_nlp.start.regions import FIXED, SCENE
from soup_nlp.start.views import LEAST_PARALLAX_PX

SAID = {
    "measured": "measured by parallax",
    "inferred": "inferred from contact, order, bending, a continued surface or a given depth",
    "drawn": "drawn: nothing tells its depth",
}
"""Words for the kinds of depth (`evaluation.confidence.KINDS`)."""
ORIGIN_WORDS = {
    "reference": "the largest, which defines the scale",
    "contact below": "its scale from what it stands on",
    "outline": "its scale from what is around it",
    "nothing": "its scale unknown: nothing that has a scale touches it",
    "ground": "lifted to the ground",
    "fixed in the image": "still in the image though the camera moves",
    "given depth": "its scale from the given depth",
    "occlusion": "placed in front of what it covers",
    "too fast": "nearer than its contact, at which it would move too far",
}
"""Words for what gives a component its scale (`regions.ORIGINS`)."""
USABLE, MATCHED = 0.8, 0.2
"""Shares of usable flow below which it counts as a limit, and below which the frames may show two
scenes, if most depth is drawn."""
LEAST, SHARE = 0.005, 0.05
"""Shares of the image from which a kind of depth is named, and a limit mentioned."""
FAST = 0.05
"""Median length of the flow, relative to the image's width, above which motion is fast."""
UNSURE_FOCAL = 0.2
"""Standard deviation of the log focal length above which it is called a guess."""
SAME_PX = 0.1
"""Median length of the flow, pixels, below which the frames count as the same."""
LISTED = 5
"""Number of moving components that are listed."""
WAYS = (("to the right", "to the left"), ("down", "up"), ("ahead", "back"))
"""Directions of the axes of a camera."""


def certainty_lines(shares: Mapping[str, float], of: str = "the image") -> list[str]:
    """A sentence for every kind of depth that is worth a mention; `shares` by `certainty`."""
    lines = []
    for kind, words in SAID.items():
        if shares[kind] >= LEAST:
            lines.append(f"{shares[kind]:.0%} of {of} is {words}")
            # null in a stored result where nothing is measured
            if kind == "measured":
                lines[-1] += f", half of it to {shares['median_sigma']:.1%} (1 sigma)"
    return lines


def drawn_line(shares: Mapping[str, float], of: str = "the image") -> str:
    """The sentence on what is drawn; "" for next to none."""
    return "".join(certainty_lines({**shares, "measured": 0.0, "inferred": 0.0}, of))


def found_words(run: Run) -> list[str]:
    """Motion of the camera and of the large components, bending, size, depth prior."""
    start, parts, labels = run.start, run.components, run.segmentation.labels
    turn = f"by {parts.camera.angle:.2f} degrees"
    if unmatched(run):
        turn += " (hardly any flow is usable)"

    if start.at_rest:
        lines = [f"the camera stands still or only turns, {turn}"]
    elif start.bends.all():
        lines = ["surfaces bend: their relief is weakly determined"]
    else:
        lines = [f"the camera moves {_shift(run, 0, parts.camera.centre)} and turns {turn}"]
        if start.bending:
            share = float(start.bends[labels].mean())
            lines.append(f"{share:.0%} of the image bends: its relief is weakly determined")
    shares = {part.label: part.pixels / labels.size for part in parts.members[1:]}
    large = [label for label, share in shares.items() if share >= SHARE / 5][:LISTED]
    for label in large:
        centre = parts[label].centre
        moved = _shift(run, label, parts.own_motion(label)(centre) - centre)
        lines.append(f"{shares[label]:.0%} of the image moves by itself, {moved}")
    rest = [share for label, share in shares.items() if label not in large]
    if rest:
        size = "below 1%" if max(rest) < SHARE / 5 else f"at most {max(rest):.0%}"
        kind = "more components" if large else "components that move by themselves"
        lines.append(f"{kind}: {len(rest)} ({size} of the image{' each' * (len(rest) > 1)})")
    camera = run.confidence.evidence.camera
    if camera is not None and shares:
        lines.append(f"the flow suggests an error of {camera}, which may look like such motion")
    if run.pair.focal_sigma > 0:
        focal, error = run.pair.K_ref[0, 0], run.pair.focal_sigma
        by = "by the flow" if error <= UNSURE_FOCAL else "a guess"
        lines.append(f"the focal length is {focal:.0f} px, right to {error:.0%} ({by})")
    if run.given is not None:
        lines.append(str(run.given.evidence))
    if run.full is not None:
        (height, width), (h, w) = run.full.depth_ref.shape, run.pair.size
        scored = "" if run.full.metrics is None else f": MRE {run.full.metrics.mre:.4f}"
        lines.append(f"solved at {w}x{h}, brought to {width}x{height}{scored}")
    return lines


def unmatched(run: Run) -> bool:
    """True if hardly any flow is usable, so that neither motion nor its causes can be told."""
    assert run.pair.flow is not None
    return run.pair.flow.usable < MATCHED and run.confidence.share("drawn") > 0.5


def _shift(run: Run, label: int, shift: Float) -> str:
    """Length, in the unit of the truth or relative to the median depth, main direction and
    certainty of a component's displacement (3,)."""
    axis = int(np.argmax(np.abs(shift)))
    length, score = float(np.linalg.norm(shift)), run.metrics.get("solution")
    share = length / float(np.nanmedian(run.reconstruction.depth_ref))
    size = f"{share:.1%} of the median depth"
    if score is not None and np.isfinite(score.scale) and run.pair.truth is not None:
        size = f"{score.scale * length:.3g} {run.pair.truth.unit}"
    sigma = float(np.median(run.confidence.sigma[run.components.of_pixel == label]))
    sure = f" (right to {sigma:.0%}, as its distance is)" if sigma > MOST_SIGMA else ""
    return f"by {size} {WAYS[axis][int(shift[axis] < 0)]}{sure}"


def hints(run: Run) -> list[str]:
    """What would give a better depth."""
    assert run.pair.flow is not None
    uv, usable, out = run.pair.flow.uv, run.pair.flow.confidence > 0, list[str]()
    start, sure, labels = run.start, run.confidence, run.segmentation.labels
    camera, drawn = sure.evidence.camera, sure.share("drawn")
    length = float(np.median(np.linalg.norm(uv, axis=-1)[usable])) if usable.any() else 0.0
    unsure = sure.sigma > MOST_SIGMA

    def share(part: Mask) -> float:
        # of the image that is unsure, and of a part (N,) of the superpixels
        return float(np.mean(unsure & part[labels]))

    if unmatched(run):
        # what the little flow suggests (no parallax, a wrong camera) is no cause
        return ["two frames of the same scene, closer in time: hardly anything is in both"]
    if share(start.origin == FIXED) >= LEAST:
        out.append(
            "frames without what stands still in the image while the camera moves (a watermark, a"
            " logo, the bonnet of its car)"
        )
    if usable.mean() < USABLE:
        fast = length > FAST * uv.shape[1]
        out.append("frames closer in time" if fast else "a better flow (--flow)")
    elif length < SAME_PX and drawn > 0.5:
        out.append("frames farther apart in time: these two are nearly the same")
    flat = share(start.parallax < LEAST_PARALLAX_PX)
    if flat > 0.5 or start.at_rest:
        out.append("frames between which the camera moves aside, not only turns or zooms")
    elif flat >= SHARE:
        out.append("frames farther apart in time")
    if camera is not None:
        said = f"undistorted images and exact intrinsics: the flow suggests an error of {camera}"
        # for the images as they were given
        size = run.pair.size if run.full is None else run.full.depth_ref.shape
        K = scaled_camera(run.pair.K_ref, run.pair.size, size)
        fits = better_camera(K, camera, sure.evidence.errors[camera].mean)
        out.append(said if fits is None else f"{said}, and --intrinsics {written(fits)} would fit")
    if run.pair.focal_sigma > UNSURE_FOCAL and unsure.mean() >= SHARE:
        out.append("the focal length of the camera (--fov or --intrinsics)")
    if share((start.component != SCENE) | start.unexplained) >= SHARE:
        out.append("a depth from elsewhere (--depth-prior) for what moves")
    return ["; ".join(out)] if out else []
