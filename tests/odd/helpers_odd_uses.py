"""Odd uses of sequences, problem sets, pages, other formats, presets and maps of confidence."""

from __future__ import annotations

import io
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from helpers_odd_paths import NO_FOLDER
from helpers_odd_run import Case
from helpers_odd_world import ODD, SIZE, World, encoded_noise, settings, solve

from soup_nlp.cli.main import main

Words = Callable[[World, Path], list[str]]

DIGITS = "1" + "0" * 5000


def chain(w: World, o: Path, *words: str, count: int = 2) -> list[str]:
    """`chain` of the tiny pair."""
    images = [str(w.good("a.png")), str(w.good("b.png"))][:count]
    return ["chain", *images, *settings(), *words, "-q", "-o", str(o / "out")]


def clip(o: Path, *names: str, sizes: tuple[tuple[int, int], ...] = (SIZE,)) -> Path:
    """A folder of images of noise, of one size or of one each."""
    folder = o / "clip"
    folder.mkdir(exist_ok=True)
    for k, name in enumerate(names or ("frame_0.png", "frame_1.png")):
        (folder / name).write_bytes(encoded_noise(sizes[k % len(sizes)]))
    return folder


def with_file(name: str, make: Callable[[Path], object]) -> Words:
    """`chain` of a folder of frames beside an odd file."""

    def words(w: World, o: Path) -> list[str]:
        make(clip(o) / name)
        return ["chain", str(o / "clip"), *settings(), "-q", "-o", str(o / "out")]

    return words


def of(*names: str, sizes: tuple[tuple[int, int], ...] = (SIZE,), more: tuple = ()) -> Words:
    """`chain` of a folder of frames."""
    return lambda w, o: [
        "chain", str(clip(o, *names, sizes=sizes)), *settings(), *more, "-q", "-o", str(o / "out"),
    ]  # fmt: skip


def video(o: Path, frames: int, size: tuple[int, int] = SIZE) -> Path:
    """A video of noise."""
    path = o / "clip.avi"
    coder = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 5.0, size[::-1])
    for _ in range(frames):
        coder.write(cv2.imdecode(np.frombuffer(encoded_noise(size), np.uint8), 1))
    coder.release()
    return path


def rows_before(text: bytes, result: bytes | None = None) -> Words:
    """`chain` into a folder that holds rows and a pair already."""

    def words(w: World, o: Path) -> list[str]:
        (o / "out").mkdir()
        (o / "out" / "pairs.jsonl").write_bytes(text)
        if result is not None:
            (o / "out" / "pairs" / "000_001").mkdir(parents=True)
            (o / "out" / "pairs" / "000_001" / "result.h5").write_bytes(result)
        return chain(w, o, "--fov=400")

    return words


