"""JSON that is read back: every entry with every wrong type is an error of the file."""

import json
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from helpers_result import toy_pairs

from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import DataError, SoupError
from soup_nlp.pipeline.run import solve_pair
from soup_nlp.report.check import check_folder
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.report.layout import Summary
from soup_nlp.report.page import page
from soup_nlp.report.result import load
from soup_nlp.sequence.folder import Contents, renew_page, write_chain
from soup_nlp.sequence.links import make_chain
from soup_nlp.storage.files import read_json

pytestmark = pytest.mark.slow

WRONG = (None, True, 0.5, 10**30, "\n<b>", [], [[]], {"a": {}}, [1, 2, 3])
"""One of each type of JSON, and values that no entry has."""


def changes(tree: Any, put: Any = None) -> Iterator[tuple[str, Any]]:
    """Every entry of a tree in turn without its value, and with every wrong one."""
    root = tree if put is None else put
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in [*items][: 20 if put is None else 3 if isinstance(tree, dict) else 1]:
        for wrong in WRONG:
            tree[key] = wrong
            yield f"{key} = {wrong!r}", root
        tree[key] = value
        if isinstance(tree, dict):
            del tree[key]
            yield f"no {key}", root
            tree[key] = value
        if isinstance(value, dict | list):
            yield from ((f"{key}.{name}", root) for name, root in changes(value, root))


def test_every_entry_of_a_chain(tmp_path):
    chain = make_chain(toy_pairs())
    write_chain(tmp_path, chain, "toy", ["a.png", "b.png", "c.png"])
    path = tmp_path / "chain.json"
    tree, accepted = json.loads(path.read_text()), 0
    tree["score"] = {"scale": 2.0, "mre_one_scale": 0.1}
    for _, root in changes(tree):
        path.write_text(json.dumps(root))
        try:
            contents = read_json(path, "chain.json", Contents)
        except DataError:
            continue
        accepted += 1
        chain = replace(chain, summary=contents)
        if accepted % 20 == 0:
            assert page(chain)
    assert accepted > 20


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("solved") / "out"
    small = {"segmentation": {"superpixels": 12, "neighbours": 4}, "flow": {"source": "truth"}}
    options = {"solver": {"presolve_iterations": 0, "max_iter": 1}, "refine": {"enabled": False}}
    run = solve_pair(render_scene("street", 0, 64, 48), **small, **options)
    write_folder(prepare_folder(out), run, "a log\n")
    return out


def test_every_entry_of_a_summary(solved, tmp_path):
    folder = Path(shutil.copytree(solved, tmp_path / "out"))
    (folder / "SHA256SUMS").unlink()
    path, accepted = folder / "summary.json", 0
    tree = {k: v for k, v in json.loads(path.read_text()).items() if k in Summary.__annotations__}
    for _, root in changes(tree):
        path.write_text(json.dumps(root))
        try:
            read_json(path, "summary.json", Summary)
        except DataError:
            continue
        accepted += 1
        if accepted % 10:
            continue
        for use in (load, check_folder):
            with suppress(SoupError):
                use(folder)
    path.write_text(json.dumps(tree))
    (folder / "report.html").unlink()
    renew_page(folder)
