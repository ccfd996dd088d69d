"""A tiny pair with its result and export, and names of files that no reader should trust."""

import os
import socket
import struct
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import yaml

from soup_nlp.cli.main import main

SIZE = (48, 64)
"""Height and width of the tiny images."""
CAMERA = "60,60,32,24"
TINY = {
    "segmentation.superpixels": 12,
    "segmentation.method": "grid",
    "segmentation.neighbours": 4,
    "refine.enabled": False,
    "solver.presolve_iterations": 0,
    "solver.max_iter": 2,
}
"""Settings with which a solve ends in a fraction of a second, mostly not converged."""
SET = [word for key, value in TINY.items() for word in ("--set", f"{key}={value}".lower())]


@dataclass
class World:
    """Good files, made when they are first asked for, and a folder for odd ones."""

    root: Path

    def good(self, name: str) -> Path:
        """A good file: a.png, b.png, f.npy, d.npy, p.yaml."""
        path = self.root / "good" / name
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            self._make(path)
        return path

    def _make(self, path: Path) -> None:
        height, width = SIZE
        noise = np.random.default_rng(0).integers(0, 255, (height + 12, width + 16, 3))
        texture = cv2.GaussianBlur(noise.astype(np.uint8), (0, 0), 1.0)
        v, u = np.mgrid[:height, :width].astype(np.float32)
        if path.suffix == ".png":
            shift = 4 + (path.stem == "b")
            cv2.imwrite(str(path), texture[4 : 4 + height, shift : shift + width])
        elif path.name == "f.npy":
            flow = [-1 - 0.02 * (u - width / 2), 0.02 * (v - height / 2)]
            np.save(path, np.stack(flow, -1).astype(np.float32))
        elif path.name == "d.npy":
            np.save(path, 2 + 0.01 * u.astype(float))
        else:
            path.write_text(self.problem())

    def problem(self, **options: object) -> str:
        """Text of a problem file of the tiny pair; keywords are further keys of its input."""
        names = {"ref": "a.png", "next": "b.png", "depth": "d.npy"}
        files = {key: str(self.good(name)) for key, name in names.items()}
        camera = [float(x) for x in CAMERA.split(",")]
        tree = {
            "input": {"kind": "files", "intrinsics": camera, **files, **options},
            "flow": {"source": str(self.good("f.npy"))},
        }
        for key, value in TINY.items():
            section, name = key.split(".")
            tree.setdefault(section, {})[name] = value
        return yaml.safe_dump(tree)

    @cached_property
    def pair(self) -> list[str]:
        """Words of `solve` for the tiny pair; the last one of a repeated option counts."""
        a, b, flow = (str(self.good(name)) for name in ("a.png", "b.png", "f.npy"))
        return [a, b, "--flow", flow, "--intrinsics", CAMERA]

    @cached_property
    def result(self) -> Path:
        """A result folder."""
        out = self.root / "result"
        depth = ["--depth", str(self.good("d.npy"))]
        assert main(["solve", *self.pair, *depth, *SET, "-o", str(out), "-q"]) in (0, 1)
        return out

    @cached_property
    def exported(self) -> Path:
        """An exported folder with a solver's answer, soup.sol, that is not optimal."""
        out = self.root / "exported"
        assert main(["export", str(self.good("p.yaml")), "-o", str(out), "-q"]) == 0
        rows, columns = (len((out / f"soup.{s}").read_text().split()) for s in ("row", "col"))
        # the .row file names the objective as well
        sizes = [rows - 1, 0, columns, columns]
        lines = ["tiny 1.0", "", "Options", 3, 0, 1, 0, *sizes, *["0.5"] * columns, "objno 0 400"]
        (out / "soup.sol").write_text("\n".join(map(str, lines)) + "\n")
        return out

    @property
    def sol(self) -> Path:
        """That answer."""
        return self.exported / "soup.sol"

    def odd(self, kind: str, suffix: str = "") -> str:
        """The name of an odd file."""
        folder = self.root / "odd"
        folder.mkdir(exist_ok=True)
        path = folder / f"{kind}{suffix}"
        if not os.path.lexists(path):
            made = ODD[kind](path)
            if isinstance(made, str):
                return made
        return str(path)


def _bind(path: Path) -> None:
    # names of sockets are short: bound under a short name, then moved
    here = os.getcwd()
    os.chdir(path.parent)
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind("s")
        os.rename("s", path.name)
    finally:
        os.chdir(here)


def _latin(path: Path) -> str:
    name = os.fsencode(path.parent) + b"/caf\xe9" + os.fsencode(path.suffix)
    Path(os.fsdecode(name)).write_bytes(b"\xe9\xff not a file of any format")
    return os.fsdecode(name)


ODD = {
    "missing": lambda path: None,
    "empty": lambda path: path.touch(),
    "folder": lambda path: path.mkdir(),
    "pipe": lambda path: os.mkfifo(path),
    "zero": lambda path: path.symlink_to("/dev/zero"),
    "null": lambda path: path.symlink_to("/dev/null"),
    "random": lambda path: path.symlink_to("/dev/urandom"),
    "socket": _bind,
    "nul": lambda path: f"{path.parent}/a\0b{path.suffix}",
    "long": lambda path: f"{path.parent}/{'x' * 300}{path.suffix}",
    "deep": lambda path: f"{path.parent}/{'d/' * 3000}x{path.suffix}",
    "nouser": lambda path: f"~nouser_zz/x{path.suffix}",
    "loop": lambda path: path.symlink_to(path),
    "dangling": lambda path: path.symlink_to("nowhere"),
    "latin": _latin,
    "newline": lambda path: f"{path.parent}/a\nb{path.suffix}",
    "escape": lambda path: f"{path.parent}/\x1b[31mred\x1b]0;t\x07{path.suffix}",
    "garbage": lambda path: path.write_bytes(bytes(range(256)) * 16),
    "line": lambda path: path.write_bytes(b"a" * 300_000),
    "brackets": lambda path: path.write_bytes(b"[" * 100_000),
    "digits": lambda path: path.write_bytes(b"1" * 100_000),
    "braces": lambda path: path.write_bytes(b'{"a":' * 50_000),
}
"""Kinds of odd files: makes one at the path, or returns another name."""
NO_FOLDER = ("pipe", "zero", "null", "socket", "nul", "long", "deep", "loop", "garbage")
"""Kinds that no output folder can be made at."""


def png(width: int, height: int, depth: int = 8, colour: int = 0, rows: bytes = b"\0\0") -> bytes:
    """A PNG whose header may claim more than its rows hold."""
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    out = b"\x89PNG\r\n\x1a\n"
    for kind, data in ((b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")):
        out += struct.pack(">I", len(data)) + kind + data
        out += struct.pack(">I", zlib.crc32(kind + data))
    return out


def encoded_noise(size: tuple[int, int], suffix: str = ".png", kind: type = np.uint8) -> bytes:
    """An image of noise."""
    values = np.random.default_rng(1).integers(0, 255, (*size, 3)).astype(kind)
    return cv2.imencode(suffix, values)[1].tobytes()
