"""A small set of the family."""

import pytest

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
