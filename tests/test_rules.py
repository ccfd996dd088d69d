"""The table of what every rule brings by family."""

import pytest

from soup_nlp.bench.analyses import ANALYSES, _restricted
from soup_nlp.bench.rules import SHIPPED, plot_rules, text_rules


def row(pair, family, variant, mre):
    return {
        "key": f"shared/{pair}",
        "suite": "shared",
        "pair": pair,
        "sequence": family,
        "flow": "dis",
        "variant": variant,
        "ok": mre is not None,
        "error": None if mre is not None else "stopped",
        "presets": ["paper"],
        "metrics": {"paper": {"solution": {"mre": mre}}},
        "cpu_seconds": 1.0,
        "machine": "x",
        "code": "0+0",
        "date": "2026-01-01",
        "settings": "s",
    }


@pytest.fixture
def rows():
    """The rule halves one pair of the first family and leaves the other; it costs 10 % elsewhere;
    in a third family it changes next to nothing, and a pair there failed."""
    mre = {
        ("a", "road"): (0.1, 0.2),
        ("b", "road"): (0.3, 0.3),
        ("c", "room"): (0.11, 0.1),
        ("d", "desk"): (0.1, 0.1005),
        ("e", "desk"): (0.1, None),
    }
    return [
        row(*name, variant, value)
        for name, values in mre.items()
        for variant, value in zip((SHIPPED, "ground"), values, strict=True)
    ]


def test_a_rule_is_judged_by_family(rows, tmp_path):
    text = text_rules("rules", "what rules bring", rows)
    (line,) = [s for s in text.splitlines() if s.startswith("| ground | `start.ground=false`")]
    # sqrt(0.5) = 0.707, 1.1, 0.995: their geometric mean is 0.918
    assert line.split("|")[3:6] == [" -8.2% ", " road -29% ", " room +10% "]
    assert "| ground | -29.3% | +10.0% | -0.5% |" in text
    assert "| a, dis | 0.1000 | 0.2000 |" in text
    plot_rules(tmp_path / "rules.png", rows)
    assert (tmp_path / "rules.png").read_bytes()[:4] == b"\x89PNG"


def test_a_rule_that_is_asked_for_alone_is_compared_with_everything():
    assert list(_restricted(ANALYSES["rules"], ["ground"]).variants) == [SHIPPED, "ground"]
