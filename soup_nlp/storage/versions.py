"""Versions of the program, of its code and of the packages that it uses."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path

__version__ = "0.1.0"


@cache
def code_version() -> str:
    """Version and hash of the sources of the package at the first call.

    Benchmarks store it in their rows and measure again what other code has measured.
    """
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return f"{__version__}+{digest.hexdigest()[:10]}"


def versions() -> dict[str, str]:
    """Versions of the packages that a result depends on."""
    # opencv-python and its variants are one module
    import cv2

    packages = {name: version(name) for name in ("casadi", "numpy", "scipy")}
    packages |= {"opencv": cv2.__version__, "skimage": version("scikit-image")}
    python = platform.python_version()
    return {"soup_nlp": __version__, "python": python, **packages, "h5py": version("h5py")}
