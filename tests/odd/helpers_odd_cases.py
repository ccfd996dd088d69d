"""All odd inputs, from the tables of the other files."""

from __future__ import annotations

from itertools import chain

from helpers_odd_api import api_cases
from helpers_odd_commands import path_cases, text_cases, untrusted_cases
from helpers_odd_files import array_cases, image_cases, network_cases
from helpers_odd_options import number_cases, option_cases, preset_cases, solve_cases
from helpers_odd_results import chain_cases, lost_cases, result_cases
from helpers_odd_run import Case

CASES: list[Case] = list(
    chain(
        *(path_cases(), text_cases(), untrusted_cases()),
        *(number_cases(), solve_cases(), preset_cases(), option_cases()),
        *(array_cases(), image_cases(), network_cases()),
        *(result_cases(), lost_cases(), chain_cases(), api_cases()),
    )
)
