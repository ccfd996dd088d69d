"""Make the pictures of the documents, and the verdicts below those of gallery.md.

`PYTHONPATH=. python docs/gallery.py` makes all of them, `docs/gallery.py street` the moving picture
and the slider of the first page alone, `docs/gallery.py prior` the picture of depth_prior.md.
"""

import re
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

import benchmarks.everyday  # noqa: F401, makes its scenes known
import soup_nlp
from soup_nlp.arrays import Float
from soup_nlp.evaluation.metrics import depth_metrics
from soup_nlp.geometry.camera import project
from soup_nlp.report.chain import Chain
from soup_nlp.report.figures import colourise_depth, depth_range, strip
from soup_nlp.report.findings import certainty_lines, found_words, hints
from soup_nlp.report.pictures import Picture, pictures
from soup_nlp.report.result import result_of
from soup_nlp.report.verdict import certainty, sectioned, summary

PAGE = Path(__file__).with_name("gallery.md")
RESULTS = PAGE.parents[1] / "results"
OPTIONS = ("segmentation.superpixels=300",)
PANELS = ("image_ref", "depth_ref", "confidence", "depth_true")
SHOWN, FRAMES, LATEST = (480, 204), 32, 6.0
"""Size and number of the frames of the moving picture; its latest moment, in steps of the pair."""
PLACE = re.compile(r"\(gallery/(\w+)\.jpg\)\n\n```text\n.*?```", re.DOTALL)
"""A picture, named after its scene, and the verdict below it."""


def made(scene: str) -> str:
    """Solve a scene, write its picture, and return the verdict on its depth."""
    source = {"kind": "scene", "scene": scene, "width": 640, "height": 480}
    run = soup_nlp.run(soup_nlp.make_problem({"name": scene, "input": source}, OPTIONS))
    drawn = pictures(Chain.of(result_of(run, summary(run))))
    sheet = strip([drawn[name] for name in PANELS], "", columns=len(PANELS), panel_width=270)
    Image.fromarray(sheet).save(PAGE.with_name("gallery") / f"{scene}.jpg", quality=80)
    scores = (f"{name} {run.metrics[name].mre:.3f}" for name in ("solution", "constant"))
    sections = {
        "found": found_words(run),
        "certainty": certainty_lines(certainty(run)),
        "try": hints(run),
        "MRE": [", ".join(scores)],
        "exit code": [f"{0 if run.good else 1}"],
    }
    return sectioned(sections) + "\n"


def warped(depth: Float, share: float) -> Float:
    """(H, W) depth times a smooth random factor whose log has the standard deviation of a share."""
    waves = np.random.default_rng(7).standard_normal((5, 7))
    smooth = cv2.resize(waves, depth.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return depth * np.exp(np.log1p(share) * smooth / smooth.std())


def with_prior(scene: str) -> list[Picture]:
    """True depth of a scene, a prior that is wrong by 20 %, depth without it and with it."""
    source = {"kind": "scene", "scene": scene, "width": 640, "height": 480}
    options = "segmentation.superpixels=600", "refine.enabled=false"
    problem = soup_nlp.make_problem({"name": scene, "input": source}, options)
    pair = problem.load_pair()
    true = pair.truth.depth_ref
    given = warped(true, 0.2)
    near, far = depth_range(true)
    found = [Picture(scene, pair.image_ref)]
    for title, depth in (
        ("true depth", true),
        ("depth prior, wrong by 20 %", given),
        ("without a prior", soup_nlp.run(problem, pair=pair)),
        ("with the prior", soup_nlp.run(problem, pair=replace(pair, depth_prior=given))),
    ):
        z = depth.reconstruction.depth_ref if isinstance(depth, soup_nlp.Run) else depth
        score = depth_metrics(z, true)
        said = "" if z is true else f", MRE {score.mre:.3f}"
        found.append(Picture(title + said, colourise_depth(z * score.scale, near, far)))
    return found


def splatted(points: Float, colour: Image, K: Float) -> Image:
    """(H, W, 3) picture of points (M, 3) of colours (M, 3), nearer ones on top, for a camera K."""
    out = np.full((*SHOWN[::-1], 3), 255, np.uint8)
    ahead = np.flatnonzero(points[:, 2] > 0.1)
    order = ahead[np.argsort(-points[ahead, 2])]
    at = np.rint(project(K, points[order])).astype(int)
    for shift in np.ndindex(2, 2):
        x, y = (at + shift).T
        inside = (x >= 0) & (y >= 0) & (x < SHOWN[0]) & (y < SHOWN[1])
        out[y[inside], x[inside]] = colour[order[inside]]
    return out


def street() -> None:
    """Write a moving picture of a rendered street in which cars move, and the slider's pictures.

    Cars move along the motions that were found, and a camera moves aside, so that depth is seen.
    """
    source = {"kind": "scene", "scene": "street", "seed": 1, "width": 1024, "height": 436}
    run = soup_nlp.run(soup_nlp.make_problem({"name": "street", "input": source}))
    rec, image, K = run.reconstruction, run.pair.image_ref, run.pair.K_ref
    near, far = depth_range(rec.depth_ref)
    depth = colourise_depth(rec.depth_ref, near, far)
    for name, shown in (("image", image), ("depth", depth)):
        Image.fromarray(shown).save(PAGE.with_name("gallery") / f"street_{name}.jpg", quality=85)
    # the next frame's points in the axes of the first camera: what stands still stays
    before, after = rec.points_ref, run.camera.inverse(rec.points_next)
    seen = np.isfinite(before).all(axis=2) & np.isfinite(after).all(axis=2)
    middle = float(np.median(rec.depth_ref))
    K = np.diag([SHOWN[0] / image.shape[1], SHOWN[1] / image.shape[0], 1.0]) @ K
    frames = []
    for phase in 2 * np.pi * np.arange(FRAMES) / FRAMES:
        # smoothly from the first frame to `LATEST` and back
        time = LATEST * (1 - np.cos(phase)) / 2
        points = (before + time * (after - before))[seen]
        view = points - middle * np.array([0.06 * np.sin(phase), -0.02 * np.cos(phase), 0.0])
        pair = [splatted(view, colour[seen], K) for colour in (image, depth)]
        frames.append(Image.fromarray(np.concatenate(pair, axis=1)))
    path = RESULTS / "street.webp"
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=80, loop=0, quality=70)


if __name__ == "__main__":
    if sys.argv[1:] in ([], ["street"]):
        street()
    if sys.argv[1:] == ["street"]:
        sys.exit()
    panels = [picture for scene in ("swing", "pan") for picture in with_prior(scene)]
    sheet = strip(panels, "", columns=len(panels) // 2, panel_width=270)
    Image.fromarray(sheet).save(RESULTS / "depth_prior.jpg", quality=80)
    if sys.argv[1:] == ["prior"]:
        sys.exit()
    PAGE.with_name("gallery").mkdir(exist_ok=True)
    words = PAGE.read_text(encoding="utf-8")
    words = PLACE.sub(lambda m: f"(gallery/{m[1]}.jpg)\n\n```text\n{made(m[1])}```", words)
    PAGE.write_text(words, encoding="utf-8")
