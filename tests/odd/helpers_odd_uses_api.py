"""Odd arguments of runs, results, chains, exports and of pictures that come with a camera."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from helpers_odd_api import THINGS
from helpers_odd_run import Case
from helpers_odd_world import SIZE, World
from PIL import ExifTags, Image

import soup_nlp
from soup_nlp.cli.main import main
from soup_nlp.export.foreign import import_sol
from soup_nlp.export.sol import read_sol
from soup_nlp.report.check import check_folder
from soup_nlp.report.result import load
from soup_nlp.sequence.chain import make_chain
from soup_nlp.sequence.frames import find_images, video_frames

STREET = {"input": {"kind": "scene", "scene": "street"}}
Call = Callable[[World, Path, Any], Any]
CALLS: dict[str, Call] = {
    "save folder": lambda w, o, x: w.run.save(x),
    "save formats": lambda w, o, x: w.run.save(o / "out", formats=x),
    "save format": lambda w, o, x: w.run.save(o / "out", formats=[x]),
    "check_folder": lambda w, o, x: check_folder(x),
    "load": lambda w, o, x: load(x),
    "make_chain": lambda w, o, x: make_chain(x),
    "make_chain pair": lambda w, o, x: make_chain([x]),
    "find_images": lambda w, o, x: find_images(x),
    "video_frames": lambda w, o, x: video_frames(x, o / "frames"),
    "read_sol": lambda w, o, x: read_sol(x, np.arange(2), np.arange(2)),
    "import_sol folder": lambda w, o, x: import_sol(x, w.exported / "soup.sol"),
    "import_sol file": lambda w, o, x: import_sol(w.exported, x),
    "solve_pair preset": lambda w, o, x: soup_nlp.solve_pair(w.run.pair, preset=x),
    "solve_pair flow": lambda w, o, x: soup_nlp.solve_pair(w.run.pair, flow=x),
    **{
        f"run {name}": lambda w, o, x, n=name: soup_nlp.run(w.run.problem, **{n: x})
        for name in ("listener", "stop", "log", "on_stage", "ipopt_log")
    },
    "make_problem overrides": lambda w, o, x: soup_nlp.make_problem(STREET, x),
    "make_problem where": lambda w, o, x: soup_nlp.make_problem(STREET, where=x),
    "with_flow": lambda w, o, x: w.run.pair.with_flow(x),
    "evaluate depth_scale": lambda w, o, x: soup_nlp.evaluate(
        w.result, depth_png(o), depth_scale=x
    ),
    "components": lambda w, o, x: w.run.components[x],
    "own_motion": lambda w, o, x: w.run.components.own_motion(x),
    "camera": lambda w, o, x: w.run.camera(x),
    "make_problem preset": lambda w, o, x: soup_nlp.make_problem(STREET | {"preset": x}),
}
FINE = {
    ("save formats", "None"),
    ("make_problem preset", "None"),
    ("save formats", "list"),
    ("save formats", "dict"),
    ("make_problem overrides", "list"),
    ("make_problem where", "text"),
    ("with_flow", "None"),
    ("evaluate depth_scale", "int"),
    ("evaluate depth_scale", "None"),
    ("camera", "vector"),
    ("camera", "image"),
}
"""Arguments that are right, or of no use but harmless."""
SOLVES = {("solve_pair preset", "None"), ("solve_pair flow", "None"), ("solve_pair flow", "dict")}
SOLVES |= {(f"run {n}", "None") for n in ("listener", "stop", "log", "on_stage", "ipopt_log")}
WRITES = {("save folder", "text"), ("run ipopt_log", "text")}
"""Right names of files, in the working folder."""
CALLABLE = {(f"run {n}", k) for n in ("listener", "log", "on_stage") for k in ("type", "function")}
"""What the caller's own function raises is his."""


def depth_png(o: Path) -> Path:
    """A depth map of 16 bits."""
    Image.fromarray(np.full(SIZE, 2000, np.uint16)).save(o / "d.png")
    return o / "d.png"


def call_cases() -> Iterator[Case]:
    for name, call in CALLS.items():
        for what, thing in THINGS.items():
            if (name, what) in SOLVES | WRITES | CALLABLE:
                continue

            def do(w: World, o: Path, call=call, thing=thing) -> None:
                call(w, o, thing)

            yield Case("5 Python API", f"api {name} {what}", do, quiet=(name, what) in FINE)


