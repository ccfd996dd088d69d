"""Suites of pairs, with the source and the folder layout of their data."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

from soup_nlp.bench import suite_pairs as pairs
from soup_nlp.bench.suite_pairs import KITTI_PRESETS, RENDERED, Entry, Item, Options, spread
from soup_nlp.errors import DataError
from soup_nlp.storage.files import as_path, is_file, is_folder

_KINECT_LAYOUT = (
    "pair_NNN/ with frame_0.png, frame_1.png, K.txt and points.npz (uv_0 in pixels, xyz_mm_0) or"
    " depth.png (16 bit, millimetres), one folder a pair of frames of the sequence"
)
_KINECT_SOURCE = (
    "EPFL CVLab, deformable surface reconstruction, https://www.epfl.ch/labs/cvlab/data/data-dsr/"
)


@dataclass(frozen=True)
class Suite:
    """A list of pairs.

    Attributes:
        name: Name on the command line.
        text: Description.
        entries: Makes the pairs of a root folder.
        flows: Default flow sources.
        presets: Metric conventions, the main one first.
        folders: Candidates for the root below --data; the first one with a pair is used.
        layout: Contents that the root must have; empty if no data is needed.
        source: Where to get the data.
    """

    name: str
    text: str
    entries: Callable[[Path, Options], Iterable[Entry]]
    flows: tuple[str, ...] = ("dis",)
    presets: tuple[str, ...] = ("paper", "best")
    folders: tuple[str, ...] = (".",)
    layout: str = ""
    source: str = ""

    def items(self, root: Path, o: Options) -> Iterator[Item]:
        """Every wanted pair with every flow, whether its files exist or not."""
        for e in self.entries(root, o):
            if o.only and not any(word in e.name for word in o.only):
                continue
            for flow in o.flows or self.flows:
                if e.true_flow or not flow.startswith("truth"):
                    sequence, presets = e.sequence or self.name, e.presets or self.presets
                    yield Item(self.name, sequence, e.name, flow, e.input, presets, e.needs)


_ALL = (
    Suite("rendered", f"{len(RENDERED)} rendered dynamic scenes", pairs.rendered, ("truth", "dis")),
    Suite(
        "everyday",
        f"{len(pairs.EVERYDAY)} rendered scenes of everyday kinds, most with little or no parallax",
        pairs.everyday,
    ),
    Suite(
        "shared",
        "the real pairs that development was done with",
        pairs.shared,
        ("truth", "dis"),
        folders=(".", "../shared/data"),
        layout=(
            "kitti2012/, driving_synthetic/, kinect_paper/, sintel/, tum_fr1/, kitti2015/,"
            " kitti_tracking/, rgbd/ and deepdeform/"
        ),
        source="a folder with these pairs; the motorcycle pair comes with scikit-image",
    ),
    Suite(
        "sintel",
        "MPI Sintel, the paper's five sequences, 24 pairs each",
        pairs.sintel,
        presets=("sintel70", "paper", "best"),
        folders=(".", "sintel", "MPI-Sintel-complete"),
        layout=(
            "training/clean/SCENE/frame_NNNN.png, training/depth/SCENE/frame_NNNN.dpt,"
            " training/camdata_left/SCENE/frame_NNNN.cam"
        ),
        source="http://sintel.is.tue.mpg.de/downloads and its depth training data /depth",
    ),
    Suite(
        "kitti2012",
        "KITTI stereo and flow 2012, 194 training pairs",
        partial(pairs.kitti, "kitti2012", "image_0", 194),
        presets=KITTI_PRESETS,
        folders=(".", "kitti2012", "data_stereo_flow"),
        layout="training/image_0, training/calib, training/disp_occ, training/flow_occ",
        source="https://www.cvlibs.net/datasets/kitti/eval_stereo_flow.php (data_stereo_flow.zip)",
    ),
    Suite(
        "kitti2015",
        "KITTI scene flow 2015, 200 training pairs",
        partial(pairs.kitti, "kitti2015", "image_2", 200),
        presets=KITTI_PRESETS,
        folders=(".", "kitti2015", "data_scene_flow"),
        layout="training/image_2, training/calib_cam_to_cam, training/disp_occ_0, disp_occ_1",
        source=(
            "https://www.cvlibs.net/datasets/kitti/eval_scene_flow.php (data_scene_flow.zip and"
            " data_scene_flow_calib.zip)"
        ),
    ),
    Suite(
        "vkitti",
        "Virtual KITTI 1 or 2, the paper's four worlds, 30 morning pairs each",
        pairs.vkitti,
        presets=KITTI_PRESETS,
        folders=(".", "vkitti", "vkitti1", "vkitti2"),
        layout=(
            "vkitti_1.3.1_rgb/WORLD/morning and _depthgt, _flowgt (version 1), or"
            " SceneNN/morning/frames/rgb, depth, forwardFlow (version 2)"
        ),
        source="https://europe.naverlabs.com/proxy-virtual-worlds/",
    ),
    *(
        Suite(
            f"kinect_{thing}",
            f"bending {text} of EPFL",
            pairs.kinect,
            folders=(f"kinect_{thing}", "."),
            layout=_KINECT_LAYOUT,
            source=_KINECT_SOURCE,
        )
        for thing, text in (("paper", "paper"), ("tshirt", "T-shirt"))
    ),
)
SUITES: Mapping[str, Suite] = MappingProxyType({s.name: s for s in _ALL})
"""Suites by name."""


@dataclass(frozen=True)
class Listing:
    """The available pairs of a suite.

    Attributes:
        suite: The suite.
        items: One item for each pair and flow.
        left_out: Number of available pairs that a limit leaves out.
        missing: Number of pairs in the filtered list of the suite that do not exist.
    """

    suite: Suite
    items: tuple[Item, ...]
    left_out: int = 0
    missing: int = 0

    def __str__(self) -> str:
        pairs = len(_names(self.items))
        rows = f" ({len(self.items)} rows)" if len(self.items) > pairs else ""
        limit = f", {self.left_out} left out by the limit" if self.left_out else ""
        lack = f", {self.missing} of the list are not in the folder" if self.missing else ""
        return f"suite {self.suite.name}: {pairs} pairs{rows}{limit}{lack}"


def list_suite(name: str, data: Path | None = None, options: Options | None = None) -> Listing:
    """The available pairs of a suite.

    `data` is the root folder of the dataset, or a folder that holds it.

    Raises:
        DataError: the suite is unknown, or none of its pairs is in the folder; the message names
            the source of the dataset and its folder layout.
    """
    if name not in SUITES:
        raise DataError("unknown suite", found=repr(name), expected=", ".join(SUITES))
    suite, o = SUITES[name], options or Options()
    root = Path(os.path.realpath(as_path(data or Path(), "data folder", home=True)))
    listed: list[Item] = []
    for folder in suite.folders:
        listed = list(suite.items(Path(os.path.realpath(root / folder)), o))
        here = [i for i in listed if all(is_file(f) for f in i.needs)]
        if any(i.needs for i in here) or (here and not suite.layout):
            names = _names(here)
            kept = names if o.limit is None else [names[k] for k in spread(len(names), o.limit)]
            items = tuple(i for i in here if i.name in kept)
            missing = len(_names(listed)) - len(names)
            return Listing(suite, items, len(names) - len(kept), missing)
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


def _names(items: Iterable[Item]) -> list[str]:
    """Different names of the pairs, in order."""
    return list(dict.fromkeys(i.name for i in items))
