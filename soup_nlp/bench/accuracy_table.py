"""The page of a suite: tables by image, sequence and dataset, each with its protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from soup_nlp.bench.depth_maps import BASELINES, METHODS
from soup_nlp.bench.published import PROTOCOL, SOURCE, published
from soup_nlp.bench.tables import (
    energy_ratio,
    failures,
    mean,
    metric,
    page_text,
    provenance,
    show,
    table,
)
from soup_nlp.evaluate.metrics import ERRORS
from soup_nlp.evaluate.protocols import preset
from soup_nlp.storage.rows import Row

Group = tuple[str, str, list[Row]]
"""Name, flow, and the rows of both."""


def report(title: str, rows: Sequence[Row], note: str = "") -> str:
    """The page of the rows of one suite."""
    good = [r for r in rows if r.get("ok")]
    settings = ", ".join(sorted({str(r.get("settings")) for r in rows}))
    lines = [f"# {title}", ""]
    if note:
        lines += [note, ""]
    lines += [_verdict(good, len(rows)), ""]
    lines += [f"{provenance(rows)}; settings {settings} (one a flow source).", ""]
    conventions = list(dict.fromkeys(p for r in good for p in r["metrics"]))
    for name in sorted(conventions, key=lambda p: p != good[0]["presets"][0]):
        lines += _convention(name, [r for r in good if metric(r, name) is not None])
    lines += families(good)
    lines += _beaten_by(good)
    for name in dict.fromkeys(_own(r) for r in good):
        lines += _detail([r for r in good if name and _own(r) == name], name)
    for suite in dict.fromkeys(r["suite"] for r in rows):
        lines += _published(suite, [r for r in good if r["suite"] == suite and _own(r)])
    return page_text([*lines[:-1], *failures(rows)])


def _verdict(good: Sequence[Row], total: int) -> str:
    with_truth = [r for r in good if _own(r)]
    ahead = sum(not better_baselines(r) for r in with_truth)
    return (
        f"{len(good)} of {total} pairs measured, {sum(bool(r['good']) for r in good)} converged."
        f" The solution beats every baseline on {ahead} of {len(with_truth)}"
        " (MRE, each pair's own convention)."
    )


def _own(row: Row) -> str:
    """The first of a row's conventions under which it has numbers; "" if there is none."""
    return next((p for p in row["presets"] if metric(row, p) is not None), "")


def better_baselines(row: Row) -> dict[str, tuple[float, float]]:
    """MRE of the baselines that are not worse than the solution, and the solution's MRE.

    The baseline `rigid` is compared on the pixels where it has a depth.
    """
    name, out = _own(row), {}
    own, there = metric(row, name), metric(row, name, "solution_rigid")
    for baseline in BASELINES:
        theirs = metric(row, name, baseline)
        mine = there if baseline == "rigid" and there is not None else own
        if theirs is not None and mine is not None and not mine < theirs:
            out[baseline] = theirs, mine
    return out


def _groups(rows: Sequence[Row], by: Callable[[Row], str]) -> list[Group]:
    """Rows grouped by a name and the flow source."""
    out: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        out.setdefault((by(row), row["flow"]), []).append(row)
    return [(*key, own) for key, own in out.items()]


def families(rows: Sequence[Row]) -> list[str]:
    """Table of the solution by family (sequence) and flow: means, moving pixels, worst pair."""
    own = [r for r in rows if _own(r)]
    groups = _groups(own, lambda r: str(r["sequence"]))
    if len(groups) < 2:
        return []
    text = (
        "Means over the pairs, each under its own convention. Moving: pixels that move by"
        " themselves, where a mask or the true motion is known; scale: median of z / z_true of"
        " every moving component after the scale of the whole image (least, median, largest)."
    )
    head = ["family (pairs)", "flow", "MRE", "median", "d<1.25", "skill", "MRE moving"]
    head += ["MRE of the rest there", "scale of moving components", "skill < 0", "worst pair"]
    lines = [_family(*group) for group in (*groups, *_groups(own, lambda r: "all"))]
    return ["## By family", "", text, "", *table(head, lines), ""]


def _family(name: str, flow: str, rows: Sequence[Row]) -> list[str]:
    there = [m for r in rows if (m := r.get("moving"))]
    scales = [c["scale"] for m in there for c in m["components"]]
    spread = " ".join(f"{np.quantile(scales, q):.2f}" for q in (0, 0.5, 1)) if scales else ""
    errors = {r["pair"]: metric(r, _own(r)) or 0.0 for r in rows}
    worst = max(errors, key=lambda pair: errors[pair])
    below = np.mean([(metric(r, _own(r), name="skill") or 0.0) < 0 for r in rows])
    numbers = [
        mean(metric(r, _own(r), name=k) for r in rows)
        for k in ("mre", "median_relative", "delta1", "skill")
    ]
    numbers += [mean(m[k] for m in there) for k in ("mre", "rest")]
    return [
        *(f"{name} ({len(rows)})", flow, *map(show, numbers)),
        *(f"{spread} ({len(scales)})" if scales else "-", f"{below:.0%}"),
        f"{worst} {errors[worst]:.4f}",
    ]


