"""Files that hold something else than they say: arrays, images, HDF5."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from helpers_odd_run import Case
from helpers_odd_world import SIZE, World, encoded_noise, npy, png, solve

HEADER = "{{'descr': {}, 'fortran_order': {}, 'shape': {}, }}"
LIES: dict[str, bytes] = {
    **{
        f"shape {shape}": npy(HEADER.format("'<f4'", False, shape), b"\0" * 64)
        for shape in (
            "(1000000, 1000000, 2)",
            "(1000000, 1000000)",
            "(9223372036854775807, 2)",
            f"({10**30}, 2)",
            "(-1, -1, 2)",
            "(48.0, 64.0, 2)",
            "()",
            "(0, 64, 2)",
            "(48, 64, 2)",
            "48",
            "None",
            "(True, True, 2)",
            "(" + "1, " * 60 + ")",
        )
    },
    **{
        f"dtype {kind}": npy(HEADER.format(kind, False, "(2, 2)"), b"\0" * 64)
        for kind in (
            "'|O'",
            "'<U1000000000'",
            "'|V2000000000'",
            "'<M8[s]'",
            "'<c16'",
            "'|b1'",
            "'f99'",
            "[('a', '<f4')]",
            "3",
            "'" + "x" * 9000 + "'",
        )
    },
    "no dictionary": npy("[1, 2]"),
    "code": npy("__import__('os').abort()"),
    "nested": npy("(" * 5000 + ")" * 5000),
    "header of 4 GB": npy("{}", version=2, length=2**32 - 1),
    "header cut": npy("{'descr'", length=60000),
    "version 3": npy(HEADER.format("'<f4'", False, "(2,)"), version=3),
    "version 9": npy("{}", version=9),
    "magic only": b"\x93NUMPY",
    "pickle": b"\x80\x04\x95\x0b\0\0\0\0\0\0\0\x8c\x07builtin.",
    "zip": b"PK\x03\x04" + b"\0" * 60,
}
"""Contents of .npy files that say something else than they hold."""


def huge_header(kind: str) -> bytes:
    """Headers that claim images of enormous size."""
    if kind == "png":
        return png(60000, 60000)
    if kind == "png rows":
        return png(2**31 - 1, 2**31 - 1)
    if kind == "pgm":
        return b"P5\n40000 40000\n255\n" + b"\0" * 100
    if kind == "bmp":
        return (
            b"BM"
            + struct.pack(
                "<IHHIIiiHHIIiiII", 154, 0, 0, 54, 40, 30000, 30000, 1, 24, 0, 0, 0, 0, 0, 0
            )
            + b"\0" * 100
        )
    ok, data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))
    assert ok
    text = bytearray(data.tobytes())
    at = text.index(b"\xff\xc0")
    text[at + 5 : at + 9] = struct.pack(">HH", 65000, 65000)
    return bytes(text)


IMAGES: dict[str, Callable[[], bytes]] = {
    **{f"header {k}": lambda k=k: huge_header(k) for k in ("png", "png rows", "pgm", "bmp", "jpg")},
    "tall": lambda: encoded_noise((5000, 16)),
    "wide": lambda: encoded_noise((16, 5000)),
    "one colour 20000": lambda: png(20000, 20000, 1, 0, b"\0" * 2501 * 20000),
    "one colour 9000": lambda: png(9000, 9000, 1, 0, b"\0" * 1126 * 9000),
    "1 x 1": lambda: encoded_noise((1, 1)),
    "8 x 8": lambda: encoded_noise((8, 8)),
    "png rows missing": lambda: png(64, 48),
    "png without size": lambda: png(0, 0),
    "gif": lambda: b"GIF89a" + struct.pack("<HH", 65535, 65535) + b"\0\0\0;",
    "svg": lambda: b'<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"/>',
    "float tiff": lambda: encoded_noise(SIZE, ".tiff", np.float32),
    "float64 tiff": lambda: encoded_noise(SIZE, ".tiff", np.float64),
}


def content_cases() -> Iterator[Case]:
    for name, data in LIES.items():
        for door in ("flow", "depth"):

            def lie(w: World, o: Path, data=data, door=door) -> list[str]:
                (o / "x.npy").write_bytes(data)
                return solve(w, o, **{door: str(o / "x.npy")})

            yield Case("5 doors", f"npy {door} {name}", lie)
    for name, make in IMAGES.items():
        for doors in (("ref",), ("next",), ("ref", "next")):

            def picture(w: World, o: Path, make=make, doors=doors) -> list[str]:
                path = w.root / "odd" / f"image {name_of(make)}"
                path.parent.mkdir(exist_ok=True)
                if not path.exists():
                    path.write_bytes(make())
                changes = dict.fromkeys(doors, str(path))
                words = solve(w, o, **changes)
                at = words.index("--flow")
                return [*words[:at], *words[at + 2 :]] if len(doors) == 2 else words

            def name_of(_: object, name=name) -> str:
                return f"{name}.png"

            codes = (0, 1, 2) if name.startswith("float") else (2,)
            yield Case("4 endless", f"image {name} as {' and '.join(doors)}", picture, codes)


def _replace(file: h5py.File, name: str, value: Any) -> None:
    del file[name]
    file[name] = value


def _huge(file: h5py.File) -> None:
    del file["depth/ref"]
    file.create_dataset("depth/ref", (10**6, 10**7), "f8", chunks=(1000, 1000))


def _wide(file: h5py.File) -> None:
    for k in range(2):
        file.create_dataset(f"extra{k}", (10**5, 10**5), "f8", chunks=(1000, 1000))


def _deep(file: h5py.File) -> None:
    group = file
    for _ in range(3000):
        group = group.create_group("g")


H5: dict[str, Callable[[h5py.File], None]] = {
    "cycle": lambda f: (
        _replace(f, "depth/again", f["/"])
        if "depth/again" in f
        else f["depth"].__setitem__("again", f["/"])
    ),
    "soft cycle": lambda f: f.__setitem__("round", h5py.SoftLink("/round")),
    "soft link up": lambda f: f["depth"].__setitem__("up", h5py.SoftLink("/")),
    "soft link dangling": lambda f: _replace(f, "depth/ref", h5py.SoftLink("/nowhere")),
    "external link": lambda f: _replace(f, "depth/ref", h5py.ExternalLink("/etc/passwd", "/x")),
    "external link of a group": lambda f: f.__setitem__(
        "other", h5py.ExternalLink("other.h5", "/")
    ),
    "external link to itself": lambda f: f.__setitem__("me", h5py.ExternalLink("result.h5", "/")),
    "huge dataset": _huge,
    "many huge datasets": _wide,
    "deep groups": _deep,
    "named type": lambda f: f.__setitem__("kind", np.dtype("f8")),
    "named type in place": lambda f: _replace(f, "depth/ref", np.dtype("f8")),
    "empty dataset": lambda f: _replace(f, "depth/ref", h5py.Empty("f8")),
    "text for numbers": lambda f: _replace(f, "depth/ref", "text"),
    "compound": lambda f: _replace(f, "depth/ref", np.zeros(3, [("a", "f8")])),
    "reference": lambda f: _replace(f, "depth/ref", np.array([f["depth"].ref], h5py.ref_dtype)),
    "vlen": lambda f: f.create_dataset("ragged", (2,), h5py.vlen_dtype("f8")),
    "complex": lambda f: _replace(f, "depth/ref", np.zeros((4, 4), complex)),
    "group for array": lambda f: (f.__delitem__("depth/ref"), f.create_group("depth/ref")),
    "array for group": lambda f: (f.__delitem__("depth"), f.__setitem__("depth", 1.0)),
    "no depth": lambda f: f.__delitem__("depth"),
    "latin text": lambda f: f.__setitem__(
        "word", np.array([b"\xe9\xff"], h5py.string_dtype("utf-8"))
    ),
    "attribute broken YAML": lambda f: f.attrs.__setitem__("config", "a: [1"),
    "attribute deep YAML": lambda f: f.attrs.__setitem__("config", "[" * 20_000),
    "attribute YAML word": lambda f: f.attrs.__setitem__("config", "word"),
    "attribute binary": lambda f: f.attrs.__setitem__("config", np.void(b"\xff\xfe")),
    "attribute broken JSON": lambda f: f.attrs.__setitem__("versions", "{"),
    "attribute deep JSON": lambda f: f.attrs.__setitem__("versions", "[" * 30_000),
    "attribute reference": lambda f: f.attrs.__setitem__("config", f["depth"].ref),
    "attribute missing": lambda f: f.attrs.__delitem__("config"),
}

HARMLESS = ("named type", "vlen", "attribute", "reference")
"""Begin of names of damages that a reader of the depth need not notice."""


def h5_cases() -> Iterator[Case]:
    for name, damage in H5.items():
        for verb in ("check", "evaluate"):

            def broken(w: World, o: Path, name=name, damage=damage, verb=verb) -> list[str]:
                copy = w.root / "copies" / name
                if not copy.exists():
                    with h5py.File(w.copy("result", name) / "result.h5", "a") as file:
                        damage(file)
                return [
                    verb,
                    str(copy),
                    *(["--depth", str(w.good("d.npy"))] if verb == "evaluate" else []),
                ]

            codes = (0, 1, 2) if verb == "evaluate" or name.startswith("attribute") else (2, 1)
            if name in (
                "vlen",
                "named type",
                "latin text",
                "soft link up",
                "attribute broken JSON",
                "attribute deep JSON",
            ):
                codes = (0, 1, 2)
            if name in (
                "huge dataset",
                "external link",
                "soft link dangling",
                "text for numbers",
                "compound",
                "empty dataset",
            ):
                codes = (2,)
            yield Case(
                "4 endless" if "cycle" in name or "link" in name else "5 doors",
                f"h5 {verb} {name}",
                broken,
                codes,
            )
    for where in ("start", "middle", "end"):
        for verb in ("check", "evaluate"):

            def flipped(w: World, o: Path, where=where, verb=verb) -> list[str]:
                copy = w.root / "copies" / f"flipped {where}"
                if not copy.exists():
                    path = w.copy("result", copy.name) / "result.h5"
                    data = bytearray(path.read_bytes())
                    at = {"start": 0, "middle": len(data) // 2, "end": len(data) - 4000}[where]
                    data[at : at + 3000] = bytes(255 - b for b in data[at : at + 3000])
                    path.write_bytes(data)
                return [
                    verb,
                    str(copy),
                    *(["--depth", str(w.good("d.npy"))] if verb == "evaluate" else []),
                ]

            yield Case("5 doors", f"h5 {verb} flipped {where}", flipped, (0, 1, 2))
