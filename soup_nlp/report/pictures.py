"""The pictures of a result with titles, and legends with units; their overview."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import distance_transform_edt

from soup_nlp.arrays import AnyFloat, Image
from soup_nlp.report import figures
from soup_nlp.report.chain import Chain
from soup_nlp.report.figures import Legend, Picture
from soup_nlp.report.findings import LEAST

if TYPE_CHECKING:
    from soup_nlp.report.result import Result

DENSE = 0.5
"""If a smaller share of the pixels is known, as with laser points, each is drawn larger."""
ERROR_TICKS, SIGMA_TICKS = (0.0, 0.05, 0.1, 0.15, 0.2), (0.0, 0.1, 0.2, 0.3)
"""Values below the legends of error and sigma; the last one has the brightest colour."""


def pictures(chain: Chain, k: int = 0) -> dict[str, Picture]:
    """All pictures of a pair of a chain by name, in the order of the overview.

    "image_ref", "image_next", "superpixels", "components", "flow", "depth_ref", "depth_next",
    "depth_true", "error", "confidence", "normals" and "flow_confidence". Pictures of unknown
    quantities are left out. Colours mean the same in all pairs.
    """
    result = chain.pairs[k]
    before, after = result.images
    cells = figures.draw_superpixels(before, result.labels)
    flow, flow_confidence = _flow(result)
    drawn = {
        "image_ref": Picture("reference frame", before),
        "image_next": Picture("next frame", after),
        "superpixels": Picture(f"{len(result.bends)} superpixels", cells),
        "components": _components(chain, k),
        "flow": flow,
        **_depths(chain, k),
    }
    truth, z = result.true_depth, result.depths[0]
    if truth is not None and chain.metre is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.abs(truth - chain.metre * z) / truth
        error = np.where((truth > 0) & (z > 0), error, np.nan)
        title = "depth error relative to the truth; grey = no truth"
        drawn["error"] = _shares(title, _enlarged(error), "inferno", ERROR_TICKS)
    title = "expected depth error (1 sigma)"
    drawn["confidence"] = _shares(title, result.sigma, "viridis", SIGMA_TICKS)
    return {**drawn, "normals": _normals(result), "flow_confidence": flow_confidence}


def _components(chain: Chain, k: int) -> Picture:
    result, track = chain.pairs[k], chain.tracks[k]
    part, count = result.components.of_pixel, len(track)
    colours = figures.component_colours(max(track) + 1)[track]
    pixels = np.bincount(part.ravel(), minlength=count) / part.size
    texts = [f"{number}: {share:.1%}" for number, share in zip(track, pixels, strict=True)][:6]
    kind = "component" if result.bends.any() else "rigid component"
    word = f"one {kind}" if count == 1 else f"{count} {kind}s, share of the image"
    grey = result.images[0].astype(float).mean(axis=2, keepdims=True)
    shaded = (colours[part] * (0.6 + 0.4 * grey / 255)).astype(np.uint8)
    return Picture(word, shaded, Legend(colours[None, :6], tuple(texts)))


def _flow(result: Result) -> tuple[Picture, Picture]:
    sure = np.clip(result.flow_confidence, 0, 1).astype(float)
    used = np.where((sure > 0)[..., None], result.flow.astype(float), np.nan)
    limit = figures.flow_limit(used)
    title = f"flow to the next frame: white = 0 px, full colour = {limit:.3g} px, black = unusable"
    grey = np.repeat((255 * sure).round().astype(np.uint8)[:, :, None], 3, axis=2)
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    share = f"{np.mean(sure > 0):.0%} of the pixels usable"
    turns = np.linspace(0, 2 * np.pi, 128)
    hues = figures.colourise_flow(np.stack([np.cos(turns), np.sin(turns)], axis=1)[None], 1.0)
    ways = Legend(hues, ("right", "down", "left", "up", "right"))
    ends = Legend(ramp, ("0", "0.5", "1"))
    return (
        Picture(title, figures.colourise_flow(used, limit), ways),
        Picture(f"flow confidence; black = unusable ({share})", grey, ends),
    )


def _depths(chain: Chain, k: int) -> dict[str, Picture]:
    """Depths of both frames and of the truth, with one colour scale."""
    result, truth, (near, far) = chain.pairs[k], chain.pairs[k].true_depth, chain.depth_range
    scores, metre, out = result.summary.get("metrics", {}), chain.metre or 1.0, {}
    bar = figures.depth_legend(near, far, f" {chain.length}")
    seen = result.in_next(result.drawn, False)
    for name, frame, z, drawn, scored in (
        ("depth_ref", "reference", result.depths[0], result.drawn, "solution"),
        ("depth_next", "next", result.depths[1], seen, "solution_next"),
    ):
        mre, title = scores.get(scored, {}).get("mre"), f"depth of the {frame} frame"
        title += "" if mre is None else f", MRE {mre:.3f}"
        title += "; grey = unseen" * (frame == "next")
        if drawn.mean() >= LEAST:
            title += "; pale = drawn" + f" ({drawn.mean():.0%})" * (frame == "reference")
        out[name] = Picture(title, figures.colourise_depth(metre * z, near, far, drawn), bar)
    if truth is not None:
        true = figures.colourise_depth(_enlarged(np.where(truth > 0, truth, np.nan)), near, far)
        out["depth_true"] = Picture("true depth; grey = no truth", true, bar)
    return out


def _enlarged(values: AnyFloat) -> AnyFloat:
    """Numbers (H, W), NaN where unknown; sparse pixels are enlarged to a width of three."""
    known = np.isfinite(values)
    if known.mean() > DENSE or not known.any():
        return values
    distance, nearest = distance_transform_edt(~known, return_indices=True)
    return np.where(distance < 1.5, values[tuple(nearest)], np.nan)


def _shares(title: str, values: AnyFloat, colours: str, ticks: Sequence[float]) -> Picture:
    """Picture of shares (H, W) in a colour map of OpenCV that ends at the last tick."""
    limit, texts = ticks[-1], [f"{100 * x:.0f} %" for x in ticks]
    texts[-1] = f"\u2265 {texts[-1]}"
    ramp = figures.colourise_shares(np.linspace(0, limit, 128)[None], limit, colours)
    image = figures.colourise_shares(values, limit, colours)
    return Picture(title, image, Legend(ramp, tuple(texts)))


def _normals(result: Result) -> Picture:
    n = result.reconstruction.normals
    entries = {"camera": (0, 0, -1), "right": (1, 0, 0), "left": (-1, 0, 0),
               "up": (0, -1, 0), "down": (0, 1, 0)}  # fmt: skip
    row = figures.colourise_normals(np.array([list(entries.values())], float))
    return Picture("surface normals", figures.colourise_normals(n), Legend(row, tuple(entries)))


def overview(drawn: Mapping[str, Picture], title: str) -> Image:
    """The pictures of a result in whole rows of three columns; the last ones may be left out."""
    panels = [*drawn.values()]
    return figures.strip(panels[: len(panels) // 3 * 3], title)
