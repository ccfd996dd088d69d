"""A small set of the family."""

import pytest
from freeze_family import record_of

from benchmarks.family.frozen import Frozen
from soup_nlp import make_problem
from soup_nlp.pipeline.case import prepare

OTHER = "unit-translation/smooth"


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """The instances of the smallest record of one scene, and one of another formulation."""
    # pandas takes a second, which fast tests need not wait for
    from benchmarks.family.instances import STANDARD, select
    from benchmarks.family.write import write_family

    out, lines = tmp_path_factory.mktemp("set"), []
    chosen = select([100], ["orbit"], [STANDARD]) + select([100], ["orbit"], [OTHER], ["hard"])
    write_family(out, chosen, lines.append)
    assert len(lines) == len(chosen) == 4
    return out


@pytest.fixture(scope="session")
def record() -> Frozen:
    """Thirty superpixels of a small room with the true flow; its best point is the proposal."""
    scene = {"kind": "scene", "scene": "room", "seed": 1, "width": 256, "height": 128}
    own = {"input": scene, "segmentation": {"superpixels": 30}, "flow": {"source": "truth"}}
    return record_of(prepare(make_problem(own)))
