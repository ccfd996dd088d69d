"""Bad and odd inputs: each ends in a helpful error or in a valid result.

`tests/tools/count_odd.py` counts them, each in a process of its own with little memory; it has the
cases that solve as well.
"""

from collections import defaultdict
from itertools import chain

import pytest
from helpers_odd_commands import path_cases, text_cases, untrusted_cases
from helpers_odd_files import array_cases, image_cases
from helpers_odd_options import number_cases, option_cases
from helpers_odd_results import chain_cases, result_cases
from helpers_odd_run import Case, fault
from helpers_odd_world import World

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

CASES: list[Case] = list(
    chain(
        *(path_cases(), text_cases(), untrusted_cases()),
        *(number_cases(), option_cases()),
        *(array_cases(), image_cases()),
        *(result_cases(), chain_cases()),
    )
)


TABLES = defaultdict[str, list[Case]](list)
"""Cases of this suite by the first two words of their names."""
# every fourth case: the others are similar, and the suite has a limit of time
for _case in [case for case in CASES if not case.solves][::4]:
    TABLES[" ".join(_case.name.split()[:2])].append(_case)


@pytest.fixture(scope="session")
def world(tmp_path_factory) -> World:
    return World(tmp_path_factory.mktemp("odd"))


def test_the_collection_is_large_and_its_names_are_unique():
    assert sum(map(len, TABLES.values())) > 400
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.mark.parametrize("table", TABLES)
def test_odd_inputs_are_answered(table, world, tmp_path, monkeypatch):
    # some cases write a relative path
    monkeypatch.chdir(tmp_path)
    faults = {}
    for number, case in enumerate(TABLES[table]):
        folder = tmp_path / str(number)
        folder.mkdir()
        if problem := fault(case, world, folder):
            faults[case.name] = problem
    assert not faults
