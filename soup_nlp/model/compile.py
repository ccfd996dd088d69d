"""Kernels as machine code: C that is compiled once and cached by content."""

import atexit
import hashlib
import logging
import os
import platform
import resource
import shlex
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

log = logging.getLogger(__name__)
MOST_SOURCE = 1_000_000
"""Characters of C that are compiled: 0.6 million take gcc 9 seconds, 1.4 million minutes."""
FLAGS = ("-O2", "-march=native", "-fPIC", "-shared", "-fno-math-errno")


def cache_dir() -> Path:
    """Folder of compiled kernels: $SOUP_NLP_CACHE, else $XDG_CACHE_HOME or ~/.cache."""
    folder = os.environ.get("SOUP_NLP_CACHE")
    if folder:
        return Path(folder)
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "soup_nlp"


def find_compiler() -> list[str]:
    """The C compiler with its options: $CC, else cc, gcc or clang on the PATH; empty for none."""
    given = shlex.split(os.environ.get("CC", ""))
    names = given[:1] or ["cc", "gcc", "clang"]
    return next(([path, *given[1:]] for name in names if (path := shutil.which(name))), [])


def compiler_seconds() -> float:
    """CPU seconds of child processes that have ended: the C compiler's."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@cache
def _cpu() -> str:
    """What -march=native depends on, so that a cache shared by machines stays right."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.machine() + platform.processor()
    lines = [s for s in text.splitlines() if s.startswith(("flags", "Features", "model name"))]
    return "\n".join(sorted(set(lines)))


def shared_library(content: str, source: Callable[[], str]) -> Path | None:
    """A shared library of C code, from the cache where its content was compiled before.

    Args:
        content: What the source depends on.
        source: Writes it.

    Returns:
        Path; None without a compiler that works (logged).
    """
    compiler = find_compiler()
    if not compiler:
        return None
    key = hashlib.sha256("\0".join([content, *compiler, *FLAGS, _cpu()]).encode()).hexdigest()[:24]
    try:
        return _build(source, key, compiler)
    except (OSError, subprocess.SubprocessError) as error:
        log.warning("compiling the kernels failed, using numpy: %s", error)
        return None


@cache
def _own_folder() -> Path:
    """A folder of this process alone, removed at its end."""
    folder = tempfile.TemporaryDirectory(prefix="soup_nlp_")
    atexit.register(folder.cleanup)
    return Path(folder.name)


def _ours_alone(path: Path) -> bool:
    """Whether only this user can write a file or folder."""
    if not hasattr(os, "geteuid"):
        return True
    state = path.stat()
    return state.st_uid == os.geteuid() and not state.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _folder() -> Path:
    """The cache; a folder of this process where it cannot be made, or others can write to it.

    Whoever writes a library there decides what this process runs.
    """
    try:
        folder = cache_dir()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        _require_programs(folder)
        if _ours_alone(folder):
            return folder
        log.warning("kernels are not cached: others can write to %s (chmod go-w)", folder)
    except (OSError, RuntimeError) as error:
        # RuntimeError: there is no home folder
        log.info("kernels are not cached: %s", error)
    return _own_folder()


def _require_programs(folder: Path) -> None:
    """Raise OSError where no program can be run from a folder."""
    if os.statvfs(folder).f_flag & os.ST_NOEXEC:
        raise OSError(f"{folder} is mounted noexec (SOUP_NLP_CACHE names another folder)")


def _build(source: Callable[[], str], key: str, compiler: Sequence[str]) -> Path:
    folder = _folder()
    _require_programs(folder)
    library = folder / f"kernels-{key}.so"
    if library.exists() and not _ours_alone(library):
        log.warning("kernels are compiled again: others can write to %s", library)
        folder = _own_folder()
        library = folder / library.name
    if not library.exists():
        code = source()
        if len(code) > MOST_SOURCE:
            raise OSError(f"{len(code)} characters of C would take minutes")
        log.info("compiling kernels with %s; this machine keeps them", Path(compiler[0]).name)
        with tempfile.TemporaryDirectory(dir=folder) as work:
            c_file, made = Path(work) / "kernels.c", Path(work) / library.name
            c_file.write_text(code)
            subprocess.run(
                [*compiler, *FLAGS, str(c_file), "-o", str(made), "-lm"],
                check=True,
                capture_output=True,
                timeout=600,
            )
            made.chmod(0o700)
            os.replace(made, library)
    return library
