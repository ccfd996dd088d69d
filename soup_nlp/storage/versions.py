"""Versions of the program, of its code and of the packages that it uses."""

import hashlib
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

__version__ = "0.1.0"

_PACKAGES = {
    "casadi": "casadi",
    "numpy": "numpy",
    "scipy": "scipy",
    "opencv": "opencv-python-headless",
    "skimage": "scikit-image",
    "h5py": "h5py",
}


@cache
def code_version() -> str:
    """Version and hash of the sources of the package at the first call.

    Benchmarks store it in their rows, and measure rows of another version again.
    """
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    # presets are YAML
    for path in sorted(p for p in root.rglob("*.*") if p.suffix in (".py", ".yaml")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return f"{__version__}+{digest.hexdigest()[:10]}"


def versions() -> dict[str, str]:
    """Versions of the packages that a result depends on; "unknown" if not available."""
    own = {"soup_nlp": __version__, "python": platform.python_version()}
    return own | {name: _installed(package) for name, package in _PACKAGES.items()}


@cache
def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
