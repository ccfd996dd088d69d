"""JSON that is read back: every entry with every wrong type is an error of the file."""

import json
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

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

WRONG = (None, True, 0.5, 10**30, "\n<b>", [], [[]], {"a": {}}, [1, 2, 3])
"""One of each type of JSON, and values that no entry has."""


def changes(tree: Any, put: Any = None) -> Iterator[Any]:
    """Every entry of a tree in turn without its value, and with every wrong one."""
    root = tree if put is None else put
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in [*items][: 20 if put is None else 3 if isinstance(tree, dict) else 1]:
        for wrong in WRONG:
            tree[key] = wrong
            yield root
        tree[key] = value
        if isinstance(tree, dict):
            del tree[key]
            yield root
            tree[key] = value
        if isinstance(value, dict | list):
            yield from changes(value, root)


def accepted(path: Path, tree: dict[str, Any], kind: Any) -> Iterator[Any]:
    """What is read of a file with every change of its entries, without what is refused."""
    for root in changes(tree):
        path.write_text(json.dumps(root))
        with suppress(DataError):
            yield read_json(path, path.name, kind)


def test_every_entry_of_a_chain(tmp_path):
    chain = make_chain(toy_pairs())
    write_chain(tmp_path, chain, "toy", ["a.png", "b.png", "c.png"])
    path = tmp_path / "chain.json"
    tree = json.loads(path.read_text()) | {"score": {"scale": 2.0, "mre_one_scale": 0.1}}
    read = [replace(chain, summary=x) for x in accepted(path, tree, Contents)]
    assert len(read) > 20
    assert all(map(page, read[::20]))


def test_every_entry_of_a_summary(tmp_path):
    small = {"segmentation": {"superpixels": 12, "neighbours": 4}, "flow": {"source": "truth"}}
    options = {"solver": {"presolve_iterations": 0, "max_iter": 1}, "refine": {"enabled": False}}
    run = solve_pair(render_scene("street", 0, 64, 48), **small, **options)
    write_folder(prepare_folder(tmp_path), run, "a log\n")
    (tmp_path / "SHA256SUMS").unlink()
    path = tmp_path / "summary.json"
    tree = {k: v for k, v in json.loads(path.read_text()).items() if k in Summary.__annotations__}
    for count, _ in enumerate(accepted(path, tree, Summary)):
        for use in (load, check_folder) if count % 10 == 0 else ():
            with suppress(SoupError):
                use(tmp_path)
    path.write_text(json.dumps(tree))
    (tmp_path / "report.html").unlink()
    renew_page(tmp_path)
