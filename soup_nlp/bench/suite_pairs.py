"""The pairs of every suite: rendered scenes, real pairs, and the paper's sequences."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from soup_nlp.config.problem import Problem, make_problem
from soup_nlp.data.datasets.sintel import DEFAULT_SCENE

RENDERED = ("street", "room", "sheet", "orbit", "still")


@dataclass(frozen=True)
class Item:
    """One pair with one flow.

    Attributes:
        suite: Its suite.
        sequence: What it is averaged with first.
        name: Unique in its suite.
        flow: Flow source.
        input: The section `input` of its problem.
        presets: Metric conventions it is scored under, the main one first.
        needs: Files that must be there.
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

    def scored_by(self, presets: tuple[str, ...]) -> Item:
        """The same pair under other conventions."""
        return replace(self, presets=presets)

    def problem(self, overrides: Sequence[str] = ()) -> Problem:
        """Its problem with the defaults and overrides.

        Raises:
            ConfigError: an override is wrong.
        """
        raw = {"name": self.name, "input": dict(self.input), "flow": {"source": self.flow}}
        return make_problem(raw, overrides, where=self.key)


@dataclass(frozen=True)
class Options:
    """What changes the list of a suite.

    Attributes:
        flows: Flow sources; None for the suite's own.
        width: Columns of rendered scenes (436 of 1024 rows).
        seeds: Seeds of rendered scenes.
        limit: At most this many pairs, spread evenly, each with every flow; None for all.
        only: Keep names that contain one of these words; empty for all.
    """

    flows: tuple[str, ...] | None = None
    width: int = 1024
    seeds: tuple[int, ...] = (0,)
    limit: int | None = None
    only: tuple[str, ...] = ()


@dataclass(frozen=True)
class Suite:
    """A list of pairs.

    Attributes:
        name: On the command line.
        text: What it is.
        build: Makes its items for a root folder.
        flows: Flow sources by default.
        presets: Metric conventions, the main one first.
        folders: Where under --data its root may be; the first that holds a pair is taken.
        layout: What the root must hold; empty where no data is needed.
        source: Where to get it.
    """

    name: str
    text: str
    build: Callable[[Suite, Path, Options], Iterable[Item]]
    flows: tuple[str, ...] = ("dis",)
    presets: tuple[str, ...] = ("paper", "best")
    folders: tuple[str, ...] = (".",)
    layout: str = ""
    source: str = ""

    def items(
        self, sequence: str, name: str, raw: dict[str, Any], o: Options, *needs: Path
    ) -> Iterable[Item]:
        """One item a flow."""
        for flow in o.flows or self.flows:
            yield Item(self.name, sequence, name, flow, raw, self.presets, needs)