def _beaten_by(rows: Sequence[Row]) -> list[str]:
    """Table of the baselines that are not worse than the solution."""
    lines = [
        [
            *(r["pair"], r["flow"], _own(r), baseline, show(theirs), show(mine)),
            *(show(metric(r, _own(r), baseline, "coverage"), ".1%"), show(theirs - mine, "+.4f")),
        ]
        for r in rows
        for baseline, (theirs, mine) in better_baselines(r).items()
    ]
    if not lines:
        return []
    head = ["pair", "flow", "convention", "baseline", "its MRE", "the solution's", "its pixels"]
    text = "The solution's MRE is on the pixels that the baseline has a depth for."
    return ["## Baselines that are better", "", text, "", *table([*head, "difference"], lines), ""]


def _convention(name: str, rows: Sequence[Row]) -> list[str]:
    """Tables of the MRE of every method under one convention, by image, sequence and dataset."""
    if not rows:
        return []
    methods = [m for m in METHODS if any(metric(r, name, m) is not None for r in rows)]

    cells = [*((m, "mre", ".4f") for m in methods), ("solution", "skill", ".3f")]
    cells += [("solution", "coverage", ".1%")]

    def lines(first: str, groups: Iterable[Group]) -> list[str]:
        body = [
            [title, flow, *(show(mean(metric(r, name, m, k) for r in own), f) for m, k, f in cells)]
            for title, flow, own in groups
        ]
        return table([first, "flow", *methods, "skill", "coverage"], body)

    text = preset(name).text
    out = [f"## MRE, {preset(name)}", "", f"{text[0].upper()}{text[1:]}.", ""]
    out += lines("pair", [(r["pair"], r["flow"], [r]) for r in rows])
    for title, groups in (
        ("sequence", _groups(rows, lambda r: f"{r['suite']} {r['sequence']}")),
        ("dataset", _groups(rows, lambda r: str(r["suite"]))),
    ):
        if len(groups) < len(rows):
            counted = [(f"{k} ({len(own)})", flow, own) for k, flow, own in groups]
            out += ["", f"Mean per {title}:", "", *lines(f"{title} (pairs)", counted)]
    fitted = [f"`{m}`" for m in ("plane", "floor") if m in methods]
    if fitted and (preset(name).cap is not None or preset(name).crop is not None):
        text = "fitted to all true pixels, not only to those that count here"
        out += ["", f"{' and '.join(fitted)}: {text}."]
    held = [c for r in rows if (c := metric(r, name, "rigid", "coverage")) is not None]
    if held:
        out += ["", f"`rigid` covers {min(held):.0%} to {max(held):.0%} of the true pixels."]
    return [*out, ""]


def _detail(rows: Sequence[Row], convention: str) -> list[str]:
    """Table of the solution's other errors, flow error, scene flow and energy."""
    if not rows:
        return []
    head = ["pair", "flow", "median", "SqRel", "RMSE", "log-RMSE", "d<1.25", "d<1.25^2"]
    head += ["d<1.25^3", "flow EPE px", "3D EPE (of length)", "bending", "E truth / solution"]
    lines = [
        [
            *(r["pair"], r["flow"], *(show(metric(r, convention, name=k)) for k in ERRORS[1:])),
            *(show((r["flow_error"] or {}).get("mean"), ".2f"), _moved(r["scene_flow"])),
            *(show(r.get("bending_share"), ".2f"), show(energy_ratio(r), ".3f")),
            *(str(r["status"]), f"{r['cpu_seconds']:.0f}"),
        ]
        for r in rows
    ]
    title = f"## The solution, {preset(convention)}"
    return [title, "", *table([*head, "status", "s"], lines), ""]


def _moved(error: Mapping[str, float] | None) -> str:
    """3D end-point error, and in brackets the mean length of the true scene flow."""
    if not error:
        return "-"
    return f"{show(error['mean'], '.3g')} ({show(error['mean_truth_length'], '.3g')})"


def _published(suite: str, rows: Sequence[Row]) -> list[str]:
    numbers, about = published(suite)
    if not numbers:
        return []
    lines = [[f"{m} (published)", show(v)] for m, v in numbers.items()]
    measured = _groups(rows, _own)
    for name, flow, group in measured:
        count = f"{len(group)} pair{'' if len(group) == 1 else 's'}"
        own = mean(metric(r, name) for r in group)
        lines.append([f"this program, flow {flow}, {name}, {count} (measured)", show(own)])
    text = f"Published rows are copied, not measured: {SOURCE}. {PROTOCOL}. {about}."
    text += "".join(f" Measured: {preset(n)}." for n in dict.fromkeys(n for n, _, _ in measured))
    head = f"## {suite} beside published numbers"
    return [head, "", *table(["method", "MRE"], lines), "", text, ""]