# --- pictures that say where they were taken -----------------------------------------------------

FOCAL, SHOWN = ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.Orientation
LENGTH, ACROSS = ExifTags.Base.FocalLength, ExifTags.Base.FocalPlaneXResolution
UNIT, WIDTH = ExifTags.Base.FocalPlaneResolutionUnit, ExifTags.Base.ExifImageWidth
EXIF: dict[str, dict[int, Any]] = {
    **{f"orientation {k}": {SHOWN: k} for k in (0, 9, 65535)},
    **{f"focal {k}": {FOCAL: k} for k in (0, 65535)},
    "length of 0": {LENGTH: (0, 1), ACROSS: (1000, 1)},
    "length of 1 / 0": {LENGTH: (1, 0), ACROSS: (1000, 1)},
    "resolution of 0 / 0": {LENGTH: (50, 1), ACROSS: (0, 0)},
    "unit of 99": {LENGTH: (50, 1), ACROSS: (1000, 1), UNIT: 99},
    "width of 0": {LENGTH: (50, 1), ACROSS: (1000, 1), WIDTH: 0},
    "huge width": {LENGTH: (50, 1), ACROSS: (1000, 1), WIDTH: 2**32 - 1},
    "text": {0x9286: b"\xff\xfe" * 3000, FOCAL: 40},
}


def exif_cases() -> Iterator[Case]:
    for name, tags in EXIF.items():

        def photo(w: World, o: Path, tags=tags) -> list[str]:
            for word in "ab":
                with Image.open(w.good(f"{word}.png")) as image:
                    own = image.getexif()
                    own.update({k: v for k, v in tags.items() if k == SHOWN})
                    inner = {k: v for k, v in tags.items() if k != SHOWN}
                    own.get_ifd(ExifTags.IFD.Exif).update(inner)
                    image.save(o / f"{word}.jpg", exif=own)
            return unsolved(o)

        yield Case("5 doors", f"exif {name}", photo)
    for name, data in {
        "cut": b"Exif\0\0II*\0",
        "empty": b"Exif\0\0",
        "loop": b"Exif\0\0II*\0\x08\0\0\0" + struct.pack("<H", 0) + struct.pack("<I", 8),
        "far": b"Exif\0\0II*\0\xff\xff\xff\x7f",
        "many": b"Exif\0\0II*\0\x08\0\0\0\xff\xff" + b"\x69\x87\x04\0\x01\0\0\0\x08\0\0\0" * 9,
        "noise": bytes(range(256)) * 9,
    }.items():

        def raw(w: World, o: Path, data=data) -> list[str]:
            for word in "ab":
                with Image.open(w.good(f"{word}.png")) as image:
                    image.save(o / f"{word}.jpg", exif=data)
            return unsolved(o)

        yield Case("5 doors", f"exif bytes {name}", raw)


def unsolved(o: Path) -> list[str]:
    """Pictures that are read, and a flow that is not there."""
    names = ["--ref", str(o / "a.jpg"), "--next", str(o / "b.jpg")]
    return ["solve", *names, "--flow", "nothing.flo", "-o", str(o / "out"), "-q"]


# --- networks ------------------------------------------------------------------------------------


