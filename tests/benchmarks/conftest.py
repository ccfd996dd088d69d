"""A small set under the names of a published size."""

import pytest
from freeze_family import record_of

from benchmarks.family import write
from benchmarks.family.frozen import Frozen
from benchmarks.family.instances import STANDARD, select
from benchmarks.family.write import write_family
from soup_nlp import make_problem
from soup_nlp.pipeline.case import prepare

OTHER = "unit-translation/smooth"


@pytest.fixture(scope="session")
def record() -> Frozen:
    """Thirty superpixels of a small room with the true flow; its best point is the proposal."""
    scene = {"kind": "scene", "scene": "room", "seed": 1, "width": 256, "height": 128}
    own = {"input": scene, "segmentation": {"superpixels": 30}, "flow": {"source": "truth"}}
    return record_of(prepare(make_problem(own)))


@pytest.fixture(scope="module")
def folder(record, tmp_path_factory):
    """The set of that record, under the names of a published size."""
    out, lines = tmp_path_factory.mktemp("set"), []
    chosen = select([100], ["room"], [STANDARD]) + select([100], ["room"], [OTHER], ["hard"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "load_frozen", lambda scene, size: record)
        write_family(out, chosen, lines.append)
        assert len(lines) == len(chosen) == 4
        yield out
