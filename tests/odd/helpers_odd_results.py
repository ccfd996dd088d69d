"""Results whose parts do not belong together, sequences without an answer."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from helpers_odd_run import ANY, Case, cases, changed, h5_damage, words
from helpers_odd_world import SIZE, World, encoded_noise


def _put(name: str, value: Any) -> Callable[[h5py.File], None]:
    """Adds or replaces an array of a result."""

    def damage(file: h5py.File) -> None:
        if name in file:
            del file[name]
        file[name] = value(file) if callable(value) else value

    return damage


def _with(name: str, change: Callable[[Any], Any]) -> Callable[[h5py.File], None]:
    """Changes the values of an array of a result."""
    return lambda file: _put(name, change(file[name][()]))(file)


def _attribute(name: str, value: Any) -> Callable[[h5py.File], None]:
    return lambda file: file.attrs.__setitem__(name, value)


def _without(*names: str) -> Callable[[h5py.File], object]:
    return lambda file: [file.__delitem__(name) for name in names if name in file]


def _huge(file: h5py.File) -> None:
    del file["depth/ref"]
    file.create_dataset("depth/ref", (10**6, 10**7), "f8", chunks=(1000, 1000))


def _wide(file: h5py.File) -> None:
    for k in range(2):
        file.create_dataset(f"extra{k}", (10**5, 10**5), "f8", chunks=(1000, 1000))


def _deep(group: h5py.Group) -> None:
    for _ in range(1100):
        group = group.create_group("g")


STRUCTURE: dict[str, Callable[[h5py.File], object]] = {
    "cycle": _put("depth/again", lambda f: f["/"]),
    "soft cycle": _put("round", h5py.SoftLink("/round")),
    "soft link up": _put("depth/up", h5py.SoftLink("/")),
    "soft link dangling": _put("depth/ref", h5py.SoftLink("/nowhere")),
    "external link": _put("depth/ref", h5py.ExternalLink("/etc/passwd", "/x")),
    "external link of a group": _put("other", h5py.ExternalLink("other.h5", "/")),
    "external link to itself": _put("me", h5py.ExternalLink("result.h5", "/")),
    "huge dataset": _huge,
    "many huge datasets": _wide,
    "deep groups": _deep,
    "named type": _put("kind", np.dtype("f8")),
    "named type in place": _put("depth/ref", np.dtype("f8")),
    "empty dataset": _put("depth/ref", h5py.Empty("f8")),
    "text for numbers": _put("depth/ref", "text"),
    "compound": _put("depth/ref", np.zeros(3, [("a", "f8")])),
    "reference": _put("depth/ref", lambda f: np.array([f["depth"].ref], h5py.ref_dtype)),
    "vlen": lambda f: f.create_dataset("ragged", (2,), h5py.vlen_dtype("f8")),
    "complex": _put("depth/ref", np.zeros((4, 4), complex)),
    "group for array": lambda f: (f.__delitem__("depth/ref"), f.create_group("depth/ref")),
    "array for group": _put("depth", 1.0),
    "no depth": _without("depth"),
    "latin text": _put("word", np.array([b"\xe9\xff"], h5py.string_dtype("utf-8"))),
    "attribute broken YAML": _attribute("config", "a: [1"),
    "attribute deep YAML": _attribute("config", "[" * 20_000),
    "attribute YAML word": _attribute("config", "word"),
    "attribute binary": _attribute("config", np.void(b"\xff\xfe")),
    "attribute broken JSON": _attribute("versions", "{"),
    "attribute deep JSON": _attribute("versions", "[" * 30_000),
    "attribute reference": lambda f: f.attrs.__setitem__("config", f["depth"].ref),
    "attribute missing": lambda f: f.attrs.__delitem__("config"),
}
"""Damages of the structure of a result."""
NO_DEPTH = (
    "huge dataset", "external link", "soft link dangling", "text for numbers", "compound",
    "empty dataset",
)  # fmt: skip
"""Damages without which there is no depth."""

CONTENTS: dict[str, Callable[[h5py.File], object]] = {
    "negative labels": _with("segmentation/labels", lambda x: x - 5),
    "labels beyond": _with("segmentation/labels", lambda x: x + 10**6),
    "labels of floats": _with("segmentation/labels", lambda x: x + 0.5),
    "labels of one row": _with("segmentation/labels", lambda x: x[0]),
    "images of one channel": _with("input/image_ref", lambda x: x[..., 0]),
    "images of four channels": _with("input/image_ref", lambda x: x[..., [0, 1, 2, 0]]),
    "images of floats": _with("input/image_ref", lambda x: x / 255.0),
    "image of no pixel": _with("input/image_next", lambda x: x[:0]),
    "image of another size": _with("input/image_ref", lambda x: x[:20]),
    "singular camera": _with("input/K_ref", lambda x: 0 * x),
    "camera of NaN": _with("input/K_next", lambda x: x * np.nan),
    "camera of four numbers": _with("input/K_ref", lambda x: x.ravel()[:4]),
    "soup of NaN": _with("solution/n", lambda x: x * np.nan),
    "soup of zeros": _with("solution/lam", lambda x: 0 * x),
    "soup too short": _with("solution/lam", lambda x: x[:-1]),
    "soup of rotations that are none": _with("solution/R", lambda x: 0 * x),
    "soup of text": _put("solution/d", "word"),
    "negative components": _with("start/component", lambda x: x - 7),
    "components of floats": _with("start/component", lambda x: x + np.nan),
    "components too many": _with("start/component", lambda x: np.arange(len(x)) + 2**40),
    "confidence of another size": _with("input/confidence", lambda x: x[:5]),
    "sigma of text": _put("depth/sigma_ref", "word"),
    "sigma of another size": _with("depth/sigma_ref", lambda x: x[:5]),
    "sizes of zero": _with("segmentation/sizes", lambda x: 0 * x),
    "anchors too short": _with("segmentation/anchors", lambda x: x[:3]),
    "name of control characters": _attribute("name", "\x1b[31m\x07\n" * 50),
    "name of tags": _attribute("name", "</script><script>alert(1)</script>"),
    "no name": lambda f: f.attrs.__delitem__("name"),
    "no start": _without("start"),
    "no truth": _without("truth"),
    "no energy": _without("energy"),
    "no history": _without("history", "refine"),
}
"""Arrays of a result that do not belong together."""


def _flip(path: Path, where: str) -> None:
    """Invert 3,000 bytes."""
    data = bytearray(path.read_bytes())
    at = {"start": 0, "middle": len(data) // 2, "end": len(data) - 4000}[where]
    data[at : at + 3000] = bytes(255 - b for b in data[at : at + 3000])
    path.write_bytes(data)


def result_cases() -> Iterator[Case]:
    broken = changed("result", "result.h5", h5_damage)
    certain = dict.fromkeys(NO_DEPTH, (2,))
    # with the attributes changed, a check may end in any way but a crash
    unsure = [name for name in STRUCTURE if name.startswith("attribute")]
    for verb, line, codes, other in (
        ("check", "check {x}", (2, 1), dict.fromkeys(unsure, ANY) | certain),
        ("evaluate", "evaluate {x} --depth {d}", ANY, certain),
    ):
        title = f"h5 {verb} {{}}"
        yield from cases(title, line, STRUCTURE, codes, make=broken, other=other)
        flip = changed("result", "result.h5", _flip)
        ends = ("start", "middle", "end")
        yield from cases(f"h5 {verb} flipped {{}}", line, ends, ANY, make=flip)
    formats = "ply,glb,colmap,npy,pfm,rrd,masks,flow,transforms,kitti,tum"
    for line in (f"convert {{x}} --to {formats}", "view {x} --renew --no-open"):
        title = f"{line.split()[0]} h5 {{}}"
        yield from cases(title, line, CONTENTS, (0, 2), make=broken)
    yield from cases("convert {}", "convert {exported} --to npy -o {out}", ["an export"])
    yield from cases("convert {}", "convert {result} --to npy,npy -o {o}", ["twice"], (0,))
    yield from cases("view {}", "view {exported} --no-open", ["an export"])


# --- sequences -----------------------------------------------------------------------------------


def clip(*names: str, sizes: tuple[tuple[int, int], ...] = (SIZE,), options: str = "") -> Any:
    """`chain` of a folder of noise images; `sizes` repeat over the images."""

    def do(w: World, o: Path, _: object = None) -> list[str]:
        (o / "clip").mkdir(exist_ok=True)
        for k, name in enumerate(names or ("frame_0.png", "frame_1.png")):
            (o / "clip" / name).write_bytes(encoded_noise(sizes[k % len(sizes)]))
        return words(f"chain {{o}}/clip {{tiny}} {options} -q -o {{out}}", w, o)

    return do


def beside(name: str, make: Callable[[Path], object]) -> Any:
    """`chain` of a folder of frames beside an odd file."""

    def do(w: World, o: Path, _: object) -> list[str]:
        line = clip()(w, o)
        make(o / "clip" / name)
        return line

    return do


CHAIN = "chain {a} {b} {tiny} -q -o {out}"
CHAINS: dict[str, Any] = {
    "stride of 5001 digits": f"{CHAIN} --stride=1{'0' * 5000}",
    "one image": "chain {a} {tiny} -q -o {out}",
    "one frame of a folder": clip(options="--stride=3"),
    "two cameras": f"{CHAIN} --intrinsics={{camera}} --fov=50",
    "other input": f"{CHAIN} --set input.kind=scene",
    "memory": f"{CHAIN} --set input.kind=memory --set input.hash=x",
    "scene twice": "chain scene:street scene:room -o {out}",
    "scene and image": "chain scene:street a.png -q -o {out}",
    "scene with stride": "chain scene:orbit --stride=2 -o {out}",
    "scene with camera": "chain scene:orbit --fov=50 -o {out}",
    "images of two sizes": clip(sizes=(SIZE, (48, 80))),
    "images too small": clip(sizes=((2, 2),)),
    "superscripts": clip("1²3.png", "1²4.png", options="--fov=400"),
    "images that are folders": beside("frame_1.png", lambda p: (p.unlink(), p.mkdir())),
    "camera is a folder": beside("K.txt", Path.mkdir),
    "camera is a pipe": beside("K.txt", os.mkfifo),
    "camera is binary": beside("K.txt", lambda p: p.write_bytes(bytes(range(256)))),
    "camera of three numbers": beside("K.txt", lambda p: p.write_text("1 2 3")),
    "camera of NaN": beside("K.txt", lambda p: p.write_text("nan 60 32 24")),
    "dangling frame": beside("frame_2.png", lambda p: p.symlink_to("nowhere")),
    "pipe among frames": beside("frame_2.png", os.mkfifo),
    "text among frames": beside("frame_2.png", lambda p: p.write_text("no picture")),
}
"""Sequences that cannot be solved."""
SOURCES = (
    "scene:", "scene:nothing", "scene:../street", "scene:street ", "scene:\x1b[31m", "",
    "/dev", "a**b/*.png", "[", "[!]", "no/such/*.png", "http://localhost:1/a.mp4",
    "*" * 300, "rtsp://localhost:1/x.mov",
)  # fmt: skip


def chain_cases() -> Iterator[Case]:
    # two sizes of images are allowed
    yield from cases("chain {}", None, CHAINS, other={"images of two sizes": ANY})
    yield from cases("chain source {}", "chain {x} -q -o {out}", SOURCES)
    empty = lambda w, o, _: (o / "clip").mkdir()  # noqa: E731
    line = "chain {o}/clip -q -o {out}"
    yield from cases("chain {}", line, ["no images"], make=empty)
