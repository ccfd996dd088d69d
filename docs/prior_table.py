"""Print rows of the tables of depth_prior.md and results/depth_prior.csv.

    PYTHONPATH=. python docs/prior_table.py DATA nlp [NAME...]

DATA is the folder of the real pairs. `nlp` has 300 superpixels, the NLP alone and all depth priors,
`refined` the defaults and the smooth warp of 20 %. Depth priors are made from the true depth. Every
cell has the MRE of the prior and that of the answer, then the share of its wrong pixels that have a
sigma below 10 %, those within 1 and 2 sigma, those above 25 %, and the CPU seconds.
"""

import sys
import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from gallery import warped
from scipy import ndimage
from scipy.interpolate import griddata

import soup_nlp
from soup_nlp.arrays import Float
from soup_nlp.data.pair import Pair
from soup_nlp.evaluation.metrics import depth_metrics
from soup_nlp.pipeline.case import prepare

FOLDER, INDOOR = {"kind": "folder"}, {"kind": "folder", "depth_scale": 5000.0}
ALLEY = {"kind": "sintel", "root": "sintel", "scene": "alley_1", "frame": 20, "step": 5}
PAIRS: dict[str, tuple[dict[str, Any], str]] = {
    "two_people_walking": (INDOOR | {"path": "rgbd/two_people_walking"}, "omd_occlusion_161"),
    "robot": (INDOOR | {"path": "rgbd/robot"}, "opening_door"),
    "opening_door": (INDOOR | {"path": "rgbd/opening_door"}, "two_people_walking"),
    "omd_occlusion_161": (FOLDER | {"path": "omd_occlusion_161"}, "two_people_walking"),
    "KITTI 2015 000002": (FOLDER | {"path": "kitti2015/pair_000002"}, "street"),
    "KITTI 2015 000007": (FOLDER | {"path": "kitti2015/pair_000007"}, "opening_door"),
    "kraw_jam_030": (FOLDER | {"path": "kraw_jam_030"}, "KITTI 2015 000002"),
    "alley_1": (ALLEY, "KITTI 2015 000007"),
    "kinect_paper 105": (
        FOLDER | {"path": "kinect_paper/pair_105", "unit": "mm"},
        "two_people_walking",
    ),
    "swing": ({}, "handheld"),
    "swing 1": ({"seed": 1}, "two_people_walking"),
    "pan": ({}, "swing"),
    "street": ({"width": 1024, "height": 436}, "room"),
    "handheld": ({}, "swing"),
    "still": ({"width": 1024, "height": 436}, "two_people_walking"),
    "jam": ({}, "two_people_walking"),
    "room": ({"width": 1024, "height": 436}, "street"),
}
"""Input of every pair, rendered ones by the name of their scene, and the pair of its wrong map."""


STAGES = {
    "nlp": ("segmentation.superpixels=300", "refine.enabled=false"),
    "refined": (),
}
"""Options of the solves of a table."""


def loaded(name: str, data: str) -> Pair:
    """A pair and its truth, sparse points as a depth map."""
    source = dict(PAIRS[name][0])
    for key in {"path", "root"} & set(source):
        source[key] = f"{data}/{source[key]}"
    if "kind" not in source:
        size = {"width": 640, "height": 480}
        source = {"kind": "scene", "scene": name.split()[0]} | size | source
    pair = soup_nlp.make_problem({"name": name, "input": source}, ()).load_pair()
    if pair.truth.depth_ref is None:
        u, v, z = pair.truth.points.T
        depth = np.full(pair.size, np.nan)
        depth[np.rint(v).astype(int), np.rint(u).astype(int)] = z
        pair = replace(pair, truth=replace(pair.truth, depth_ref=depth))
    return pair


def filled(pair: Pair) -> Float:
    """(H, W) true depth, interpolated where it is sparse, the nearest one in its holes."""
    depth = np.array(pair.truth.depth_ref, float)
    known = np.isfinite(depth) & (depth > 0)
    if known.mean() < 0.2:
        at, log = np.argwhere(known), np.log(depth[known])
        grid = tuple(np.mgrid[: depth.shape[0], : depth.shape[1]])
        depth = np.exp(griddata(at, log, grid))
        known = np.isfinite(depth)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return depth[tuple(nearest)]