def spread(count: int, wanted: int, first: int = 0) -> list[int]:
    """`wanted` of the numbers first .. first + count - 1, evenly spaced, without repeats."""
    wanted = min(wanted, count)
    return [first + (2 * k + 1) * count // (2 * wanted) for k in range(wanted)]


def rendered(suite: Suite, root: Path, o: Options) -> Iterable[Item]:
    """Every scene of every seed."""
    height = max(48, round(o.width * 436 / 1024))
    for seed in o.seeds:
        for scene in RENDERED:
            raw = {
                "kind": "scene",
                "scene": scene,
                "seed": seed,
                "width": o.width,
                "height": height,
            }
            name = f"{scene}-s{seed}-{o.width}x{height}"
            for flow in o.flows or suite.flows:
                yield Item(suite.name, scene, name, flow, raw, suite.presets)


def shared(suite: Suite, root: Path, o: Options) -> Iterable[Item]:
    """The real pairs of development by family, motorcycle first."""

    def some(
        family: str,
        name: str,
        raw: dict[str, Any],
        needs: Path | None,
        truth: bool = False,
        presets: tuple[str, ...] = suite.presets,
    ) -> Iterable[Item]:
        for flow in o.flows or suite.flows:
            if truth or not flow.startswith("truth"):
                files = () if needs is None else (needs,)
                yield Item(suite.name, family, name, flow, raw, presets, files)

    def folder(
        path: Path, truth: bool = False, presets: tuple[str, ...] = suite.presets, **more: Any
    ) -> Iterable[Item]:
        raw: dict[str, Any] = {"kind": "folder", "path": str(path), **more}
        family = path.name if path.parent == root else path.parent.name
        name = family if path.parent == root else f"{family} {path.name.removeprefix('pair_')}"
        return some(family, name, raw, path / "frame_0.png", truth, presets)

    kitti_presets = ("kitti", "best", "eigen80")
    yield from some("motorcycle", "motorcycle", {"kind": "motorcycle"}, None, True)
    raw: dict[str, Any]
    kitti = root / "kitti2012"
    for index in ("000138", "000027"):
        raw = {"kind": "kitti2012", "root": str(kitti), "index": index}
        image = kitti / "training" / "image_0" / f"{index}_10.png"
        yield from some("kitti2012", f"kitti2012 {index}", raw, image, True, kitti_presets)
    yield from folder(root / "driving_synthetic", True)
    for path in sorted((root / "kinect_paper").glob("pair_*")):
        yield from folder(path, unit="mm")
    raw = {"kind": "sintel", "root": str(root / "sintel")}
    raw |= {"scene": "alley_1", "frame": 20, "step": 5}
    image = root / "sintel" / "training" / "clean" / "alley_1" / "frame_0020.png"
    presets = ("sintel70", "paper", "best")
    yield from some("sintel", "sintel alley_1-0020+5", raw, image, presets=presets)
    tum = root / "tum_fr1"
    raw = {"kind": "tum", "path": str(tum)}
    yield from some("tum_fr1", "tum_fr1", raw, tum / "frame_0.png")
    for path in sorted((root / "kitti2015").glob("pair_*")):
        yield from folder(path, True, kitti_presets)
    track = root / "kitti_tracking"
    for k in range(4):
        names = {"ref": f"frame_{k}.png", "next": f"frame_{k + 1}.png"}
        names |= {"depth": f"depth_{k}.png", "depth_next": f"depth_{k + 1}.png"}
        files = {key: str(track / name) for key, name in names.items()}
        raw = {"kind": "files", **files, "intrinsics": str(track / "K.txt"), "depth_scale": 256.0}
        name = f"kitti_tracking {k}"
        yield from some("kitti_tracking", name, raw, track / f"frame_{k + 1}.png")
    for path in sorted((root / "rgbd").glob("*")):
        yield from folder(path, depth_scale=5000.0)
    for path in sorted((root / "deepdeform").glob("pair_*")):
        yield from folder(path, depth_scale=1000.0)


SINTEL_FRAMES = MappingProxyType(
    {"alley_1": 50, "ambush_4": 33, "mountain_1": 50, "sleeping_1": 50, "temple_2": 50}
)
"""Sequences of the paper and their number of frames."""


def sintel(suite: Suite, root: Path, o: Options) -> Iterable[Item]:
    """Pairs of the five sequences."""
    base = root / "training" if (root / "training").is_dir() else root
    for scene, frames in SINTEL_FRAMES.items():
        # the paper says 120 pairs of these five, not which: 24 each, evenly spaced
        for frame in spread(frames - 1, 24, 1):
            raw = {"kind": "sintel", "root": str(root), "scene": scene, "frame": frame}
            names = [f"{scene}/frame_{frame + k:04d}" for k in (0, 1)]
            needs = [base / "clean" / f"{name}.png" for name in names]
            if scene != DEFAULT_SCENE:
                # the loader knows the camera of one scene only
                needs += [base / "camdata_left" / f"{name}.cam" for name in names]
            yield from suite.items(scene, f"{scene}-{frame:04d}", raw, o, *needs)


def kitti(suite: Suite, root: Path, o: Options) -> Iterable[Item]:
    """Training pairs of KITTI 2012 or 2015."""
    base = root / "training" if (root / "training").is_dir() else root
    camera, count = ("image_0", 194) if suite.name == "kitti2012" else ("image_2", 200)
    for k in range(count):
        raw = {"kind": suite.name, "root": str(root), "index": f"{k:06d}"}
        needs = [base / camera / f"{k:06d}_{frame}.png" for frame in (10, 11)]
        yield from suite.items(suite.name, f"{k:06d}", raw, o, *needs)


VKITTI_FRAMES = MappingProxyType({"0001": 447, "0002": 233, "0006": 270, "0018": 339})
"""Worlds of the paper and their number of frames."""


def vkitti(suite: Suite, root: Path, o: Options) -> Iterable[Item]:
    """Morning pairs of the four worlds, in version 1 or 2."""
    second = (root / "Scene01").is_dir() or (root / "Scene02").is_dir()
    for world, frames in VKITTI_FRAMES.items():
        # 120 pairs of these four, 30 each, evenly spaced: the paper does not say which
        for frame in spread(frames - 1, 30):
            scene = f"Scene{world[2:]}" if second else world
            raw = {
                "kind": "vkitti2" if second else "vkitti1",
                "root": str(root),
                "scene": scene,
                "frame": frame,
                "variation": "morning",
            }
            if second:
                folder = root / scene / "morning/frames/rgb/Camera_0"
                needs = [folder / f"rgb_{frame + k:05d}.jpg" for k in (0, 1)]
            else:
                parts = sorted(root.glob("vkitti_*_rgb")) or [root / "vkitti_1.3.1_rgb"]
                folder = parts[-1] / world / "morning"
                needs = [folder / f"{frame + k:05d}.png" for k in (0, 1)]
            name = f"{world}_morning-{frame:05d}"
            yield from suite.items(f"{world}_morning", name, raw, o, *needs)


def kinect(suite: Suite, root: Path, o: Options) -> Iterable[Item]:
    """Every folder pair_*."""
    for pair in sorted(root.glob("pair_*")):
        raw = {"kind": "folder", "path": str(pair), "unit": "mm", "depth_scale": 1.0}
        yield from suite.items(suite.name, pair.name, raw, o, pair / "frame_0.png")
