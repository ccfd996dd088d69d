"""Rows as tables: per image, per sequence, per dataset, the protocol beside every number."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from soup_nlp.bench.depth_maps import BASELINES, METHODS
from soup_nlp.bench.published import PROTOCOL, SOURCE, data_note, published
from soup_nlp.bench.rows import Row
from soup_nlp.bench.tables import energy_ratio, failures, get, joined, made, mean, show, table
from soup_nlp.evaluate.protocols import preset


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
    lines += families(good)
    lines += _beaten_by(good)
    for name in dict.fromkeys(_own(r) for r in good):
        lines += _detail([r for r in good if _own(r) == name], name)
    suites = list(dict.fromkeys(r["suite"] for r in rows))
    for suite in suites:
        lines += _published(suite, [r for r in good if r["suite"] == suite])
    return joined([*lines[:-1], *failures(rows)])


def _verdict(good: Sequence[Row], total: int) -> str:
    with_truth = [r for r in good if _own(r)]
    ahead = sum(not better_baselines(r) for r in with_truth)
    return (
        f"{len(good)} of {total} pairs measured, {sum(bool(r['good']) for r in good)} converged."
        f" The solution beats every baseline on {ahead} of {len(with_truth)}"
        " (MRE, each pair's own convention)."
    )


def _own(row: Row) -> str:
    """The first of a row's conventions under which it has numbers; "" without."""
    return next((p for p in row["presets"] if get(row, p, "solution") is not None), "")


def better_baselines(row: Row) -> dict[str, tuple[float, float]]:
    """Baselines that are as good as the solution or better: their MRE and the solution's.

    `rigid` is met on the pixels where it has a depth.
    """
    name, out = _own(row), {}
    own, there = get(row, name, "solution"), get(row, name, "solution_rigid")
    for baseline in BASELINES:
        theirs = get(row, name, baseline)
        mine = there if baseline == "rigid" and there is not None else own
        if theirs is not None and mine is not None and not mine < theirs:
            out[baseline] = theirs, mine
    return out


def families(rows: Sequence[Row]) -> list[str]:
    """The solution by family (sequence) and flow and in all: means, moving pixels, worst pair."""
    own = [r for r in rows if _own(r)]
    groups = _groups(own, lambda r: (r["sequence"], r["flow"]))
    if len(groups) < 2:
        return []
    flows = dict.fromkeys(r["flow"] for r in own)
    groups |= {("all", flow): [r for r in own if r["flow"] == flow] for flow in flows}
    lines = [[f"{k} ({len(g)})", flow, *_family(g)] for (k, flow), g in groups.items()]
    head = ["family (pairs)", "flow", "MRE", "median", "d<1.25", "skill", "MRE moving"]
    head += ["MRE of the rest there", "scale of moving components", "skill < 0", "worst pair"]
    text = (
        "Means over the pairs, each under its own convention. Moving: pixels that move by"
        " themselves, where a mask or the true motion is known; scale: median of z / z_true of"
        " every moving component after the scale of the whole image (least, median, largest)."
    )
    return ["## By family", "", text, "", *table(head, lines), ""]


def _family(rows: Sequence[Row]) -> list[str]:
    def average(name: str) -> str:
        return show(mean(get(r, _own(r), "solution", name) for r in rows))

    there = [m for r in rows if (m := r.get("moving"))]
    scales = [c["scale"] for m in there for c in m["components"]]
    spread = " ".join(f"{np.quantile(scales, q):.2f}" for q in (0, 0.5, 1)) if scales else "-"
    errors = {r["pair"]: get(r, _own(r), "solution") or 0.0 for r in rows}
    worst = max(errors, key=lambda name: errors[name])
    below = np.mean([(get(r, _own(r), "solution", "skill") or 0.0) < 0 for r in rows])
    return [
        *map(average, ("mre", "median_relative", "delta1", "skill")),
        *(show(mean(m[k] for m in there)) for k in ("mre", "rest")),
        f"{spread} ({len(scales)})" if scales else "-",
        f"{below:.0%}",
        f"{worst} {errors[worst]:.4f}",
    ]


def _beaten_by(rows: Sequence[Row]) -> list[str]:
    """Where a baseline is better."""
    lines = []
    for r in rows:
        for baseline, (theirs, mine) in better_baselines(r).items():
            cover = get(r, _own(r), baseline, "coverage")
            cells = [
                baseline,
                show(theirs),
                show(mine),
                show(cover, ".1%"),
                show(theirs - mine, "+.4f"),
            ]
            lines.append([r["pair"], r["flow"], _own(r), *cells])
    if not lines:
        return []
    head = ["pair", "flow", "convention", "baseline", "its MRE", "the solution's", "its pixels"]
    text = "The solution's MRE is on the pixels that the baseline has a depth for."
    return ["## Baselines that are better", "", text, "", *table([*head, "difference"], lines), ""]


def _made(rows: Sequence[Row]) -> str:
    settings = ", ".join(sorted({str(r.get("settings")) for r in rows}))
    return f"{made(rows)}; settings {settings} (one a flow source)."


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