CHAINS: dict[str, Words] = {
    "stride of 5001 digits": lambda w, o: chain(w, o, f"--stride={DIGITS}"),
    "auto of two frames alike": of("1.png", "2.png", more=("--stride=auto",)),
    "one image": lambda w, o: chain(w, o, count=1),
    "one frame of a folder": of(more=("--stride=3",)),
    "two cameras": lambda w, o: chain(w, o, "--intrinsics=60,60,32,24", "--fov=50"),
    "other input": lambda w, o: chain(w, o, "--set", "input.kind=scene"),
    "memory": lambda w, o: chain(w, o, "--set", "input.kind=memory", "--set", "input.hash=x"),
    **{
        f"source {text!r}": lambda w, o, t=text: ["chain", t, "-q", "-o", str(o / "out")]
        for text in (
            "scene:", "scene:nothing", "scene:../street", "scene:street ", "scene:\x1b[31m", "",
            "/dev", "a**b/*.png", "[", "[!]", "no/such/*.png", "http://localhost:1/a.mp4",
            "*" * 300, "rtsp://localhost:1/x.mov",
        )
    },
    "scene twice": lambda w, o: ["chain", "scene:street", "scene:room", "-o", str(o / "out")],
    "scene and image": lambda w, o: ["chain", "scene:street", "a.png", "-q", "-o", str(o / "out")],
    "scene with stride": lambda w, o: ["chain", "scene:orbit", "--stride=2", "-o", str(o / "out")],
    "scene with camera": lambda w, o: ["chain", "scene:orbit", "--fov=50", "-o", str(o / "out")],
    "scene over two": lambda w, o: [
        "chain", "scene:orbit", "--two-frame", "-q", "-o", str(o / "out"),
    ],
    "images of two sizes": of(sizes=(SIZE, (48, 80))),
    "images too small": of(sizes=((8, 8),)),
    "superscripts": of("1²3.png", "1²4.png", more=("--fov=400",)),
    "digits of other scripts": of("\u0661.png", "\u0662.png", more=("--fov=400",)),
    "no images": lambda w, o: (
        (o / "clip").mkdir() or ["chain", str(o / "clip"), "-q", "-o", str(o / "out")]
    ),
    "images that are folders": lambda w, o: [
        (o / "clip" / n).mkdir(parents=True) for n in ("1.png", "2.png")
    ] and ["chain", str(o / "clip"), "-q", "-o", str(o / "out")],
    "camera is a folder": with_file("K.txt", Path.mkdir),
    "camera is a pipe": with_file("K.txt", os.mkfifo),
    "camera is binary": with_file("K.txt", lambda p: p.write_bytes(bytes(range(256)))),
    "camera of three numbers": with_file("K.txt", lambda p: p.write_text("1 2 3")),
    "camera of NaN": with_file("K.txt", lambda p: p.write_text("nan 60 32 24")),
    "dangling frame": with_file("frame_2.png", lambda p: p.symlink_to("nowhere")),
    "pipe among frames": with_file("frame_2.png", os.mkfifo),
    "text among frames": with_file("frame_2.png", lambda p: p.write_text("no picture")),
    **{
        f"video {kind}": lambda w, o, k=kind: [
            "chain", w.odd(k, ".mp4"), "-q", "-o", str(o / "out"),
        ]
        for kind in ODD
    },
    "video of one frame": lambda w, o: ["chain", str(video(o, 1)), "-q", "-o", str(o / "out")],
    "video of tiny frames": lambda w, o: [
        "chain", str(video(o, 3, (16, 16))), "-q", "-o", str(o / "out"),
    ],
    "video over frames of the user": lambda w, o: [
        (o / "out" / "frames").mkdir(parents=True), (o / "out/frames/0000.png").write_bytes(b"x"),
    ] and ["chain", str(video(o, 3)), "-q", "-o", str(o / "out")],
    "video with a stride beyond": lambda w, o: [
        "chain", str(video(o, 3)), "--stride=9", "-q", "-o", str(o / "out"),
    ],
    "page of the user": lambda w, o: [
        (o / "out").mkdir(), (o / "out" / "chain.html").write_text("mine"),
    ] and chain(w, o),
    "clouds of the user": lambda w, o: [
        (o / "out" / "points").mkdir(parents=True), (o / "out/points/0000.ply").write_text("mine"),
    ] and chain(w, o),
    "pairs is a file": lambda w, o: [
        (o / "out").mkdir(), (o / "out" / "pairs").write_text("mine"),
    ] and chain(w, o),
    "rows are a folder": lambda w, o: (
        (o / "out" / "pairs.jsonl").mkdir(parents=True) or chain(w, o)
    ),
    "rows are binary": rows_before(bytes(range(256)) * 9),
    "rows of lists": rows_before(b'[1]\n{"key": [1]}\n{"key": {}}\n'),
    "rows and no result": rows_before(b'{"key": "000_001", "ok": true}\n', b"no HDF5"),
    **{
        f"out {kind}": lambda w, o, k=kind: [*chain(w, o)[:-1], w.odd(k, "")] for kind in NO_FOLDER
    },
}  # fmt: skip
"""Sequences that cannot be solved."""


def family_cases() -> Iterator[Case]:
    for kind in NO_FOLDER:
        yield Case("5 doors", f"family -o {kind}", lambda w, o, k=kind: ["family", w.odd(k, "")])

    def own(name: str) -> Words:
        def words(w: World, o: Path) -> list[str]:
            (o / name).write_text("mine")
            return ["family", str(o), "--sizes=100", "--scenes=orbit", "--starts=hard"]

        return words

    for name in ("notes.txt", "index.json", ".hidden"):
        yield Case("5 doors", f"family over {name}", own(name))


# --- pages and other formats ---------------------------------------------------------------------


def _set(file: h5py.File, name: str, change: Callable[[Any], Any]) -> None:
    value = file[name][()]
    del file[name]
    file[name] = change(value)


