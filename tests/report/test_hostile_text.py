"""Names and units with lines, escapes and HTML: refused at the door, harmless at every exit."""

import json
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers_result import CERTAINTY, small_result

from soup_nlp.cli.main import print_warning
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.pair import Flow, Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.geometry.rotation import RigidMotion
from soup_nlp.report.chain import Chain
from soup_nlp.report.figures import strip
from soup_nlp.report.formats import FORMATS
from soup_nlp.report.models import write_ply
from soup_nlp.report.page import page
from soup_nlp.report.pictures import Picture
from soup_nlp.storage.files import read_json

HOSTILE = "m\nend_header\r\x1b[31m\u2028\u202e<img src=x onerror=alert(1)>\x85\ud800"
IMAGE = np.zeros((8, 8, 3), np.uint8)


@pytest.mark.parametrize("text", [HOSTILE, "", "a\nb", "\x1b[31m", "\u202e", "x" * 101, 3, None])
def test_a_name_or_unit_is_one_line_of_text(text: object) -> None:
    with pytest.raises(DataError, match=r"unit of the truth[\s\S]*expected: 1 to 100 printable"):
        Truth(unit=text)
    with pytest.raises(DataError, match=r"name of the pair[\s\S]*expected: 1 to 100 printable"):
        Pair(IMAGE, IMAGE, (8, 8, 3.5, 3.5), name=text)


def test_text_of_a_flow_and_of_a_stored_file_is_one_line(tmp_path: Path) -> None:
    assert str(Flow(np.zeros((2, 2, 2)), source=HOSTILE)).isprintable()
    (tmp_path / "a.json").write_text(json.dumps({"unit": HOSTILE, HOSTILE: [HOSTILE]}))
    stored = read_json(tmp_path / "a.json", "a", dict[str, Any])
    assert all(text.isprintable() for text in (stored["unit"], *stored, *stored[[*stored][1]]))


def test_text_leaves_no_file_broken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    count = write_ply(tmp_path / "a.ply", np.ones((5, 3)), np.ones((5, 3)), comments=[HOSTILE])
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    assert count == 5
    assert len(body) == 5 * (12 + 3)
    assert [line.split()[0] for line in header.decode("ascii").splitlines()].count("comment") == 1
    chain = SimpleNamespace(unit=HOSTILE, world_from_camera=[RigidMotion(np.eye(3), np.zeros(3))])
    FORMATS["tum"].whole["trajectory.tum"](tmp_path / "a.tum", chain)
    lines = (tmp_path / "a.tum").read_text().splitlines()
    assert [line[0] for line in lines] == ["#", "#", "0"]
    name = HOSTILE.replace("\ud800", "")
    told = {"name": name, "status": name, "converged": False, "certainty": CERTAINTY}
    told |= {"sources": [name] * 2, "verdict": [name]}
    shown = page(replace(Chain.of(small_result()), summary=told))
    assert "<img src" not in shown
    assert "&lt;img src" in shown
    assert strip([Picture(HOSTILE, IMAGE)], HOSTILE).size
    with warnings.catch_warnings():
        print_warning(name, DataWarning)
    said = capsys.readouterr().err
    assert said.removesuffix("\n").isprintable()
