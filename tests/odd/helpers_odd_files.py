"""Arrays and images whose contents contradict their headers."""

import struct
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from helpers_odd_run import ANY, Case, cases, written
from helpers_odd_world import SIZE, encoded_noise, png

# --- arrays --------------------------------------------------------------------------------------


def npy(
    header: str | bytes, data: bytes = b"", version: int = 1, length: int | None = None
) -> bytes:
    """A .npy file with any header."""
    text = header.encode() if isinstance(header, str) else header
    code = struct.pack("<H" if version == 1 else "<I", len(text) if length is None else length)
    return b"\x93NUMPY" + bytes([version, 0]) + code + text + data


def _header(shape: object = "(2, 2)", kind: str = "'<f4'", version: int = 1) -> bytes:
    text = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}"
    return npy(text, b"\0" * 64, version)


LIES: dict[str, bytes] = {
    **{
        f"shape {shape}": _header(shape)
        for shape in (
            "(1000000, 1000000, 2)", "(1000000, 1000000)", "(9223372036854775807, 2)",
            f"({10**30}, 2)", "(-1, -1, 2)", "(48.0, 64.0, 2)", "()", "(0, 64, 2)", "(48, 64, 2)",
            "48", "None", "(True, True, 2)", "(" + "1, " * 60 + ")",
        )
    },
    **{
        f"dtype {kind}": _header(kind=kind)
        for kind in (
            "'|O'", "'<U1000000000'", "'|V2000000000'", "'<M8[s]'", "'<c16'", "'|b1'", "'f99'",
            "[('a', '<f4')]", "3", "'" + "x" * 9000 + "'",
        )
    },
    "no dictionary": npy("[1, 2]"),
    "code": npy("__import__('os').abort()"),
    "nested": npy("(" * 5000 + ")" * 5000),
    "header of 4 GB": npy("{}", version=2, length=2**32 - 1),
    "header cut": npy("{'descr'", length=60000),
    "version 3": _header("(2,)", version=3),
    "version 9": npy("{}", version=9),
    "magic only": b"\x93NUMPY",
    "pickle": b"\x80\x04\x95\x0b\0\0\0\0\0\0\0\x8c\x07builtin.",
    "zip": b"PK\x03\x04" + b"\0" * 60,
}  # fmt: skip
"""Contents of .npy files with wrong headers."""


def array_cases() -> Iterator[Case]:
    for door in ("flow", "depth"):
        line = f"{{solve}} --{door} {{x}}"
        yield from cases(f"npy {door} {{}}", line, LIES, make=written("x.npy"))
    for option in ("confidence", "backward"):
        line = f"{{solve}} --flow dis --flow-{option} {{d}}"
        yield from cases(f"flow_{option} {{}}", line, ["without a flow"])
    yield from cases("json of {}", "solve no.png {b} --json -o {out}", ["an error"])


# --- images --------------------------------------------------------------------------------------


def _jpg() -> bytes:
    text = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    at = text.index(b"\xff\xc0")
    text[at + 5 : at + 9] = struct.pack(">HH", 65000, 65000)
    return bytes(text)


BMP = struct.pack("<IHHIIiiHHIIiiII", 154, 0, 0, 54, 40, 30000, 30000, 1, 24, 0, 0, 0, 0, 0, 0)
IMAGES: dict[str, Callable[[], bytes]] = {
    "header png": lambda: png(60000, 60000),
    "header png rows": lambda: png(2**31 - 1, 2**31 - 1),
    "header pgm": lambda: b"P5\n40000 40000\n255\n" + b"\0" * 100,
    "header bmp": lambda: b"BM" + BMP + b"\0" * 100,
    "header jpg": _jpg,
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


def image_cases() -> Iterator[Case]:
    tiffs = dict.fromkeys(("float tiff", "float64 tiff"), ANY)
    for doors, line in {
        "ref": "solve {x} {b} --flow {f} --intrinsics {camera} {tiny} -q -o {out}",
        "next": "solve {a} {x} --flow {f} --intrinsics {camera} {tiny} -q -o {out}",
        "ref and next": "solve {x} {x} --intrinsics {camera} {tiny} -q -o {out}",
    }.items():
        title, make = f"image {{}} as {doors}", written("x.png")
        yield from cases(title, line, IMAGES, make=make, other=tiffs)
