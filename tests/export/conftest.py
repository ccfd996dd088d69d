"""The exported problem is the same for all answers to it."""

import pytest

from soup_nlp.config.problem import Problem
from soup_nlp.export import foreign
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case

KNOWN: dict[str, Case] = {}


def prepared(problem: Problem) -> Case:
    key = problem.digest()
    KNOWN[key] = KNOWN.get(key) or prepare(problem)
    return KNOWN[key]


@pytest.fixture(autouse=True)
def exports_are_prepared_once(monkeypatch):
    """For reading answers; the commands that write exports prepare them as they always do."""
    monkeypatch.setattr(foreign, "prepare", prepared)
