"""Verdict on a chain; its errors: depth with one scale for all or each frame, camera path."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from soup_nlp.arrays import Float
from soup_nlp.errors import DataError
from soup_nlp.evaluation.metrics import MEDIAN, UNSCALED, Convention, depth_metrics
from soup_nlp.geometry.rotation import log
from soup_nlp.report.chain import Chain
from soup_nlp.report.findings import certainty_lines, drawn_line
from soup_nlp.report.verdict import sectioned
from soup_nlp.sequence.links import MOST_DRAWN
from soup_nlp.storage.files import read_text

AVERAGED = ("mre_own_scale", "mre_one_scale", "mre_affine", "rmse", "delta1")
"""Scores of frames of which a chain has the mean."""
SAMPLES = 4_000_000
"""Number of pixels of a chain from which its scale is found."""


def score(
    chain: Chain, truths: Sequence[Float] | None = None, poses: Float | None = None
) -> dict[str, Any] | None:
    """Errors of depth and path; None without a truth.

    `truths` are the true depths (H, W) of all frames, None for those of the pairs, and `poses`
    (K + 1, 4, 4) the true world_from_camera, None for the motions of the pairs' truth.

    Returns:
        "frames": MRE of every frame with its own median scale ("own_scale"), with one for all
        ("scale") and with a scale and a shift of its own; RMSE and delta < 1.25 with one scale. The
        same without "frames" as means over the frames, and the "cost" of one scale. "path": see
        `path_errors`; None if it is not known.
    """
    if truths is not None and len(truths) != len(chain):
        raise DataError("truth and chain differ in length", found=len(truths), expected=len(chain))

    def truth(k: int) -> Float | None:
        # the last frame is the next one of the last pair
        last = int(k == len(chain.pairs))
        known = chain.pairs[k - last].tree["truth"].get(("depth_ref", "depth_next")[last])
        z = known if truths is None else truths[k]
        return z if z is not None and MEDIAN.counts(z) else None

    if truths is None and not chain.pairs[0].tree["truth"]:
        return None
    scored, ratios, frames = list[int](), list[Float](), []
    for k, frame in enumerate(chain):
        if (true := truth(k)) is not None:
            z, step = frame.depth, max(1, -(-frame.depth.size * len(chain) // SAMPLES))
            compared = MEDIAN.mask(true) & (z > 0)
            # of a long chain, the median over some pixels of every frame
            ratios.append((true[compared] / z[compared])[::step])
            scored.append(k)
    if not scored:
        return None
    scale = float(np.median(np.concatenate(ratios)))
    for k in scored:
        z, true = chain.depth(k), truth(k)
        assert true is not None
        own, one = depth_metrics(z, true), depth_metrics(scale * z, true, UNSCALED)
        frames.append(
            {
                "frame": k,
                "mre_own_scale": own.mre,
                "mre_one_scale": one.mre,
                "mre_affine": depth_metrics(z, true, Convention("affine")).mre,
                "rmse": one.rmse,
                "delta1": one.delta1,
                "own_scale": own.scale,
                "coverage": own.coverage,
            }
        )
    means = {key: float(np.mean([f[key] for f in frames])) for key in AVERAGED}
    poses = true_poses(chain) if poses is None else poses
    return {
        "scale": scale,
        "frames": frames,
        **means,
        "cost": means["mre_one_scale"] / means["mre_own_scale"] - 1,
        "path": None if poses is None else path_errors(chain, poses),
    }


def score_text(scores: Mapping[str, Any]) -> str:
    """The scores of a sequence in one sentence."""
    text = (
        f"MRE {scores['mre_own_scale']:.4f} with a scale for every frame,"
        f" {scores['mre_one_scale']:.4f} with one for the sequence ({scores['cost']:+.1%})"
    )
    if path := scores["path"]:
        text += (
            f"; camera path off by {path['share']:.2%} of its length after a similarity (ATE"
            f" {path['ate']:.4g}, RPE {path['rpe']:.4g} and {path['rpe_degrees']:.3g} degrees)"
        )
    return text


def chain_lines(chain: Chain) -> list[str]:
    """Links, tracks, certainty and, with a truth, errors of a chain: its verdict."""
    lines = [str(chain)]
    if chain.links:
        lines.append("pairs    ratio of scales  spread (log)  pixels")
    for k in chain.links:
        note = "  bridge" if k.bridge else "  doubtful" if k.flagged else ""
        ends = f"{k.first}, {k.second}"
        ratio = np.exp(k.log_ratio)
        lines.append(f"{ends:<9}{ratio:<17.3f}{k.spread:<14.3f}{k.pixels}{note}")
    long = sum(len(path) > 2 for path in chain.paths.values())
    lines.append(f"tracks      {long} components followed over two pairs or more")
    lines.append(sectioned({"certainty": certainty_lines(chain.certainty, "all images")}))
    if scores := chain.summary.get("score"):
        lines.append(f"accuracy    {score_text(scores)}")
    return "\n".join(lines).splitlines()


def chain_exit_code(chain: Chain) -> tuple[int, str]:
    """Exit code of `soup-nlp chain`, and its reason."""
    shares = chain.certainty
    if shares["drawn"] > MOST_DRAWN:
        return 1, drawn_line(shares, "all images")
    return 0, "solved, and at most half of all images is drawn"


def score_lines(scores: Mapping[str, Any] | None) -> list[str]:
    """Scores by frame as lines of text."""
    if scores is None:
        return ["the truth knows no pixel of any frame"]
    heads = ("own scale", "one scale", "scale, shift", "RMSE", "d<1.25", "coverage")
    rows = [
        f"{f['frame']:>5}{f['mre_own_scale']:>13.4f}{f['mre_one_scale']:>13.4f}"
        f"{f['mre_affine']:>13.4f}{f['rmse']:>13.4g}{f['delta1']:>13.1%}{f['coverage']:>13.1%}"
        for f in scores["frames"]
    ]
    head = "frame" + "".join(f"{word:>13}" for word in heads)
    title = "MRE (Abs Rel) of the depth by its scale, no depth cap; RMSE and delta with one scale"
    return [title, head, *rows, score_text(scores)]


def true_poses(chain: Chain) -> Float | None:
    """(K + 1, 4, 4) world_from_camera by the truth of the pairs; None if it is not known."""
    poses = [np.eye(4)]
    for pair in chain.pairs:
        motions = pair.tree["truth"].get("motions")
        # component 0 of a truth is the static scene
        if motions is None or not np.isfinite(motions[0]).all():
            return None
        poses.append(poses[-1] @ np.linalg.inv(motions[0]))
    return np.array(poses)


def read_path(path: Path) -> Float:
    """(M, 4, 4) world_from_camera of a trajectory of TUM (8 numbers a line) or KITTI (12)."""
    try:
        rows = np.loadtxt(read_text(path, "trajectory").splitlines(), ndmin=2)
        out = np.tile(np.eye(4), (len(rows), 1, 1))
        if rows.shape[1] == 12:
            out[:, :3] = rows.reshape(-1, 3, 4)
        else:
            _, out[:, 0, 3], out[:, 1, 3], out[:, 2, 3], *turns = rows.T
            out[:, :3, :3] = Rotation.from_quat(np.stack(turns, axis=1)).as_matrix()
    except ValueError as error:
        expected = "lines of 8 (TUM) or 12 (KITTI) numbers"
        raise DataError("no trajectory", where=path, found=error, expected=expected) from None
    return out


def path_errors(chain: Chain, poses: Float) -> dict[str, float] | None:
    """Errors of the camera's path after the best similarity, as evo computes them.

    `poses` are the true world_from_camera (K + 1, 4, 4), one for each frame. "ate" is the root mean
    square of the distances of the cameras, "rpe" and "rpe_degrees" those of the shifts and turns by
    which motions from frame to frame differ, "length" that of the true path, and "share" is "ate"
    over it. None for fewer than three frames, or a path of no length.
    """
    if len(poses) != len(chain):
        raise DataError("path and chain differ in length", found=len(poses), expected=len(chain))
    true, found = poses[:, :3, 3], np.array([m.matrix for m in chain.world_from_camera])
    length = float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    if length == 0 or len(true) < 3:
        return None
    scale, turn, shift = similarity(found[:, :3, 3], true)
    found[:, :3, 3] = scale * found[:, :3, 3] @ turn.T + shift
    found[:, :3, :3] = turn @ found[:, :3, :3]
    steps = [np.linalg.inv(way[:-1]) @ way[1:] for way in (poses, found)]
    off = np.linalg.inv(steps[0]) @ steps[1]

    def rms(vectors: Float) -> float:
        return float(np.sqrt((vectors**2).sum(axis=1).mean()))

    ate, turns = rms(true - found[:, :3, 3]), np.degrees(log(off[:, :3, :3]))
    errors = {"ate": ate, "rpe": rms(off[:, :3, 3]), "rpe_degrees": rms(turns)}
    return {**errors, "length": length, "share": ate / length}


def similarity(points: Float, target: Float) -> tuple[float, Float, Float]:
    """Scale, rotation and shift of points (M, 3) to `target` by least squares (Umeyama, 1991)."""
    a, b = points - points.mean(axis=0), target - target.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    size = (a**2).sum()
    scale = float((S * sign).sum() / size) if size > 0 else 1.0
    R = U * sign @ Vt
    return scale, R, target.mean(axis=0) - scale * R @ points.mean(axis=0)
