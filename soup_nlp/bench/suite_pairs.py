"""The pairs of every suite: rendered scenes, real pairs, and the paper's sequences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from soup_nlp.config.problem import Problem, make_problem
from soup_nlp.data.datasets.benchmarks import DEFAULT_SCENE
from soup_nlp.data.scenes.everyday import LAYOUTS
from soup_nlp.storage.files import is_folder

RENDERED = ("street", "room", "sheet", "orbit", "still", "banner")
EVERYDAY = tuple(LAYOUTS)
KITTI_PRESETS = ("kitti", "eigen80", "best")
SINTEL_FRAMES = MappingProxyType(
    {"alley_1": 50, "ambush_4": 33, "mountain_1": 50, "sleeping_1": 50, "temple_2": 50}
)
"""Number of frames of the paper's sequences."""
VKITTI_FRAMES = MappingProxyType({"0001": 447, "0002": 233, "0006": 270, "0018": 339})
"""Number of frames of the paper's worlds."""


@dataclass(frozen=True)
class Item:
    """A pair of a suite with one flow source.

    Attributes:
        suite: Name of the suite.
        sequence: Sequence or family, over which tables average first.
        name: Name, unique in the suite.
        flow: Flow source.
        input: Section `input` of the problem.
        presets: Metric conventions of the scores, the main one first.
        needs: Files that must exist.
    """

    suite: str
    sequence: str
    name: str
    flow: str
    input: Mapping[str, Any] = field(repr=False)
    presets: tuple[str, ...] = ("paper",)
    needs: tuple[Path, ...] = field(default=(), repr=False)

    @property
    def key(self) -> str:
        """Unique among all suites."""
        return f"{self.suite}/{self.name}/{self.flow}"

    def scored_by(self, presets: Sequence[str] | None) -> Item:
        """The item with other metric conventions; unchanged if none are given."""
        return replace(self, presets=tuple(presets)) if presets else self

    def problem(self, overrides: Sequence[str] = ()) -> Problem:
        """The problem of the pair with default options and overrides.

        Raises:
            ConfigError: an override is wrong.
        """
        raw = {"name": self.name, "input": dict(self.input), "flow": {"source": self.flow}}
        return make_problem(raw, overrides, where=self.key)


@dataclass(frozen=True)
class Options:
    """Filters and variants of the list of a suite.

    Attributes:
        flows: Flow sources; None for those of the suite.
        width: Columns of suite rendered, 436 rows per 1024; everyday is 640 x 480 at 1024.
        seeds: Seeds of rendered scenes.
        limit: Most pairs, evenly spaced, each with every flow; None for all.
        only: Keep pairs whose names contain one of these words; empty for all.
    """

    flows: tuple[str, ...] | None = None
    width: int = 1024
    seeds: tuple[int, ...] = (0,)
    limit: int | None = None
    only: tuple[str, ...] = ()


class Entry(NamedTuple):
    """A pair of a suite with fields of `Item`; empty `presets` stand for those of the suite.

    `true_flow` says whether the pair has a true flow that it may be solved with.
    """

    sequence: str
    name: str
    input: Mapping[str, Any]
    needs: tuple[Path, ...] = ()
    true_flow: bool = True
    presets: tuple[str, ...] = ()


