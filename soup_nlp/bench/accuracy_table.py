"""Rows as tables: per image, per sequence, per dataset, the protocol beside every number."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import date

import numpy as np

from soup_nlp.bench.accuracy import Row
from soup_nlp.bench.published import PROTOCOL, SOURCE, data_note, published
from soup_nlp.bench.rivals import METHODS, RIVALS
from soup_nlp.evaluate.protocols import preset

Number = float | None


def get(row: Row, convention: str, method: str, name: str = "mre") -> Number:
    """A number of a row; None where it is not known."""
    if not row.get("ok"):
        return None
    value = row["metrics"].get(convention, {}).get(method, {}).get(name)
    return None if value is None else float(value)


def mean(values: Iterable[Number]) -> Number:
    """Mean of what is known; None where nothing is."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def show(value: Number, form: str = ".4f") -> str:
    """A number, or a dash."""
    return "-" if value is None else format(value, form)


def reason(row: Row) -> str:
    """Why a row failed, on one line: what was wrong, where it was and what was found there."""
    first, *more = str(row.get("error")).splitlines() or ["no reason"]
    told = (line.strip() for line in more)
    return ", ".join([first, *(t for t in told if t.startswith(("where: ", "found: ")))])


def pair_names(rows: Sequence[Row]) -> list[str]:
    """The pair of every row; with its suite where another suite has a pair of that name."""
    suites: dict[str, set[str]] = {}
    for row in rows:
        suites.setdefault(row["pair"], set()).add(row["suite"])
    alone = {name for name, own in suites.items() if len(own) == 1}
    return [r["pair"] if r["pair"] in alone else f"{r['suite']} {r['pair']}" for r in rows]


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    rule = ["---"] + ["---:"] * (len(head) - 1)
    return ["| " + " | ".join(cells) + " |" for cells in [head, rule, *lines]]


def report(title: str, rows: Sequence[Row], note: str = "") -> str:
    """Everything that is known of some rows of one suite.

    Args:
        title: Headline.
        rows: Rows; failed ones are listed.
        note: A line on what was run.
    """
    good = [r for r in rows if r.get("ok")]
    main = next(iter(good[0]["presets"])) if good else "paper"
    lines = [f"# {title}", ""]
    if note:
        lines += [note, ""]
    lines += [f"{_verdict(good, len(rows))}", "", _made(rows), ""]
    conventions = list(dict.fromkeys(p for r in good for p in r["metrics"]))
    for name in sorted(conventions, key=lambda p: p != main):
        lines += _convention(name, good)
    lines += _beaten_by(good)
    for name in dict.fromkeys(_own(r) for r in good):
        lines += _detail([r for r in good if _own(r) == name], name)
    suites = list(dict.fromkeys(r["suite"] for r in rows))
    for suite in suites:
        lines += _published(suite, [r for r in good if r["suite"] == suite])
    bad = [r for r in rows if not r.get("ok")]
    if bad:
        lines += ["## Failed", ""]
        lines += [f"- {r['key']}: {reason(r)}" for r in bad]
    return "\n".join(lines).rstrip() + "\n"


def _verdict(good: Sequence[Row], total: int) -> str:
    with_truth = [r for r in good if _own(r)]
    ahead = sum(not better_rivals(r) for r in with_truth)
    return (
        f"{len(good)} of {total} pairs measured, {sum(bool(r['good']) for r in good)} converged."
        f" The solution beats every rival on {ahead} of {len(with_truth)}"
        " (MRE, each pair's own convention)."
    )


def _own(row: Row) -> str:
    """The first of a row's conventions under which it has numbers; "" without."""
    return next((p for p in row["presets"] if get(row, p, "solution") is not None), "")


def better_rivals(row: Row) -> dict[str, tuple[float, float]]:
    """Rivals that are as good as the solution or better: their MRE and the solution's.

    `rigid` is met on the pixels where it has a depth.
    """
    name, out = _own(row), {}
    own, there = get(row, name, "solution"), get(row, name, "solution_rigid")
    for rival in RIVALS:
        theirs = get(row, name, rival)
        mine = there if rival == "rigid" and there is not None else own
        if theirs is not None and mine is not None and not mine < theirs:
            out[rival] = theirs, mine
    return out


def _beaten_by(rows: Sequence[Row]) -> list[str]:
    """Where a rival is better."""
    lines = []
    for r in rows:
        for rival, (theirs, mine) in better_rivals(r).items():
            cover = get(r, _own(r), rival, "coverage")
            cells = [
                rival,
                show(theirs),
                show(mine),
                show(cover, ".1%"),
                show(theirs - mine, "+.4f"),
            ]
            lines.append([r["pair"], r["flow"], _own(r), *cells])
    if not lines:
        return []
    head = ["pair", "flow", "convention", "rival", "its MRE", "the solution's", "its pixels"]
    text = "The solution's MRE is on the pixels that the rival has a depth for."
    return ["## Rivals that are better", "", text, "", *table([*head, "difference"], lines), ""]


def _made(rows: Sequence[Row]) -> str:
    codes = ", ".join(sorted({str(r.get("code")) for r in rows}))
    settings = ", ".join(sorted({str(r.get("settings")) for r in rows}))
    cpu = sum(float(r.get("cpu_seconds") or 0) for r in rows)
    return (
        f"{date.today()}, {platform.machine()}, {cpu:.0f} CPU seconds in all;"
        f" code {codes}; settings {settings} (one a flow source)."
    )


