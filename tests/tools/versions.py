"""The fast tests in several Pythons, with the lowest and the newest packages that are allowed.

python tests/tools/versions.py                              # the whole table
python tests/tools/versions.py --only "3.13 lowest"         # rows whose name holds one of the words
python tests/tools/versions.py --python /opt/python3.13  # where it is not on the PATH

Every row has an environment of its own in a temporary folder. Rows of circumstances (no compiler,
no home folder, ...) run a few commands, their output in a pipe, in an environment of the Python
that runs this; the row "bare" has all of them together and runs the fast tests. An interpreter
that is not there is a row that was not run.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PYTHONS = ("3.11", "3.12", "3.13")
RUNNERS = ("pytest", "hypothesis", "matplotlib")
"""What the tests need besides the dependencies."""
NO_COMPILER = {"CC": "no-such-compiler"}
TINY = [
    "input.width=128", "input.height=96", "segmentation.superpixels=40", "flow.source=truth",
    "segmentation.neighbours=6", "refine.rounds=1", "refine.particles=6",
]  # fmt: skip


@dataclass(frozen=True)
class Circumstance:
    """What is missing or odd around the program.

    Attributes:
        name: Of the row.
        set: Variables of the environment.
        unset: Variables that are not set.
        without: Packages that are not installed.
        tests: Whether the fast tests run, rather than a few commands.
    """

    name: str
    set: Mapping[str, str]
    unset: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    tests: bool = False


CIRCUMSTANCES = (
    Circumstance("no compiler", NO_COMPILER),
    Circumstance("read-only HOME", {"HOME": "READ_ONLY"}),
    Circumstance("no HOME", {}, unset=("HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR")),
    Circumstance("LANG=C", {"LANG": "C", "LC_ALL": "C"}),
    Circumstance("ASCII", {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),
    Circumstance("40 columns", {"COLUMNS": "40", "TERM": "dumb"}),
    Circumstance(
        "bare",
        {**NO_COMPILER, "LANG": "C", "LC_ALL": "C", "COLUMNS": "40"},
        unset=("HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR"),
        tests=True,
    ),
)


def lowest() -> list[str]:
    """Requirements of the lowest versions that pyproject.toml allows."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    runners = [r for r in project["optional-dependencies"]["dev"] if r.split(">")[0] in RUNNERS]
    return [word.replace(">=", "==") for word in (*project["dependencies"], *runners)]


def interpreter(version: str, given: Sequence[str]) -> str | None:
    """The interpreter of a Python version, among those given and on the PATH; None without."""
    ask = "import sys; print('%d.%d' % sys.version_info[:2])"
    for name in (*given, f"python{version}", sys.executable):
        if path := shutil.which(name):
            done = subprocess.run([path, "-c", ask], capture_output=True, text=True, check=False)
            if done.stdout.strip() == version:
                return path
    return None


