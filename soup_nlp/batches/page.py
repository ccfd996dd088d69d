"""index.html of a batch: means with intervals, and a sortable table with thumbnails."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

import numpy as np

from soup_nlp.report.result import PAGE
from soup_nlp.storage.each import failed, reason

HEADS = ("", "pair", "MRE", "constant", "drawn", "seconds", "MB", "exit", "reason")
NUMBERS = {"mre": ".4f", "constant": ".4f", "drawn": ".0%", "seconds": ".0f"}
DRAWS = 2000
"""Draws of the bootstrap."""
HTML = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Batch</title>
<style>
body {{ font: 15px/1.4 system-ui, sans-serif; margin: 1.5em; color: #222; background: #fff }}
table {{ border-collapse: collapse }}
th, td {{ padding: .3em .7em; border-bottom: 1px solid #ddd; text-align: right }}
th {{ cursor: pointer; position: sticky; top: 0; background: #fff }}
td:nth-child(2), td:last-child {{ text-align: left }}
img {{ height: 60px; display: block }}
.bad {{ color: #a00 }}
</style>
<h1>Batch</h1>
<p>{summary}</p>
<table><thead><tr>{heads}</tr></thead><tbody>
{rows}
</tbody></table>
<script>
document.querySelectorAll("th").forEach((head, k) => head.onclick = () => {{
  const body = document.querySelector("tbody"), up = head.dataset.up !== "1";
  head.dataset.up = up ? "1" : "0";
  const key = row => row.cells[k].dataset.value ?? row.cells[k].textContent;
  [...body.rows].sort((a, b) => (up ? 1 : -1) *
    key(a).localeCompare(key(b), undefined, {{numeric: true}})).forEach(row => body.append(row));
}});
</script>
"""


def interval(values: Sequence[float], statistic: Any) -> tuple[float, float, float]:
    """A statistic of values and its 95 % bootstrap interval."""
    x = np.asarray(values, float)
    draws = np.random.default_rng(0).integers(0, len(x), (DRAWS, len(x)))
    low, high = np.quantile(statistic(x[draws], axis=1), [0.025, 0.975])
    return float(statistic(x)), float(low), float(high)


def summary(rows: Sequence[Mapping[str, Any]], total: int) -> str:
    """Number of pairs, and mean and median of the MRE with intervals, where truth is known."""
    bad = sum(failed(row) for row in rows)
    parts = [f"{len(rows)} of {total} pairs" + (f", {bad} failed" if bad else "")]
    known = [float(row["mre"]) for row in rows if row.get("mre") is not None]
    if known:
        for name, statistic in (("mean", np.mean), ("median", np.median)):
            value, low, high = interval(known, statistic)
            parts.append(f"MRE {name} {value:.4f} ({low:.4f} to {high:.4f})")
        parts.append(f"{len(known)} pairs with truth; in brackets 95 % intervals (bootstrap)")
    return "; ".join(parts)


def page(rows: Sequence[Mapping[str, Any]], total: int) -> str:
    """The page of the rows so far, of `total` pairs."""
    lines = []
    for row in rows:
        place, bad = f"pairs/{quote(str(row['pair']))}", failed(row)
        name = escape(str(row["pair"]))
        shown = "" if bad else f'<img loading="lazy" alt="" src="{place}/depth_ref_colour.png">'
        size = row.get("peak_bytes")
        cells = [
            *(_number(row.get(name), form) for name, form in NUMBERS.items()),
            _number(size and size / 2**20, ".0f"),
            f"<td>{2 if bad else row.get('exit_code')}</td>",
            f"<td>{escape(reason(row) if bad else str(row.get('reason')))}</td>",
        ]
        label = name if bad else f'<a href="{place}/{PAGE}">{name}</a>'
        first = f'<tr class="{"bad" if bad else ""}"><td>{shown}</td>'
        lines.append("".join([first, f'<td data-value="{name}">{label}</td>', *cells, "</tr>"]))
    heads = "".join(f"<th>{head}</th>" for head in HEADS)
    return HTML.format(summary=escape(summary(rows, total)), heads=heads, rows="\n".join(lines))


def _number(value: float | None, form: str) -> str:
    if value is None:
        return '<td data-value="">-</td>'
    return f'<td data-value="{value:.9f}">{format(value, form)}</td>'
