"""The summary of a chain that the terminal shows."""

from __future__ import annotations

import numpy as np

from soup_nlp.sequence.chain import Chain
from soup_nlp.sequence.score import score


def table(chain: Chain) -> str:
    """Scales, links and, with a truth, errors of a chain, in lines."""
    s = score(chain)
    found = {} if s is None else {tuple(k["pairs"]): k["true"] for k in s["links"]}
    lines = [str(chain), f"{'pairs':<10}{'ratio':>8}{'spread':>8}{'truth':>8}{'pixels':>9}"]
    for k in chain.links:
        true = found.get((k.first, k.second))
        lines.append(
            f"{f'{k.first}, {k.second}':<10}{np.exp(k.log_ratio):>8.3f}{k.spread:>8.3f}"
            f"{'' if true is None else f'{true:.3f}':>8}{k.pixels:>9}"
            + ("  bridge" if k.bridge else "  a guess: no parallax" if k.flagged else "")
        )
    followed = {t for own in chain.tracks for t in own.values()} - {0}
    long = [t for t in followed if len(chain.path(t)) > 2]
    lines.append(f"tracks      {len(long)} components followed over two pairs or more")
    if s is not None:
        lines.append(
            f"accuracy    MRE {s['mre_own_scale']:.4f} with a scale for every frame,"
            f" {s['mre_one_scale']:.4f} with one for the sequence ({s['cost']:+.1%})"
        )
        if s["path"]:
            p = s["path"]
            lines.append(
                f"path        error {p['rmse']:.3g} of {p['length']:.3g} after a similarity"
                f" ({p['share']:.2%})"
            )
    return "\n".join(lines)