def network(path: Path, kind: str) -> None:
    """An ONNX file that is no flow."""
    import onnx
    from onnx import TensorProto, helper

    shape: list[Any] = [1, 6, "h", "w"]
    element, ops, out = TensorProto.FLOAT, [], [1, 2, "h", "w"]
    start = helper.make_tensor("s", TensorProto.INT64, [1], [0])
    end = helper.make_tensor("e", TensorProto.INT64, [1], [2])
    axis = helper.make_tensor("x", TensorProto.INT64, [1], [1])
    first = [helper.make_node("Slice", ["in", "s", "e", "x"], ["two"])]
    last = "two"
    if kind == "five channels":
        shape = [1, 5, "h", "w"]
    if kind == "three axes":
        shape = [1, 6, "n"]
    if kind == "NaN":
        ops, last = [helper.make_node("Log", ["neg"], ["o"])], "o"
        first.append(helper.make_node("Mul", ["two", "minus"], ["neg"]))
    if kind == "infinite":
        ops, last = [helper.make_node("Div", ["two", "null"], ["o"])], "o"
    if kind == "one channel":
        end, out = helper.make_tensor("e", TensorProto.INT64, [1], [1]), [1, 1, "h", "w"]
    if kind == "no pixel":
        axis = helper.make_tensor("x", TensorProto.INT64, [1], [2])
        end, out = helper.make_tensor("e", TensorProto.INT64, [1], [0]), None
    if kind == "whole numbers":
        ops, last = [helper.make_node("Cast", ["two"], ["o"], to=TensorProto.INT32)], "o"
        element = TensorProto.INT32
    numbers = [
        helper.make_tensor("minus", TensorProto.FLOAT, [1], [-1.0]),
        helper.make_tensor("null", TensorProto.FLOAT, [1], [0.0]),
    ]
    given = helper.make_tensor_value_info("in", TensorProto.FLOAT, shape)
    found = helper.make_tensor_value_info(last, element, out)
    graph = helper.make_graph([*first, *ops], "g", [given], [found], [start, end, axis, *numbers])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if kind == "unknown range":
        model.metadata_props.add(key="input_range", value="\x1b[31m" * 2000)
    if kind == "elsewhere":
        tensor = model.graph.initializer[0]
        tensor.ClearField("int64_data")
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="../../../../etc/passwd")
    onnx.save(model, path)


NETWORKS = (
    "five channels", "three axes", "NaN", "infinite", "one channel", "no pixel", "whole numbers",
    "unknown range", "elsewhere",
)  # fmt: skip


def network_cases() -> Iterator[Case]:
    for kind in NETWORKS:

        def do(w: World, o: Path, kind=kind) -> list[str] | None:
            try:
                network(o / "n.onnx", kind)
            except ImportError:
                return ["solve", "no.yaml"]
            from helpers_odd_world import solve

            return solve(w, o, flow=str(o / "n.onnx"))

        free = kind in ("NaN", "infinite", "whole numbers")
        codes = (0, 1, 2) if free else (2,)
        yield Case("5 doors", f"network {kind}", do, codes, solves=free)


def run_cases() -> Iterator[Case]:
    """Uses of a run, a result and a chain that are no command."""

    def quiet(name: str, call: Callable[[World, Path], object]) -> Case:
        def do(w: World, o: Path) -> None:
            call(w, o)

        return Case("5 Python API", f"use {name}", do, quiet=True)

    yield quiet("plot", lambda w, o: w.run.plot().savefig(o / "a.png"))
    yield quiet("repr", lambda w, o: [repr(x) for x in (w.run, w.run.components, w.run.camera)])
    yield quiet("save twice", lambda w, o: [w.run.save(o / "out") for _ in range(2)])

    def again(w: World, o: Path) -> None:
        w.run.save(o / "out", formats=["npy"])
        assert main(["check", str(o / "out")]) in (0, 1)

    yield quiet("save and check", again)

    def strided(w: World, o: Path) -> None:
        """Views that are not contiguous, read-only arrays and other byte orders are arrays."""
        a, b = (np.asarray(x) for x in (w.run.pair.image_ref, w.run.pair.image_next))
        K = np.asarray(w.run.pair.K_ref, ">f8")
        pair = soup_nlp.Pair(a[:, ::-1], np.asfortranarray(b), K)
        a.flags.writeable = False
        flow = soup_nlp.Flow(np.zeros((*SIZE, 2), ">f4"), np.ones(SIZE, np.float16))
        pair.with_flow(flow)

    yield quiet("arrays of other layouts", strided)
    yield quiet("compare records", lambda w, o: w.run.pair == w.run.pair.with_flow(w.run.pair.flow))
    yield quiet(
        "hash of records", lambda w, o: {w.run, w.run.pair, w.run.soup, w.run.reconstruction}
    )
    huge = np.full(SIZE, 1e300)
    own = "truth that overflows"
    yield Case("5 Python API", own, lambda w, o: (soup_nlp.Truth(depth_ref=huge), None)[1])


def use_api_cases() -> Iterator[Case]:
    """All of these."""
    yield from call_cases()
    yield from exif_cases()
    yield from network_cases()
    yield from run_cases()