H5: dict[str, Callable[[h5py.File], object]] = {
    "negative labels": lambda f: _set(f, "segmentation/labels", lambda x: x - 5),
    "labels beyond": lambda f: _set(f, "segmentation/labels", lambda x: x + 10**6),
    "labels of floats": lambda f: _set(f, "segmentation/labels", lambda x: x + 0.5),
    "labels of one row": lambda f: _set(f, "segmentation/labels", lambda x: x[0]),
    "images of one channel": lambda f: _set(f, "input/image_ref", lambda x: x[..., 0]),
    "images of four channels": lambda f: _set(f, "input/image_ref", lambda x: x[..., [0, 1, 2, 0]]),
    "images of floats": lambda f: _set(f, "input/image_ref", lambda x: x / 255.0),
    "image of no pixel": lambda f: _set(f, "input/image_next", lambda x: x[:0]),
    "image of another size": lambda f: _set(f, "input/image_ref", lambda x: x[:20]),
    "singular camera": lambda f: _set(f, "input/K_ref", lambda x: 0 * x),
    "camera of NaN": lambda f: _set(f, "input/K_next", lambda x: x * np.nan),
    "camera of four numbers": lambda f: _set(f, "input/K_ref", lambda x: x.ravel()[:4]),
    "soup of NaN": lambda f: _set(f, "solution/n", lambda x: x * np.nan),
    "soup of zeros": lambda f: _set(f, "solution/lam", lambda x: 0 * x),
    "soup too short": lambda f: _set(f, "solution/lam", lambda x: x[:-1]),
    "soup of rotations that are none": lambda f: _set(f, "solution/R", lambda x: 0 * x),
    "soup of text": lambda f: _set(f, "solution/d", lambda x: "word"),
    "negative components": lambda f: _set(f, "start/component", lambda x: x - 7),
    "components of floats": lambda f: _set(f, "start/component", lambda x: x + np.nan),
    "components too many": lambda f: _set(
        f, "start/component", lambda x: np.arange(len(x)) + 2**40
    ),
    "confidence of another size": lambda f: _set(f, "input/confidence", lambda x: x[:5]),
    "sigma of text": lambda f: _set(f, "depth/sigma_ref", lambda x: "word"),
    "sigma of another size": lambda f: _set(f, "depth/sigma_ref", lambda x: x[:5]),
    "sizes of zero": lambda f: _set(f, "segmentation/sizes", lambda x: 0 * x),
    "anchors too short": lambda f: _set(f, "segmentation/anchors", lambda x: x[:3]),
    "name of control characters": lambda f: f.attrs.__setitem__("name", "\x1b[31m\x07\n" * 50),
    "name of tags": lambda f: f.attrs.__setitem__("name", "</script><script>alert(1)</script>"),
    "scale of text": lambda f: f.attrs.__setitem__("scale_to_truth", "word"),
    "scale of a list": lambda f: f.attrs.__setitem__("scale_to_truth", [1.0, 2.0]),
    "scale of nothing": lambda f: f.attrs.__setitem__("scale_to_truth", 0.0),
    "no name": lambda f: f.attrs.__delitem__("name"),
    "no start": lambda f: f.__delitem__("start"),
    "no truth": lambda f: f.__delitem__("truth"),
    "no energy": lambda f: f.__delitem__("energy"),
    "no history": lambda f: [f.__delitem__(k) for k in ("history", "refine") if k in f],
}  # fmt: skip
"""Arrays of a result that do not belong together."""
ALL = "ply,glb,colmap,npy,pfm,png,rrd,motions"


def format_cases() -> Iterator[Case]:
    for name, damage in H5.items():
        for verb, more in (("convert", ("--to", ALL)), ("view", ("--renew", "--no-open"))):

            def odd(w: World, o: Path, damage=damage, verb=verb, more=more) -> list[str]:
                shutil.copytree(w.result, o / "copy")
                with h5py.File(o / "copy" / "result.h5", "a") as file:
                    damage(file)
                return [verb, str(o / "copy"), *more]

            yield Case("5 doors", f"{verb} h5 {name}", odd, (0, 2))
    for kind in NO_FOLDER:
        yield Case("5 doors", f"convert -o {kind}", lambda w, o, k=kind: [
            "convert", str(w.result), "--to", "npy", "-o", w.odd(k, ""),
        ])  # fmt: skip

    def beside(names: tuple[str, ...], to: str, *more: str, own: bool = False) -> Words:
        def words(w: World, o: Path) -> list[str]:
            target = shutil.copytree(w.result, o / "copy") if own else o
            for name in names:
                (target / name).parent.mkdir(exist_ok=True)
                (target / name).write_text("mine")
            return ["convert", str(target if own else w.result), "--to", to, *more,
                    *([] if own else ["-o", str(o)])]  # fmt: skip

        return words

    yield Case("1 lost", "convert over a mesh", beside(("mesh_ref.glb",), "glb"))
    yield Case("1 lost", "convert over COLMAP", beside(("colmap/notes.txt",), "colmap"), (0, 2))
    yield Case("1 lost", "convert over depth", beside(("depth_ref.npy",), "npy", own=True))
    yield Case("1 lost", "convert over a cloud", beside(("points_ref.ply",), "ply", own=True))
    yield Case("5 doors", "convert twice", beside((), "npy,npy,npy"), (0,))
    yield Case("5 doors", "convert an export", lambda w, o: [
        "convert", str(w.exported), "--to", "npy", "-o", str(o / "out"),
    ])  # fmt: skip
    yield Case("5 doors", "view an export", lambda w, o: ["view", str(w.exported), "--no-open"])
    for kind in ("pipe", "zero", "folder", "loop", "socket", "dangling"):

        def page(w: World, o: Path, kind=kind) -> list[str]:
            shutil.copytree(w.result, o / "copy")
            (o / "copy" / "report.html").unlink(missing_ok=True)
            ODD[kind](o / "copy" / "report.html")
            return ["view", str(o / "copy"), "--no-open"]

        yield Case("5 doors", f"view page {kind}", page, (0, 2))


