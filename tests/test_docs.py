"""The documents agree with the code: links, names, keys, rooms, scores."""

import ast
import csv
import re
from functools import cache
from pathlib import Path

import pytest
from constraint_mutants import MUTANTS
from helpers_odd_options import fields

from soup_nlp.cli.main import COMMANDS
from soup_nlp.config.problem import Problem

ROOT = Path(__file__).resolve().parents[1]
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [*DOCS, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
FOLDERS = ("", "docs", "results", "results/*", "benchmarks/family/records")
DOCUMENTS = sorted(page for folder in FOLDERS for page in ROOT.glob(f"{folder}/*.md".lstrip("/")))
LINK = re.compile(r"!?\[([^\]]*)\]\(([^)\s]+)\)")
NAME = re.compile(r"`([A-Za-z_][\w.]*)`")
every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


@cache
def headings(text: str) -> set[str]:
    """Anchors of a page's headings, as Markdown renderers make them."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    found = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h).strip().lower().replace(" ", "-") for h in found}


@cache
def definitions(path: Path) -> set[str]:
    """Names that a module defines: functions, classes, their members, constants."""
    out = set()

    def collect(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                out.add(prefix + node.name)
                if isinstance(node, ast.ClassDef):
                    collect(node.body, f"{prefix}{node.name}.")
            targets = node.targets if isinstance(node, ast.Assign) else []
            targets = [node.target] if isinstance(node, ast.AnnAssign) else targets
            out.update(prefix + t.id for t in targets if isinstance(t, ast.Name))

    collect(ast.parse(path.read_text(encoding="utf-8")).body, "")
    return out


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_headings_and_names(page):
    text = page.read_text(encoding="utf-8")
    for label, link in LINK.findall(text):
        if "://" in link:
            continue
        place, _, anchor = link.partition("#")
        target = (page.parent / place).resolve() if place else page
        assert target.exists(), link
        if anchor:
            assert anchor in headings(target.read_text(encoding="utf-8")), link
        name = NAME.fullmatch(label)
        if target.suffix == ".py" and name:
            assert name[1] in definitions(target), f"{name[1]} is not in {link}"


KEYS = dict(fields(Problem))
"""Every key of a problem file, and its sections, whose types are empty."""


def test_the_keys_of_options_are_few():
    # the section input is of kinds with keys of its own
    assert len([name for name, kind in KEYS.items() if kind and name != "input"]) <= 55


SECTIONS = "segmentation|flow|start|energy|formulation|solver|refine|expected|output"


@every_page
def test_files_keys_and_commands_that_are_named_exist(page):
    text = page.read_text(encoding="utf-8")
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    for name in re.findall(r"`((?:soup_nlp|tests|results|docs|problems)/[\w./]+)`", prose):
        assert (ROOT / name).exists(), name
    assert "energy.weights.orient" in KEYS
    for key in re.findall(rf"(?:`|--set )((?:{SECTIONS})\.[a-z_.]+)(?=[`:= ])", text):
        # a picture flow.png is none
        assert key in KEYS or key.endswith((".png", ".flo")), key
    for command in re.findall(r"soup-nlp ([a-z]+)\b", text):
        assert command in COMMANDS, command


def test_every_equation_has_its_function():
    text = (ROOT / "docs/formulation.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[(\d+)\]\(#([\w-]+)\) \|(.*)$", text, re.MULTILINE)
    assert [int(number) for number, *_ in rows] == list(range(1, len(rows) + 1))
    for number, anchor, rest in rows:
        assert anchor.startswith(f"{number}-")
        assert ".py)" in rest, number
    # all ten of the paper
    printed = re.findall(r"^\| \[\d+\]\([^)]*\) \| ([\d, ]+) \|", text, re.MULTILINE)
    assert {int(x) for cell in printed for x in cell.split(",")} == set(range(1, 11))


def test_the_readme_is_short():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    assert all(len(line) <= 200 for line in lines)


def test_the_documents_are_short():
    words = {str(page): len(page.read_text(encoding="utf-8").split()) for page in DOCUMENTS}
    assert sum(words.values()) <= 30_000, words


STORED = {
    **{k: [f"{k}-s0-1024x436"] for k in ("street", "room", "banner")},
    "motorcycle": ["motorcycle"],
    "KITTI 2012": ["kitti2012 000138", "kitti2012 000027"],
    "KITTI 2015": ["kitti2015 000002", "kitti2015 000007"],
    "KITTI tracking": [f"kitti_tracking {k}" for k in range(4)],
    "bending paper": [f"kinect_paper {k}" for k in ("025", "049", "065", "105", "129", "145")],
    "indoor RGB-D with people, cloth": [
        *(f"rgbd {k}" for k in ("opening_door", "robot", "two_people_walking")),
        "deepdeform 017",
    ],
    "Sintel alley_1": ["sintel alley_1-0020+5"],
}
"""Pairs of the stored tables by the beginning of their row in the README."""


def cells(page: str, head: str) -> list[list[str]]:
    """Cells of the table of a page whose first row begins so, without the rule below that row."""
    text = (ROOT / page).read_text(encoding="utf-8")
    lines = text[text.index(f"\n{head}") + 1 :].partition("\n\n")[0].splitlines()
    return [[c.strip() for c in line.split("|")[1:-1]] for line in (lines[0], *lines[2:])]


def stored_scores() -> dict[tuple[str, str], list[str]]:
    """MRE of solution and constant depth by pair and flow."""
    out = {}
    for suite in ("rendered", "shared"):
        text = (ROOT / f"results/accuracy/{suite}.csv").read_text(encoding="utf-8")
        for row in csv.DictReader(text.splitlines()):
            out[row["pair"], row["flow"]] = [row["solution"], row["constant"]]
    return out


def fits(cell, numbers):
    """Whether a cell of the README says the numbers of a table, rounded: all, or from a to b."""
    said = [word for word in re.split(r",| to ", cell) if word.strip() not in ("", "none")]
    if " to " in cell:
        numbers = [min(numbers, key=float), max(numbers, key=float)]
    words = [re.match(r"\s*([\d.]+)", word)[1] for word in said]
    shown = [float(w) for w in words]
    # half a unit of the last digit, and the rounding of the table
    slack = [0.51 * 10.0 ** -len(w.partition(".")[2]) + 6e-5 for w in words]
    return len(words) == len(numbers) and all(
        abs(a - float(b)) <= s for a, b, s in zip(shown, numbers, slack)
    )


def test_scores_are_those_of_the_stored_tables():
    scores = stored_scores()
    for row in cells("README.md", "| pair | true flow |")[1:]:
        pairs = STORED[max((k for k in STORED if row[0].startswith(k)), key=len)]
        for cell, flow, column in ((1, "truth", 0), (2, "dis", 0), (3, "dis", 1)):
            numbers = [scores[p, flow][column] for p in pairs if (p, flow) in scores]
            said = row[cell].partition(", not")[0]
            assert fits(said, numbers) or (not said and flow == "truth"), (row, numbers)


def test_a_mutant_of_a_constraint_changes_one_place():
    for mutant, _ in MUTANTS:
        text = (ROOT / "soup_nlp" / mutant.module).read_text(encoding="utf-8")
        assert text.count(mutant.old) == 1, mutant.what


def test_the_check_of_names_can_fail():
    known = definitions(ROOT / "soup_nlp/geometry/soup.py")
    assert {"Soup", "Soup.points", "Soup.lam", "reconstruct"} <= known
    assert "Soup.nothing" not in known
    assert "1-rays" in headings("# Title\n### 1. Rays\n```text\n# none\n```")


def test_the_comparison_of_scores_can_fail():
    assert fits("0.016", ["0.0160"])
    assert not fits("0.016", ["0.0167"])
    assert not fits("0.016, 0.02", ["0.0160"])
    assert fits("0.10 to 0.25", ["0.2475", "0.0982", "0.1270"])
    assert not fits("0.10 to 0.25", ["0.2575", "0.0982"])