def install(folder: Path, python: str, bounds: str) -> tuple[str | None, str]:
    """Make an environment: its interpreter (None where packages cannot be had), pip's complaint."""
    subprocess.run([python, "-m", "venv", str(folder)], check=True)
    own = str(folder / "bin" / "python")
    pip = [own, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    words = lowest()
    if bounds == "newest":
        words = [word.replace("==", ">=") for word in words]
    done = subprocess.run(
        [*pip, "--only-binary", ":all:", *words], capture_output=True, text=True, check=False
    )
    if done.returncode:
        return None, done.stderr[-2000:]
    subprocess.run([*pip, "--no-deps", "--editable", str(ROOT)], check=True, capture_output=True)
    return own, ""


def commands(python: str, folder: Path) -> list[tuple[list[str], int]]:
    """Command lines of a first hour, and the exit code of each."""
    program, sets = [python, "-m", "soup_nlp"], [w for text in TINY for w in ("--set", text)]
    result, exported = str(folder / "result"), str(folder / "exported")
    return [
        ([*program, "--help"], 0),
        ([*program, "solve", "--help"], 0),
        ([*program, "list"], 0),
        ([*program, "show", "orbit"], 0),
        ([*program, "solve", "orbit", *sets, "--out", result], 0),
        ([*program, "check", result], 0),
        ([*program, "convert", result, "--to", "glb,colmap,pfm,npy,png,ply"], 0),
        ([*program, "export", "orbit", *sets, "--out", exported], 0),
        ([*program, "solve", "nothing.yaml"], 2),
    ]


def run_commands(python: str, around: Mapping[str, str], folder: Path) -> str:
    """Run them with their output in a pipe; what was wrong, empty where nothing was."""
    for words, expected in commands(python, folder):
        done = subprocess.run(words, capture_output=True, env=dict(around), check=False)
        said = (done.stdout + done.stderr).decode("utf-8", "backslashreplace")
        verb = " ".join(words[3:5])
        if done.returncode != expected or "Traceback" in said or "Warning" in said:
            return f"{verb}: exit {done.returncode}, expected {expected}\n{said[-1500:]}"
        if b"\x1b" in done.stdout:
            return f"{verb}: control characters in a pipe"
    left = [str(p) for p in folder.rglob("*") if ".soup_nlp-" in p.name]
    return f"left behind: {left}" if left else ""


def run_tests(python: str, around: Mapping[str, str]) -> tuple[bool, str]:
    """The fast tests: whether they pass, and pytest's closing lines."""
    words = [
        python,
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        "-m",
        "not slow",
        str(ROOT / "tests"),
    ]
    done = subprocess.run(
        words, capture_output=True, text=True, errors="replace", env=dict(around), cwd=ROOT,
        check=False,
    )  # fmt: skip
    lines = (done.stdout + done.stderr).strip().splitlines()
    return done.returncode == 0, lines[-1] if done.returncode == 0 else "\n".join(lines[-60:])


def surroundings(case: Circumstance, scratch: Path) -> dict[str, str]:
    """The environment of a row."""
    own = {k: v for k, v in os.environ.items() if k not in case.unset}
    own |= {"OMP_NUM_THREADS": "1", **case.set}
    if own.get("HOME") == "READ_ONLY":
        home = scratch / "read-only"
        home.mkdir(mode=0o555)
        # permissions do not hold for root: a folder below a file cannot be made by anybody
        (scratch / "file").touch()
        own["HOME"] = str(home if os.geteuid() else scratch / "file" / "home")
        own = {k: v for k, v in own.items() if k not in ("XDG_CACHE_HOME", "MPLCONFIGDIR")}
    return own


def packages(python: str) -> str:
    """Versions of the large packages of an environment."""
    names = ["numpy", "scipy", "casadi", "h5py", "pydantic", "matplotlib"]
    ask = f"import importlib.metadata as m; print(*(n + ' ' + m.version(n) for n in {names!r}))"
    return subprocess.run(
        [python, "-c", ask], capture_output=True, text=True, check=True
    ).stdout.strip()


def spent() -> float:
    """CPU seconds of child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def row(name: str, check: Callable[[], tuple[bool, str]]) -> bool:
    """Print a row of the table, with its CPU seconds; whether it is good."""
    begin = spent()
    good, text = check()
    print(
        f"{'ok' if good else 'FAILED':<8}{name:<16}{text}  ({spent() - begin:.0f} CPU s)",
        flush=True,
    )
    return good


def versions_row(name: str, python: str, folder: Path) -> tuple[bool, str]:
    """Make an environment and run the fast tests in it."""
    own, said = install(folder, python, name.split()[-1])
    if own is None:
        return False, said
    good, said = run_tests(own, {**os.environ, "OMP_NUM_THREADS": "1"})
    return good, f"{said}; {packages(own)}"


def circumstance_row(case: Circumstance, own: str, scratch: Path) -> tuple[bool, str]:
    """Run the fast tests, or a few commands, under a circumstance."""
    around, folder = surroundings(case, scratch), Path(tempfile.mkdtemp(dir=scratch))
    pip = [own, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    if case.without:
        subprocess.run([*pip, "uninstall", "-y", *case.without], check=True, capture_output=True)
    try:
        if case.tests:
            return run_tests(own, around)
        said = run_commands(own, around, folder)
        return not said, said or "help, list, show, solve, check, convert, export, an error"
    finally:
        if case.without:
            subprocess.run([*pip, "install", *case.without], check=True, capture_output=True)


def main() -> int:
    """Print the table; exit code 1 where a row fails, or none was run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", action="append", default=[], help="rows whose name holds this")
    parser.add_argument("--python", action="append", default=[], help="path of an interpreter")
    options = parser.parse_args()
    found: list[bool] = []

    def wanted(name: str) -> bool:
        return not options.only or any(word in name for word in options.only)

    with tempfile.TemporaryDirectory(prefix="soup_versions_") as place:
        scratch = Path(place)
        for version in PYTHONS:
            for name in filter(wanted, (f"{version} newest", f"{version} lowest")):
                python = interpreter(version, options.python)
                if python is None:
                    print(f"not run {name}: there is no python{version}", flush=True)
                    continue
                folder = scratch / name.replace(" ", "-")
                found.append(row(name, partial(versions_row, name, python, folder)))
        cases = [case for case in CIRCUMSTANCES if wanted(case.name)]
        own, said = install(scratch / "here", sys.executable, "newest") if cases else (None, "")
        if cases and own is None:
            found.append(row("environment", lambda: (False, said)))
        found += [row(c.name, partial(circumstance_row, c, own, scratch)) for c in cases if own]
    return 0 if found and all(found) else 1


if __name__ == "__main__":
    sys.exit(main())