# --- options of solve ----------------------------------------------------------------------------

half = np.full(SIZE, 0.5, np.float32)
MAPS: dict[str, Any] = {
    "of another size": half[:20], "of one number": half[0, 0], "above 1": half * 4,
    "below 0": -half, "of NaN": half * np.nan, "of infinity": half * np.inf,
    "of whole numbers": (half * 510).astype(np.uint8), "of truth values": half > 0,
    "complex": half.astype(complex), "of objects": np.full(SIZE, None),
    "of text": np.full(SIZE, "a"),
    "of colours": np.dstack([half] * 3), "zero": 0 * half, "turned": half.T,
}  # fmt: skip
"""Maps of confidence as .npy."""


def option_cases() -> Iterator[Case]:
    for name, value in MAPS.items():

        def confidence(w: World, o: Path, value=value) -> list[str]:
            np.save(o / "c.npy", value)
            return solve(w, o, **{"flow_confidence": str(o / "c.npy")})

        good = name in ("of truth values", "zero")
        solves = {"codes": (0, 1, 2), "solves": True} if good else {}
        yield Case("5 doors", f"confidence {name}", confidence, **solves)

        def backward(w: World, o: Path, value=value) -> list[str]:
            np.save(o / "b.npy", np.dstack([value, value]) if np.ndim(value) == 2 else value)
            return solve(w, o, **{"flow_backward": str(o / "b.npy")})

        free = name in ("above 1", "below 0", "of whole numbers", "of truth values", "zero")
        solves = (
            {"codes": (0, 1, 2), "solves": True} if free or "N" in name or "inf" in name else {}
        )
        yield Case("5 doors", f"backward {name}", backward, **solves)
    for kind in ODD:
        for option in ("flow_confidence", "flow_backward"):
            yield Case(
                "5 doors", f"{option} {kind}",
                lambda w, o, k=kind, x=option: solve(w, o, **{x: w.odd(k, ".npy")}),
            )  # fmt: skip
    for option in ("flow_confidence", "flow_backward"):
        yield Case(
            "5 doors", f"{option} without a flow",
            lambda w, o, x=option: [
                *solve(w, o, flow="dis", **{x: str(w.good("d.npy"))}),
            ],
        )  # fmt: skip
    for name in ("", "Paper", "../paper", "paper,paper", "[paper]", "{a: 1}", "\x1b[31m", "3", "~"):
        codes = (0,) if name == "~" else (2,)
        yield Case("5 doors", f"preset {name!r}", lambda w, o, n=name: [
            "show", str(w.good("p.yaml")), f"--preset={n}",
        ], codes)  # fmt: skip
        yield Case("5 doors", f"preset of a file {name!r}", lambda w, o, n=name: [
            "show", str(w.good("p.yaml")), "--set", f"preset={n}",
        ], (0,) if name in ("", "~") else (2,))  # fmt: skip
    for value in ("-0.1", "1.1", ".nan", "word", "[]", "null"):
        yield Case("2 numbers", f"min_confidence {value}", lambda w, o, v=value: [
            "show", str(w.good("p.yaml")), "--set", f"output.min_confidence={v}",
        ])  # fmt: skip
    for kind in NO_FOLDER:
        yield Case("5 doors", f"demo -o {kind}", lambda w, o, k=kind: ["demo", "-o", w.odd(k, "")])
    yield Case("5 doors", "json of an error", lambda w, o: solve(w, o, "--json", ref="no.png"))

    def tags(w: World, o: Path) -> None:
        """Names do not end the script of the page."""
        words = solve(w, o, "--set", "name=a</script><img src=x onerror=alert(1)>", "--json")
        text = io.StringIO()
        with redirect_stdout(text):
            assert main(words) in (0, 1, 2)
        page = o / "out" / "report.html"
        assert not page.exists() or "<img src=x" not in page.read_text()
        assert not text.getvalue() or isinstance(json.loads(text.getvalue()), dict)

    yield Case("6 untrusted", "name of tags", tags, quiet=True, solves=True)


def use_cases() -> Iterator[Case]:
    """All of these."""
    # two sizes of images are fine, and what nothing is read with is not looked at
    harmless = (
        "digits of other scripts", "auto of two frames alike", "images of two sizes",
    )  # fmt: skip
    for name, words in CHAINS.items():
        yield Case("5 doors", f"chain {name}", words, (0, 1, 2) if name in harmless else (2,))
    yield from family_cases()
    yield from format_cases()
    yield from option_cases()
