"""Suites of pairs: rendered scenes, real pairs, the paper's sequences; where their data are."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.everyday import LAYOUTS
from benchmarks.table import Item
from soup_nlp.data.datasets.benchmarks import DEFAULT_SCENE
from soup_nlp.errors import DataError
from soup_nlp.storage.files import as_path, is_file, is_folder

RENDERED = ("street", "room", "sheet", "orbit", "still", "banner")
MOTORCYCLE = Item("motorcycle", "motorcycle", {"kind": "motorcycle"}, suite="shared")
"""The real pair that needs no data; it comes with scikit-image."""
SINGLE = (
    *("kraw_jam_030", "omd_occlusion_161", "sun3d_lounge", "s7_kitchen_150", "sinus_15_19"),
    *("ddad_rear", "tartan_hospital_066", "flying3d", "pcl_laptop", "adt_rgb_hands"),
)
"""Families of the suite shared with one pair each, in a folder of that name."""
HALF_B = ("kitti2012_074", *SINGLE[2:])
"""Families on which no rule or number was chosen up to 28 November 2026. All others are half A."""
SINTEL_FRAMES = {"alley_1": 50, "ambush_4": 33, "mountain_1": 50, "sleeping_1": 50, "temple_2": 50}
"""Number of frames of the paper's sequences."""
VKITTI_FRAMES = {"0001": 447, "0002": 233, "0006": 270, "0018": 339}
"""Number of frames of the paper's worlds."""


@dataclass(frozen=True)
class Options:
    """Filters and variants of the list of a suite.

    Attributes:
        flows: Flow sources; empty for those of the suite.
        width: Columns of suite rendered, 436 rows per 1024; everyday is 640 x 480 at 1024.
        seeds: Seeds of rendered scenes.
        only: Keep pairs whose names contain one of these words; empty for all.
    """

    flows: tuple[str, ...] = ()
    width: int = 1024
    seeds: tuple[int, ...] = (0,)
    only: tuple[str, ...] = ()


