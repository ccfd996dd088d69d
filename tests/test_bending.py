"""Surfaces that bend are told from bodies that move apart, and solved without rigid pieces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from soup_nlp.bench.truth import true_soup
from soup_nlp.cases import Case, prepare
from soup_nlp.cli import main
from soup_nlp.config import make_problem
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.report.metrics import depth_metrics
from soup_nlp.solve.soup import solve_soup

SHEET = Path(__file__).parent.parent / "problems" / "sheet.yaml"
CONT_ACROSS = "energy.bending.cont_across"


def case(scene: str, *overrides: str) -> Case:
    raw = {
        "input": {"kind": "scene", "scene": scene, "seed": 0, "width": 512, "height": 218},
        "flow": {"source": "truth"},
        "segmentation": {"superpixels": 150},
    }
    return prepare(make_problem(raw, overrides))


@pytest.mark.parametrize("scene", ["street", "room", "orbit"])
def test_rigid_bodies_do_not_bend(scene):
    start = case(scene).start
    assert not start.bending
    assert start.bending_share < 0.2


def test_sheet_bends_and_can_be_told_not_to():
    c = case("sheet")
    assert c.start.bending
    assert c.start.bending_share > 0.35
    assert c.data.arap_at_anchors
    assert (c.start.body == 0).all()
    np.testing.assert_allclose(c.soup.depth_at(c.data.anchor_ray), 1.0, rtol=1e-9)
    assert not case("sheet", "start.bending=1.0").start.bending


@pytest.mark.parametrize("count", [100, 300])
def test_sheet_is_better_than_a_constant_depth(count):
    c = case("sheet", f"segmentation.superpixels={count}")
    answer = solve_soup(c.soup, c.data, c.weights, c.formulation(), c.options)
    z = reconstruct(answer.soup, c.segmentation.labels, c.pair.K_ref, c.pair.K_next).depth_ref
    gt = c.pair.truth.depth_ref
    constant = depth_metrics(np.ones_like(gt), gt).mre
    assert depth_metrics(z, gt).mre < 0.6 * constant


def test_one_weight_that_is_set_leaves_those_of_the_others():
    own, set_ = (
        case("sheet", *over).weights for over in ((), ("energy.bending.weights.orient=2.0",))
    )
    assert set_ == replace(own, orient=0.5 * own.orient)
    assert own.cont == 0.05


def test_gaps_where_the_flow_tears_are_not_closed():
    c, closed = case("sheet"), case("sheet", f"{CONT_ACROSS}=1.0")
    i, k = c.data.pairs.T
    torn = c.start.surface[i] != c.start.surface[k]
    assert 0 < torn.sum() < 0.2 * len(torn)
    np.testing.assert_allclose(
        c.data.pair_weight, np.where(torn, 0.01, 1.0) * closed.data.pair_weight, rtol=1e-12
    )
    # the tears are the outline of the sheet
    body = true_soup(c.pair, c.segmentation).body
    assert (body[i] != body[k])[torn].mean() > 0.9
    rigid = [case("street", *over).data.pair_weight for over in ((), (f"{CONT_ACROSS}=1.0",))]
    np.testing.assert_array_equal(*rigid)


def test_every_claim_of_a_bending_result_holds(tmp_path, capsys):
    over = ["segmentation.superpixels=60", "segmentation.neighbours=6", "refine.enabled=false"]
    size = ["input.width=256", "input.height=109", "expected.mre_at_most=null"]
    sets = [word for item in (*over, *size) for word in ("--set", item)]
    out = tmp_path / "sheet"
    main(["solve", str(SHEET), "--out", str(out), *sets])
    assert "bending)" in (out / "log.txt").read_text()
    assert main(["check", str(out)]) == 0, capsys.readouterr().out
