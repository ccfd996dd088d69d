"""The tables of the paper, from artificial rows."""

import json
from operator import attrgetter

import pytest

from benchmarks.paper import METHODS, NO_EFFECT, STUDIES, departures, make_plan, printed
from benchmarks.table import Item
from soup_nlp import make_problem

pytestmark = pytest.mark.slow

PAPER = ("preset=paper",)
RAW = {"input": {"kind": "motorcycle"}}


def item(scene: str = "street") -> Item:
    raw = {"kind": "scene", "scene": scene, "width": 128, "height": 64}
    return Item(scene, f"{scene}-tiny", raw, flow="truth")


@pytest.mark.parametrize("name", STUDIES)
def test_the_variants_of_a_study_are_different_problems(name):
    variants = STUDIES[name][1].values()
    assert len({item().problem(overrides).digest() for overrides in variants}) == len(variants)


def test_undone_departures_have_the_values_of_the_preset():
    paper, base, known = make_problem(RAW, PAPER), make_problem(RAW), departures()
    assert "start.method" in known
    assert "refine.stagnation" not in known
    for overrides in known.values():
        off = make_problem(RAW, overrides)
        assert off.digest() != base.digest()
        for key in (override.partition("=")[0] for override in overrides):
            assert attrgetter(key)(off) == attrgetter(key)(paper)
    # all of them together are the preset, but for what has no effect here
    undone = {o.partition("=")[0] for overrides in known.values() for o in overrides}
    rest = printed().keys() - undone
    both = [key for key in rest if attrgetter(key)(paper) != attrgetter(key)(base)]
    assert set(both) <= NO_EFFECT


def test_a_plan_measures_nothing_twice():
    plan = make_plan(None, superpixels=60, analysis=60)
    cells = plan.drop_duplicates("key")["cell"]
    names = {json.dumps(cell.identity(), sort_keys=True) for cell in cells}
    assert len(names) == len(cells) < len(plan)
    assert set(plan["section"]) == {*STUDIES, "departures"}
    assert set(plan["method"]) == set(METHODS)