def spread(count: int, wanted: int, first: int = 0) -> list[int]:
    """`wanted` of the numbers first .. first + count - 1, evenly spaced, without repeats."""
    wanted = min(wanted, count)
    return [first + (2 * k + 1) * count // (2 * wanted) for k in range(wanted)]


def rendered(root: Path, o: Options) -> Iterator[Entry]:
    """All rendered scenes with all seeds."""
    size = {"width": o.width, "height": max(48, round(o.width * 436 / 1024))}
    for seed in o.seeds:
        for scene in RENDERED:
            name = f"{scene}-s{seed}-{size['width']}x{size['height']}"
            yield Entry(scene, name, {"kind": "scene", "scene": scene, "seed": seed, **size})


def everyday(root: Path, o: Options) -> Iterator[Entry]:
    """The everyday scenes with all seeds, 4:3 pictures."""
    size = {"width": max(64, o.width * 5 // 8), "height": max(48, o.width * 15 // 32)}
    for seed in o.seeds:
        for scene in EVERYDAY:
            raw = {"kind": "scene", "scene": scene, "seed": seed, **size}
            yield Entry(scene, f"{scene}-s{seed}-{size['width']}x{size['height']}", raw)


def shared(root: Path, o: Options) -> Iterator[Entry]:
    """The real pairs that development used, by family, the motorcycle first."""
    kitti = ("kitti", "best", "eigen80")

    def folders(family: str, true_flow: bool = False, **more: Any) -> Iterator[Entry]:
        presets = kitti if family == "kitti2015" else ()
        for path in sorted((root / family).glob("*" if family == "rgbd" else "pair_*")):
            name = f"{family} {path.name.removeprefix('pair_')}"
            raw = {"kind": "folder", "path": str(path), **more}
            yield Entry(family, name, raw, (path / "frame_0.png",), true_flow, presets)

    yield Entry("motorcycle", "motorcycle", {"kind": "motorcycle"})
    for index in ("000138", "000027"):
        raw = {"kind": "kitti2012", "root": str(root / "kitti2012"), "index": index}
        image = root / "kitti2012" / "training" / "image_0" / f"{index}_10.png"
        yield Entry("kitti2012", f"kitti2012 {index}", raw, (image,), True, kitti)
    path = root / "driving_synthetic"
    raw = {"kind": "folder", "path": str(path)}
    yield Entry(path.name, path.name, raw, (path / "frame_0.png",))
    yield from folders("kinect_paper", unit="mm")
    alley: dict[str, Any] = {"scene": "alley_1", "frame": 20, "step": 5}
    alley |= {"kind": "sintel", "root": str(root / "sintel")}
    image = root / "sintel" / "training" / "clean" / "alley_1" / "frame_0020.png"
    presets = ("sintel70", "paper", "best")
    yield Entry("sintel", "sintel alley_1-0020+5", alley, (image,), False, presets)
    path = root / "tum_fr1"
    raw = {"kind": "tum", "path": str(path)}
    yield Entry("tum_fr1", "tum_fr1", raw, (path / "frame_0.png",), False)
    yield from folders("kitti2015", True)
    track = root / "kitti_tracking"
    for k in range(4):
        names = {"ref": f"frame_{k}.png", "next": f"frame_{k + 1}.png", "intrinsics": "K.txt"}
        names |= {"depth": f"depth_{k}.png", "depth_next": f"depth_{k + 1}.png"}
        files = {key: str(track / name) for key, name in names.items()}
        own = {"kind": "files", **files, "depth_scale": 256.0}
        needs = (track / names["next"],)
        yield Entry("kitti_tracking", f"kitti_tracking {k}", own, needs, False)
    yield from folders("rgbd", depth_scale=5000.0)
    yield from folders("deepdeform", depth_scale=1000.0)


def sintel(root: Path, o: Options) -> Iterator[Entry]:
    """Pairs of the five sequences."""
    base = root / "training" if is_folder(root / "training") else root
    for scene, frames in SINTEL_FRAMES.items():
        # the paper uses 120 pairs of these five sequences but does not name them: 24 each
        for frame in spread(frames - 1, 24, 1):
            raw = {"kind": "sintel", "root": str(root), "scene": scene, "frame": frame}
            names = [f"{scene}/frame_{frame + k:04d}" for k in (0, 1)]
            needs = [base / "clean" / f"{name}.png" for name in names]
            if scene != DEFAULT_SCENE:
                # the loader has a default camera for one scene only
                needs += [base / "camdata_left" / f"{name}.cam" for name in names]
            yield Entry(scene, f"{scene}-{frame:04d}", raw, tuple(needs))


def kitti(kind: str, camera: str, count: int, root: Path, o: Options) -> Iterator[Entry]:
    """Training pairs of KITTI 2012 or 2015."""
    base = root / "training" if is_folder(root / "training") else root
    for index in (f"{k:06d}" for k in range(count)):
        needs = tuple(base / camera / f"{index}_{frame}.png" for frame in (10, 11))
        yield Entry(kind, index, {"kind": kind, "root": str(root), "index": index}, needs)


def vkitti(root: Path, o: Options) -> Iterator[Entry]:
    """Morning pairs of the four worlds, in version 1 or 2."""
    second = is_folder(root / "Scene01") or is_folder(root / "Scene02")
    parts = sorted(root.glob("vkitti_*_rgb")) or [root / "vkitti_1.3.1_rgb"]
    raw = {"kind": "vkitti2" if second else "vkitti1", "root": str(root), "variation": "morning"}
    for world, frames in VKITTI_FRAMES.items():
        scene = f"Scene{world[2:]}" if second else world
        # the paper uses 120 pairs of these four worlds but does not name them: 30 each
        for frame in spread(frames - 1, 30):
            if second:
                folder = root / scene / "morning/frames/rgb/Camera_0"
                needs = tuple(folder / f"rgb_{frame + k:05d}.jpg" for k in (0, 1))
            else:
                folder = parts[-1] / world / "morning"
                needs = tuple(folder / f"{frame + k:05d}.png" for k in (0, 1))
            name = f"{world}_morning-{frame:05d}"
            yield Entry(f"{world}_morning", name, {**raw, "scene": scene, "frame": frame}, needs)


def kinect(root: Path, o: Options) -> Iterator[Entry]:
    """Every folder pair_*."""
    for pair in sorted(root.glob("pair_*")):
        raw = {"kind": "folder", "path": str(pair), "unit": "mm", "depth_scale": 1.0}
        yield Entry("", pair.name, raw, (pair / "frame_0.png",))