def spread(count: int, wanted: int, first: int = 0) -> list[int]:
    """`wanted` of the numbers first .. first + count - 1, evenly spaced, without repeats."""
    wanted = min(wanted, count)
    return [first + (2 * k + 1) * count // (2 * wanted) for k in range(wanted)]


Items = Iterator[Item]


def _scenes(scenes: Sequence[str], columns: float, rows: float, root: Path, o: Options) -> Items:
    """Rendered scenes with all seeds, of `columns` x `rows` times the width of the options."""
    width, height = max(64, int(o.width * columns)), max(48, round(o.width * rows))
    for seed in o.seeds:
        for scene in scenes:
            raw = {"kind": "scene", "scene": scene, "seed": seed, "width": width, "height": height}
            yield Item(scene, f"{scene}-s{seed}-{width}x{height}", raw)


def _folder(path: Path, family: str, **entries: Any) -> Item:
    """A pair in a folder with frame_0.png, named by its family and folder."""
    name = " ".join(dict.fromkeys([family, path.name.removeprefix("pair_")]))
    true_flow = family in ("kitti2015", "driving_synthetic", "tartan_hospital_066")
    raw = {"kind": "folder", "path": str(path), **entries}
    return Item(family, name, raw, [path / "frame_0.png"], true_flow)


def _shared(root: Path, o: Options) -> Items:
    """The real pairs that development used, by family, the motorcycle first."""
    yield MOTORCYCLE
    for index in ("000138", "000027", "000074"):
        raw = {"kind": "kitti2012", "root": str(root / "kitti2012"), "index": index}
        image = root / "kitti2012" / "training" / "image_0" / f"{index}_10.png"
        family = "kitti2012_074" if index == "000074" else "kitti2012"
        yield Item(family, f"kitti2012 {index}", raw, [image])
    yield _folder(root / "driving_synthetic", "driving_synthetic")
    for path in sorted((root / "kinect_paper").glob("pair_*")):
        yield _folder(path, "kinect_paper", unit="mm")
    raw = {"kind": "sintel", "root": str(root / "sintel"), "scene": "alley_1"}
    image = root / "sintel" / "training" / "clean" / "alley_1" / "frame_0020.png"
    alley = {**raw, "frame": 20, "step": 5}
    yield Item("sintel", "sintel alley_1-0020+5", alley, [image], true_flow=False)
    yield _folder(root / "tum_fr1", "tum_fr1", depth_scale=5000.0)
    for path in sorted((root / "kitti2015").glob("pair_*")):
        yield _folder(path, "kitti2015")
    track = root / "kitti_tracking"
    for k in range(4):
        names = {"ref": f"frame_{k}.png", "next": f"frame_{k + 1}.png", "intrinsics": "K.txt"}
        names |= {"depth": f"depth_{k}.png", "depth_next": f"depth_{k + 1}.png"}
        files = {key: str(track / name) for key, name in names.items()}
        source = {"kind": "files", **files, "depth_scale": 256.0}
        needs = [track / names["next"]]
        yield Item("kitti_tracking", f"kitti_tracking {k}", source, needs, true_flow=False)
    for family, pattern, scale in (("rgbd", "*", 5000.0), ("deepdeform", "pair_*", 1000.0)):
        for path in sorted((root / family).glob(pattern)):
            yield _folder(path, family, depth_scale=scale)
    for family in SINGLE:
        yield _folder(root / family, family)


def _sintel(root: Path, o: Options) -> Items:
    """Pairs of the five sequences, 24 of each: the paper does not name its 120 pairs."""
    base = root / "training" if is_folder(root / "training") else root
    for scene, frames in SINTEL_FRAMES.items():
        for frame in spread(frames - 1, 24, 1):
            raw = {"kind": "sintel", "root": str(root), "scene": scene, "frame": frame}
            names = [f"{scene}/frame_{frame + k:04d}" for k in (0, 1)]
            needs = [base / "clean" / f"{name}.png" for name in names]
            if scene != DEFAULT_SCENE:
                # the loader has a default camera for one scene only
                needs += [base / "camdata_left" / f"{name}.cam" for name in names]
            yield Item(scene, f"{scene}-{frame:04d}", raw, needs)


def _kitti(kind: str, camera: str, count: int, root: Path, o: Options) -> Items:
    base = root / "training" if is_folder(root / "training") else root
    for index in (f"{k:06d}" for k in range(count)):
        needs = [base / camera / f"{index}_{frame}.png" for frame in (10, 11)]
        yield Item(kind, index, {"kind": kind, "root": str(root), "index": index}, needs)


def _vkitti(root: Path, o: Options) -> Items:
    """Morning pairs of version 1 or 2, 30 of each world: the paper does not name its 120 pairs."""
    second = is_folder(root / "Scene01") or is_folder(root / "Scene02")
    parts = sorted(root.glob("vkitti_*_rgb")) or [root / "vkitti_1.3.1_rgb"]
    raw = {"kind": "vkitti2" if second else "vkitti1", "root": str(root), "variation": "morning"}
    for world, frames in VKITTI_FRAMES.items():
        scene = f"Scene{world[2:]}" if second else world
        folder, name = parts[-1] / world / "morning", "{:05d}.png"
        if second:
            folder, name = root / scene / "morning/frames/rgb/Camera_0", "rgb_{:05d}.jpg"
        for frame in spread(frames - 1, 30):
            needs = [folder / name.format(frame + k) for k in (0, 1)]
            source = {**raw, "scene": scene, "frame": frame}
            yield Item(f"{world}_morning", f"{world}_morning-{frame:05d}", source, needs)


def _kinect(root: Path, o: Options) -> Items:
    for pair in sorted(root.glob("pair_*")):
        raw = {"kind": "folder", "path": str(pair), "unit": "mm", "depth_scale": 1.0}
        yield Item("", pair.name, raw, [pair / "frame_0.png"])


# --- suites ---------------------------------------------------------------------------------------


class Suite(NamedTuple):
    """A list of pairs.

    Attributes:
        text: Description.
        pairs: Makes the pairs of a root folder.
        layout: Contents that the root must have; empty if no data is needed.
        source: Where to get the data.
        flows: Default flow sources.
    """

    text: str
    pairs: Callable[[Path, Options], Iterable[Item]]
    layout: str = ""
    source: str = ""
    flows: tuple[str, ...] = ("dis",)


_KINECT = (
    "pair_NNN/ with frame_0.png, frame_1.png, K.txt and points.npz (uv_0 in pixels, xyz_mm_0) or"
    " depth.png (16 bit, millimetres)"
)
_EPFL = "https://www.epfl.ch/labs/cvlab/data/data-dsr/"
SUITES: Mapping[str, Suite] = {
    "rendered": Suite(
        "rendered dynamic scenes",
        partial(_scenes, RENDERED, 1, 436 / 1024),
        flows=("truth", "dis"),
    ),
    "everyday": Suite(
        "rendered scenes of everyday kinds, most without parallax",
        partial(_scenes, tuple(LAYOUTS), 5 / 8, 15 / 32),
    ),
    "shared": Suite(
        "the real pairs that development was done with",
        _shared,
        "kitti2012/, driving_synthetic/, kinect_paper/, sintel/, tum_fr1/, kitti2015/,"
        f" kitti_tracking/, rgbd/, deepdeform/, {', '.join(SINGLE)}",
        "a folder with these pairs; the motorcycle pair comes with scikit-image",
        flows=("truth", "dis"),
    ),
    "sintel": Suite(
        "MPI Sintel, the paper's five sequences",
        _sintel,
        "training/clean/SCENE/frame_NNNN.png, training/depth/SCENE/frame_NNNN.dpt,"
        " training/camdata_left/SCENE/frame_NNNN.cam",
        "http://sintel.is.tue.mpg.de/downloads and its depth training data /depth",
    ),
    "kitti2012": Suite(
        "KITTI stereo and flow 2012",
        partial(_kitti, "kitti2012", "image_0", 194),
        "training/image_0, training/calib, training/disp_occ, training/flow_occ",
        "https://www.cvlibs.net/datasets/kitti/eval_stereo_flow.php",
    ),
    "kitti2015": Suite(
        "KITTI scene flow 2015",
        partial(_kitti, "kitti2015", "image_2", 200),
        "training/image_2, training/calib_cam_to_cam, training/disp_occ_0",
        "https://www.cvlibs.net/datasets/kitti/eval_scene_flow.php",
    ),
    "vkitti": Suite(
        "Virtual KITTI 1 or 2, the paper's four worlds",
        _vkitti,
        "vkitti_1.3.1_rgb/WORLD/morning and _depthgt, _flowgt (version 1), or"
        " SceneNN/morning/frames/rgb, depth, forwardFlow (version 2)",
        "https://europe.naverlabs.com/proxy-virtual-worlds/",
    ),
    "kinect_paper": Suite("bending paper of EPFL", _kinect, _KINECT, _EPFL),
    "kinect_tshirt": Suite("bending T-shirt of EPFL", _kinect, _KINECT, _EPFL),
}
"""Suites by name."""


def every_pair(name: str, root: Path, o: Options) -> Items:
    """Every wanted pair of a suite with every flow, whether its files exist or not."""
    suite = SUITES[name]
    for pair in suite.pairs(root, o):
        if not o.only or any(word in pair.name for word in o.only):
            for flow in o.flows or suite.flows:
                if pair.true_flow or not flow.startswith("truth"):
                    yield replace(pair, suite=name, family=pair.family or name, flow=flow)


def list_suite(
    name: str,
    data: Path | None = None,
    options: Options | None = None,
    say: Callable[[str], object] = lambda line: None,
) -> list[Item]:
    """The available pairs of a suite, each with every flow.

    `data` is the root folder of the dataset, or a folder that holds it. `say` is called with a line
    on the number of pairs that were found, and of those of the list.
    """
    if name not in SUITES:
        raise DataError("unknown suite", found=repr(name), expected=", ".join(SUITES))
    suite, o = SUITES[name], options or Options()
    root = Path(os.path.realpath(as_path(data or Path(), "data folder", home=True)))
    for folder in (".", name):
        listed = list(every_pair(name, Path(os.path.realpath(root / folder)), o))
        here = [i for i in listed if all(is_file(f) for f in i.needs)]
        if any(i.needs for i in here) or (here and not suite.layout):
            found, total = (len({i.name for i in items}) for items in (here, listed))
            say(f"suite {name}: {found} of {total} pairs found")
            return here
    if o.only and not listed and (not suite.layout or is_folder(root)):
        raise DataError(
            "no pair of the suite has such a name", where=f"suite {name}", found=", ".join(o.only)
        )
    raise DataError(
        f"suite {name} ({suite.text}) has no pair in the folder",
        where=data or "--data was not given",
        found="no folder" if not is_folder(root) else "none of its images",
        expected=suite.layout,
        hint=f"get it from {suite.source}, lay it out so, and give its root as --data",
    )
