"""A chain of many frames: what is in memory at once, and what is kept after a kill."""

from pathlib import Path

import numpy as np
import pytest
from helpers_result import toy_pairs

from soup_nlp.config.problem import make_problem
from soup_nlp.report import page as report_page
from soup_nlp.report import pairs as stored
from soup_nlp.report.chain import NEAR, Lazy
from soup_nlp.report.result import Result
from soup_nlp.sequence.folder import write_chain
from soup_nlp.sequence.links import make_chain
from soup_nlp.storage.each import append_row
from soup_nlp.storage.files import write_text
from soup_nlp.storage.folders import staged


def test_items_are_made_when_they_are_needed_and_few_stay():
    made = []
    items = Lazy(lambda k: made.append(k) or k, 100)
    assert (len(items), list(items), made) == (100, list(range(100)), list(range(100)))
    assert items[-1] == 99
    assert items[97:] == [97, 98, 99]
    assert made == list(range(100))
    # the last few stay
    assert items[-NEAR:] == [*range(100)][-NEAR:]
    assert items[-NEAR - 1] == 100 - NEAR - 1
    assert made[100:] == [100 - NEAR - 1]
    with pytest.raises(IndexError):
        items[100]


@pytest.mark.slow
def test_a_long_chain_reads_few_pairs_at_once(tmp_path, monkeypatch):
    first, count, alive, most = toy_pairs()[0], 8, 0, 0

    class Counted(Result):
        def __del__(self) -> None:
            nonlocal alive
            alive -= 1

    def read(k: int) -> Result:
        nonlocal alive, most
        alive += 1
        most = max(most, alive)
        return Counted(**vars(first))

    lazy = make_chain(Lazy(read, count))
    assert most <= NEAR + 2
    sources = [f"{k}.png" for k in range(count + 1)]
    many = write_chain(tmp_path, make_chain([first] * count), "toy", sources)
    np.testing.assert_allclose(lazy.scales, many.scales)
    assert '["6.png", "7.png"], ["7.png", "8.png"]]' in (tmp_path / "report.html").read_text()
    # a page does not grow with the number of pairs
    monkeypatch.setattr(report_page, "MOST_PAIRS", 3)
    scene = report_page.make_scene(many)
    assert scene["names"] == [["0.png", "1.png"], ["3.png", "4.png"], ["7.png", "8.png"]]
    ends = [many.world_from_camera[k].matrix for k in (3, 4)]
    np.testing.assert_allclose(scene["cameras"][1], ends)


def test_a_result_that_another_run_left_is_not_that_of_a_row(tmp_path: Path):
    def solved(name: str, seed: int, told: bool) -> dict:
        problem = make_problem({"input": {"kind": "scene", "scene": "orbit"}, "seed": seed})
        head = stored.head(problem.replace(name=name))
        place = tmp_path / "pairs" / name
        with staged(place, whole=True) as new:
            write_text(new / "result.h5", f"{seed}")
        if told:
            append_row(tmp_path / "pairs.jsonl", {**head, "result": stored._result(place)})
        return head

    one = solved("a", 1, told=True)
    assert stored.kept_rows(tmp_path, {"a": one})
    # killed between the result and its row
    solved("a", 2, told=False)
    assert not stored.kept_rows(tmp_path, {"a": one})
    # and what an earlier row says does not count
    two = solved("a", 2, told=True)
    assert stored.kept_rows(tmp_path, {"a": two})
    assert not stored.kept_rows(tmp_path, {"a": one})


@pytest.mark.parametrize("wrong", [[], {}, True, "text", 5, [1], {"a": 1}])
def test_a_row_with_an_entry_of_another_type_is_none(wrong, tmp_path):
    problem = make_problem({"input": {"kind": "scene", "scene": "orbit"}, "name": "a"})
    own = stored.head(problem)
    good = {**own, "ok": False, "error": "no flow", "mre": 0.5, "exit_code": 1}
    for key, value in good.items():
        kept = isinstance(wrong, type(value)) and key not in own
        (tmp_path / "pairs.jsonl").unlink(missing_ok=True)
        append_row(tmp_path / "pairs.jsonl", good | {key: wrong})
        if not (kept or key == "ok" or (key == "mre" and wrong == 5)):
            assert not stored.kept_rows(tmp_path, {"a": own}), key