def _present(rows: Sequence[Row], convention: str) -> list[str]:
    return [m for m in METHODS if any(get(r, convention, m) is not None for r in rows)]


def _convention(name: str, rows: Sequence[Row]) -> list[str]:
    """MRE of every method under one convention: per image, per sequence, per dataset."""
    own = [r for r in rows if get(r, name, "solution") is not None]
    if not own:
        return []
    methods = _present(own, name)
    head = ["pair", "flow", *methods, "skill", "coverage"]

    def cells(group: Sequence[Row]) -> list[str]:
        numbers = [mean(get(r, name, m) for r in group) for m in methods]
        skill = mean(get(r, name, "solution", "skill") for r in group)
        cover = mean(get(r, name, "solution", "coverage") for r in group)
        return [*map(show, numbers), show(skill, ".3f"), show(cover, ".1%")]

    text = preset(name).text
    lines = [f"## MRE, {preset(name)}", "", f"{text[0].upper()}{text[1:]}.", ""]
    lines += table(head, [[r["pair"], r["flow"], *cells([r])] for r in own])
    for title, group_by in (("sequence", _sequence), ("dataset", _suite)):
        groups = _groups(own, group_by)
        if len(groups) < len(own):
            lines += ["", f"Mean per {title}:", ""]
            lines += table(
                [f"{title} (pairs)", *head[1:]],
                [[f"{k[0]} ({len(g)})", k[1], *cells(g)] for k, g in groups.items()],
            )
    fitted = [f"`{m}`" for m in ("plane", "floor") if m in methods]
    if fitted and (preset(name).cap is not None or preset(name).crop is not None):
        told = "fitted to all true pixels, not only to those that count here"
        lines += ["", f"{' and '.join(fitted)}: {told}."]
    held = [r["metrics"][name]["rigid"]["coverage"] for r in own if "rigid" in r["metrics"][name]]
    if held:
        lines += ["", f"`rigid` covers {min(held):.0%} to {max(held):.0%} of the true pixels."]
    return [*lines, ""]


def _sequence(row: Row) -> tuple[str, str]:
    return f"{row['suite']} {row['sequence']}", row["flow"]


def _suite(row: Row) -> tuple[str, str]:
    return row["suite"], row["flow"]


def _groups(
    rows: Sequence[Row], by: Callable[[Row], tuple[str, str]]
) -> dict[tuple[str, str], list[Row]]:
    out: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        out.setdefault(by(row), []).append(row)
    return out


def _detail(rows: Sequence[Row], convention: str) -> list[str]:
    """The solution's other errors, its flow, scene flow and energy."""
    own = [r for r in rows if get(r, convention, "solution") is not None]
    if not own:
        return []
    names = ("median_relative", "sq_rel", "rmse", "log_rmse", "delta1", "delta2", "delta3")
    head = ["pair", "flow", "median", "SqRel", "RMSE", "log-RMSE", "d<1.25", "d<1.25^2"]
    head += ["d<1.25^3", "flow EPE px", "3D EPE (of length)", "bending", "E truth / solution"]
    head += ["status", "s"]
    lines = []
    for r in own:
        numbers = [show(get(r, convention, "solution", k)) for k in names]
        flow = (r["flow_error"] or {}).get("mean")
        sf = r["scene_flow"]
        moved = f"{show(sf['mean'], '.3g')} ({show(sf['mean_truth_length'], '.3g')})" if sf else "-"
        lines.append(
            [
                *[r["pair"], r["flow"], *numbers, show(flow, ".2f"), moved],
                show(r.get("bending_share"), ".2f"),
                show(energy_ratio(r), ".3f"),
                str(r["status"]),
                f"{r['cpu_seconds']:.0f}",
            ]
        )
    text = f"## The solution, {preset(convention)}"
    return [text, "", *table(head, lines), ""]


def energy_ratio(row: Row) -> Number:
    """E(truth) / E(solution); None where the truth has no soup."""
    energy: Mapping[str, Mapping[str, float]] = row["energy"]
    if "truth" not in energy or not energy["solution"]["total"]:
        return None
    return energy["truth"]["total"] / energy["solution"]["total"]


def _published(suite: str, rows: Sequence[Row]) -> list[str]:
    numbers = published(suite)
    if not numbers:
        return []
    lines = [[f"{m} (published)", show(v)] for m, v in numbers.items()]
    measured = _groups([r for r in rows if _own(r)], lambda r: (r["flow"], _own(r)))
    for (flow, name), group in measured.items():
        own = mean(get(r, name, "solution") for r in group)
        who = f"this program, flow {flow}, {name}, {_count(group)} (measured)"
        lines.append([who, show(own)])
    text = f"Published rows are copied, not measured: {SOURCE}. {PROTOCOL}. {data_note(suite)}."
    text += "".join(f" Measured: {preset(name)}." for name in dict.fromkeys(n for _, n in measured))
    head = f"## {suite} beside published numbers"
    return [head, "", *table(["method", "MRE"], lines), "", text, ""]


def _count(pairs: Sequence[Row]) -> str:
    return f"{len(pairs)} pair{'' if len(pairs) == 1 else 's'}"
