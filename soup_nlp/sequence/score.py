"""Errors of a chain: depth with one scale for all or one for each frame, and the camera path."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.errors import DataError
from soup_nlp.evaluate.metrics import MEDIAN, UNSCALED, depth_metrics
from soup_nlp.report.chain import Chain
from soup_nlp.report.findings import certainty_lines, guess_line
from soup_nlp.report.page import Markup, headline, page, paths, preformatted, table
from soup_nlp.report.verdict import sectioned
from soup_nlp.sequence.links import MAX_GUESSED

WIDTHS = {"ratio of scales": 16, "spread (log)": 13, "true ratio": 11, "pixels": 9, "": 8}
"""Columns of `link_table` after the first one, and their characters in the terminal."""


def score(chain: Chain, truths: Sequence[Float] | None = None) -> dict[str, Any] | None:
    """Errors of depth and path; None without a truth.

    `truths` (H, W) of every frame stand for those of the pairs.

    "frames" has the MRE of every frame with its own median scale and with one for the sequence,
    "links" the estimated and the true ratio of scales, and "path" the error of the camera positions
    after the best similarity relative to the length of the true path, if it is known.
    """
    if truths is not None and len(truths) != len(chain):
        raise DataError("truth and chain differ in length", found=len(truths), expected=len(chain))
    known = [pair.tree["truth"] for pair in chain.pairs]
    stored = [*(truth.get("depth_ref") for truth in known), known[-1].get("depth_next")]
    given = enumerate(stored if truths is None else truths)
    true = {k: z for k, z in given if z is not None and MEDIAN.counts(z)}
    if not true:
        return None
    depths = {k: chain.depth(k) for k in true}
    separate = {k: depth_metrics(z, true[k]) for k, z in depths.items()}
    compared = {k: MEDIAN.mask(true[k]) & (z > 0) for k, z in depths.items()}
    ratios = [true[k][mask] / depths[k][mask] for k, mask in compared.items()]
    scale = float(np.median(np.concatenate(ratios)))
    frames = [
        {
            "frame": k,
            "mre_own_scale": own.mre,
            "mre_one_scale": depth_metrics(scale * depths[k], true[k], UNSCALED).mre,
            "own_scale": own.scale,
            "coverage": own.coverage,
        }
        for k, own in separate.items()
    ]
    averaged = "mre_own_scale", "mre_one_scale"
    mre = {key: float(np.mean([f[key] for f in frames])) for key in averaged}
    own_scale = {k: own.scale for k, own in separate.items()}
    # the true ratio is that of the pairs' own depths, without the scales of the chain
    ratio = chain.scales[1:] / chain.scales[:-1]
    links = [
        {"pairs": [k, k + 1], "estimated": r, "true": r * own_scale[k + 1] / own_scale[k]}
        for k, r in enumerate(ratio)
        if own_scale.keys() >= {k, k + 1}
    ]
    return {
        "scale": scale,
        "frames": frames,
        **mre,
        "cost": mre["mre_one_scale"] / mre["mre_own_scale"] - 1,
        "links": links,
        "path": path_error(chain),
    }


def link_table(contents: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """The links of a chain.json as heads and rows; without the true ratio if none is known."""
    true = {tuple(k["pairs"]): k["true"] for k in (contents["score"] or {}).get("links", ())}
    heads, rows = ["pairs", *WIDTHS], []
    for k in contents["links"]:
        a, b = k["pairs"]
        true_ratio = f"{true[a, b]:.3f}" if (a, b) in true else ""
        note = "bridge" if k["bridge"] else "a guess" if k["flagged"] else ""
        numbers = [f"{k['ratio']:.3f}", f"{k['spread']:.3f}", true_ratio, str(k["pixels"])]
        rows.append([f"{a}, {b}", *numbers, note])
    column = heads.index("true ratio")
    if not any(row[column] for row in rows):
        for row in (heads, *rows):
            del row[column]
    return heads, rows


def score_text(scores: Mapping[str, Any]) -> str:
    """The scores of a sequence in one sentence."""
    text = (
        f"MRE {scores['mre_own_scale']:.4f} with a scale for every frame,"
        f" {scores['mre_one_scale']:.4f} with one for the sequence ({scores['cost']:+.1%})"
    )
    if path := scores["path"]:
        text += f"; camera path off by {path['share']:.2%} of its length after a similarity"
    return text


def chain_lines(chain: Chain) -> list[str]:
    """Scales, links and, with a truth, errors of a chain for the terminal."""
    lines, contents = [str(chain)], chain.summary
    heads, rows = link_table(contents)
    # two frames are one pair, which has no link
    for pairs, *cells in (heads, *rows) if rows else ():
        padded = [f"{cell:>{WIDTHS[head]}}" for head, cell in zip(heads[1:], cells, strict=True)]
        lines.append(f"{pairs:<10}{''.join(padded)}".rstrip())
    long = [track for track in contents["tracks"] if len(track["path"]) > 2]
    lines.append(f"tracks      {len(long)} components followed over two pairs or more")
    lines.append(sectioned({"certainty": certainty_lines(certainty(chain))}))
    if contents["score"]:
        lines.append(f"accuracy    {score_text(contents['score'])}")
    return lines


def certainty(chain: Chain) -> dict[str, float]:
    """Means over the pairs of a chain of the shares in `report.summary.certainty`."""
    rows = [pair.summary["certainty"] for pair in chain.pairs]
    known = {k: [row[k] for row in rows if row.get(k) is not None] for k in rows[0]}
    return {k: float(np.mean(values)) if values else np.nan for k, values in known.items()}


def chain_exit_code(chain: Chain) -> tuple[int, str]:
    """Exit code of `soup-nlp chain`, and its reason."""
    shares = certainty(chain)
    if shares["guess"] > MAX_GUESSED:
        return 1, guess_line(shares, "all images")
    return 0, "solved, and at most half of all images is a guess"


def score_lines(scores: Mapping[str, Any] | None) -> list[str]:
    """Scores by frame as lines of text."""
    if scores is None:
        return ["the truth knows no pixel of any frame"]
    rows = [
        f"{f['frame']:>5}{f['mre_own_scale']:>12.4f}{f['mre_one_scale']:>12.4f}"
        f"{f['coverage']:>10.1%}"
        for f in scores["frames"]
    ]
    head = f"{'frame':>5}{'own scale':>12}{'one scale':>12}{'coverage':>10}"
    return ["MRE of the depth, median scales, no depth cap", head, *rows, score_text(scores)]


def path_error(chain: Chain) -> dict[str, float] | None:
    """Error of the camera positions after a similarity; None if the true path is unknown."""
    pose, positions = np.eye(4), [np.zeros(3)]
    for pair in chain.pairs:
        # component 0 of a truth is the static scene
        motions = pair.tree["truth"].get("motions")
        if motions is None or not np.isfinite(motions[0]).all():
            return None
        pose = pose @ np.linalg.inv(motions[0])
        positions.append(pose[:3, 3])
    true = np.array(positions)
    length = float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    if length == 0 or len(true) < 3:
        return None
    error = true - aligned(np.array([m.t for m in chain.world_from_camera]), true)
    rmse = float(np.sqrt((error**2).sum(axis=1).mean()))
    return {"rmse": rmse, "length": length, "share": rmse / length}


def aligned(points: Float, target: Float) -> Float:
    """Points (M, 3) after the least-squares similarity to `target` (M, 3) (Umeyama, 1991)."""
    a, b = points - points.mean(axis=0), target - target.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    size = (a**2).sum()
    scale = float((S * sign).sum() / size) if size > 0 else 1.0
    return scale * a @ (U * sign @ Vt).T + target.mean(axis=0)


def chain_page(chain: Chain) -> str:
    """The page of a chain."""
    rows = [
        [
            Markup(f'<i style="background:{escape(colour)}"></i>{escape(name)}'),
            f"{first} to {first + len(points) - 1}",
            f"{length:.3g}",
        ]
        for name, colour, first, points in paths(chain)
        for length in [float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())]
    ]
    heads, links = link_table(chain.summary)
    scores = chain.summary["score"]
    words = [f"{len(chain)} frames", score_text(scores) if scores else f"in {chain.unit}"]
    parts = {
        "summary": headline(guess_line(certainty(chain), "all images"), words),
        "Paths": table(["path", "frames", f"length, {chain.length}"], rows)
        + "<p>What moves by itself has a scale of its own in every pair: its path is as good as its"
        " depth.</p>",
        "Links between pairs": table(heads, links) if links else "",
        "Verdict": preformatted(chain_lines(chain)),
    }
    return page(chain, parts)