def scaled_objects(depth: Float) -> Float:
    """A depth times 0.7 or 1.3 on every region without a step of 4 %."""
    log = np.log(depth)
    steps = [np.abs(np.diff(log, axis=a, prepend=log.take([0], axis=a))) for a in (0, 1)]
    region, count = ndimage.label(np.maximum(*steps) < 0.04)
    large = np.bincount(region.ravel(), minlength=count + 1) > 0.002 * depth.size
    large[0] = False
    to = ndimage.distance_transform_edt(~large[region], return_distances=False, return_indices=True)
    region = region[tuple(to)]
    factor = np.zeros(count + 1)
    found = np.unique(region)
    factor[found] = np.where(np.random.default_rng(3).random(len(found)) < 0.5, 0.7, 1.3)
    return depth * factor[region]


def priors(name: str, data: str) -> dict[str, tuple[Float, Float]]:
    """Depth priors of a pair by name, and the depths that they stand for."""
    pair = loaded(name, data)
    depth = filled(pair)
    rng, size = np.random.default_rng(11), depth.shape
    other = cv2.resize(
        filled(loaded(PAIRS[name][1], data)), size[::-1], interpolation=cv2.INTER_NEAREST
    )
    waves = cv2.resize(rng.standard_normal((7, 10)), size[::-1], interpolation=cv2.INTER_CUBIC)
    made = {
        "warp 10 %": warped(depth, 0.1),
        "warp 20 %": warped(depth, 0.2),
        "objects 30 %": scaled_objects(depth),
        "blur 5 px": 1 / cv2.GaussianBlur(1 / depth, (0, 0), 5.0),
        "other scene": other,
        "constant": np.full(size, 3.0),
        "pixel noise": np.exp(0.5 * np.random.default_rng(4).standard_normal(size)),
        "smooth noise": np.exp(0.5 * waves / waves.std()),
    }
    shifted = {"inverse, affine": (0.4 / np.median(depth) + 2.0 / depth, depth)}
    return {key: (value, value) for key, value in made.items()} | shifted


def cell(pair: Pair, prior: Float | None, name: str, options: tuple[str, ...]) -> str:
    """Scores of an answer and of its sigma, or that the prior is not used."""
    raw = {"name": name, "input": {"kind": "motorcycle"}}
    problem = soup_nlp.make_problem(raw, options)
    pair = replace(pair, depth_prior=prior)
    if prior is not None and not prepare(problem, pair=pair).given.evidence.used:
        return "not used"
    begun = time.process_time()
    run = soup_nlp.run(problem, pair=pair)
    spent = time.process_time() - begun
    z, sigma, true = (
        run.reconstruction.depth_ref,
        run.reconstruction.sigma_ref,
        pair.truth.depth_ref,
    )
    score = depth_metrics(z, true)
    there = np.isfinite(true) & (true > 0) & np.isfinite(z)
    ratio, sigma = (score.scale * z / true)[there], sigma[there]
    off, wrong = np.abs(np.log(ratio)), np.abs(ratio - 1) > 0.2
    shares = (
        (sigma[wrong] < 0.1).sum() / max(wrong.sum(), 1),
        (off < sigma).mean(),
        (off < 2 * sigma).mean(),
        float(np.mean(run.confidence.sigma > 0.25)),
    )
    return f"{score.mre:.3f} ({', '.join(f'{share:.0%}' for share in shares)}, {spent:.0f} s)"


if __name__ == "__main__":
    data, stage, *names = sys.argv[1:]
    options = STAGES[stage]
    for name in names or PAIRS:
        pair = loaded(name, data)
        # the flow is computed once
        pair = prepare(soup_nlp.make_problem({"input": {"kind": "motorcycle"}}), pair=pair).pair
        cells = [name, cell(pair, None, name, options)]
        for kind, (prior, depth) in priors(name, data).items():
            if stage == "nlp" or kind == "warp 20 %":
                own = depth_metrics(depth, pair.truth.depth_ref).mre
                cells.append(f"{kind} {own:.3f}: {cell(pair, prior, name, options)}")
        print("| " + " | ".join(cells) + " |", flush=True)
