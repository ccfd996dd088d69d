"""All odd inputs, from the tables of the other files."""

from __future__ import annotations

from helpers_odd_api import api_cases
from helpers_odd_contents import content_cases, h5_cases
from helpers_odd_numbers import number_cases, solve_cases
from helpers_odd_options import option_cases
from helpers_odd_paths import path_cases
from helpers_odd_run import Case
from helpers_odd_texts import row_cases, text_cases, untrusted_cases
from helpers_odd_uses import use_cases
from helpers_odd_uses_api import use_api_cases

CASES: list[Case] = [
    *path_cases(),
    *content_cases(),
    *h5_cases(),
    *text_cases(),
    *row_cases(),
    *number_cases(),
    *solve_cases(),
    *untrusted_cases(),
    *api_cases(),
    *use_cases(),
    *use_api_cases(),
    *option_cases(),
]
