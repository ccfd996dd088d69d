"""The fast tests in several Pythons with the lowest and the newest packages, and odd surroundings.

nox                                    # everything: an hour, most of it installation
nox -s "tests-3.13(packages='lowest')"
nox -s surroundings bare               # a few commands, and all fast tests, without HOME, ...
"""

from pathlib import Path

import nox

PROJECT = nox.project.load_toml("pyproject.toml")["project"]
RUNNERS = ("pytest", "hypothesis", "matplotlib")
"""What the tests need besides the dependencies."""
FAST = ("python", "-m", "pytest", "-p", "no:cacheprovider", "-m", "not slow")

NO_HOME = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR"))
SURROUNDINGS: dict[str, dict[str, str | None]] = {
    # a folder below a file cannot be made by anybody
    "HOME that cannot be made": {**NO_HOME, "HOME": "/dev/null/home"},
    "no HOME": {**NO_HOME},
    "LANG=C": {"LANG": "C", "LC_ALL": "C"},
    "ASCII": {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    "40 columns": {"COLUMNS": "40", "TERM": "dumb"},
}
"""Variables of the environment, None for those that are not set."""
TINY = " ".join(
    f"--set {item}"
    for item in (
        "input.width=128", "input.height=96", "segmentation.superpixels=40", "flow.source=truth",
        "segmentation.neighbours=6", "refine.rounds=1", "refine.particles=6",
    )
)  # fmt: skip
COMMANDS = (
    "--help", "solve --help", "list", "show orbit", f"solve orbit {TINY} --out result",
    "check result", "convert result --to glb,colmap,pfm,npy,png,ply",
    f"export orbit {TINY} --out exported", "solve nothing.yaml",
)  # fmt: skip
"""What a user does in a first hour; the last one ends with an error."""


def install(session: nox.Session, packages: str) -> None:
    """Install the package with the newest or the lowest versions that pyproject.toml allows."""
    runners = [r for r in PROJECT["optional-dependencies"]["dev"] if r.split(">")[0] in RUNNERS]
    words = [*PROJECT["dependencies"], *runners]
    if packages == "lowest":
        words = [word.replace(">=", "==") for word in words]
    session.install("--only-binary", ":all:", *words)
    session.install("--no-deps", "--editable", ".")


@nox.session(python=["3.11", "3.12", "3.13"])
@nox.parametrize("packages", ["newest", "lowest"])
def tests(session: nox.Session, packages: str) -> None:
    """The fast tests."""
    install(session, packages)
    session.run(*FAST, *session.posargs, env={"OMP_NUM_THREADS": "1"})


@nox.session
def surroundings(session: nox.Session) -> None:
    """A few commands, their output in a pipe, in each of the surroundings."""
    install(session, "newest")
    for name, around in SURROUNDINGS.items():
        folder = Path(session.create_tmp()) / name.replace(" ", "-").replace("=", "-")
        folder.mkdir(exist_ok=True)
        with session.chdir(folder):
            for line in COMMANDS:
                good = [2] if "nothing" in line else [0]
                words = ["python", "-m", "soup_nlp", *line.split()]
                env = {"OMP_NUM_THREADS": "1", **around}
                said = session.run(*words, env=env, silent=True, success_codes=good)
                if any(word in str(said) for word in ("Traceback", "Warning", "\x1b")):
                    session.error(f"{name}: {line}\n{said}")
        if left := [p for p in folder.rglob("*") if ".soup_nlp-" in p.name]:
            session.error(f"{name}: left behind {left}")


@nox.session
def bare(session: nox.Session) -> None:
    """The fast tests without HOME, in C and 40 columns."""
    install(session, "newest")
    env = {**NO_HOME, "LANG": "C", "LC_ALL": "C", "COLUMNS": "40"}
    session.run(*FAST, *session.posargs, env={"OMP_NUM_THREADS": "1", **env})
