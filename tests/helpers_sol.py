"""A writer of AMPL's .sol text format, to play the part of a solver."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_sol(
    path: Path,
    x: np.ndarray,
    lam_g: np.ndarray | None,
    variables: np.ndarray,
    rows: np.ndarray,
    message: str = "",
    code: int = 0,
) -> None:
    """Write an answer as a .sol file.

    Args:
        path: The file.
        x: (nx,) point, in the order of the NLP.
        lam_g: (ng,) multipliers in CasADi's sign, or None.
        variables: (nx,) order of the .nl file, see `NLFile`.
        rows: (ng,) order of the .nl file.
        message: First lines; empty lines are left out, and one that would end it is quoted.
        code: solve_result_num, 0 solved, 400 limit.
    """
    duals = [] if lam_g is None else [repr(-v) for v in lam_g[rows].tolist()]
    head = [line for line in message.splitlines() if line.strip()]
    head = [f'"{line.strip()}"' if line.strip() == "Options" else line for line in head]
    sizes = (len(rows), len(duals), len(variables), len(variables))
    values = [repr(v) for v in np.asarray(x, float)[variables].tolist()]
    lines = [*head, "", "Options", "3", "0", "1", "0", *map(str, sizes), *duals, *values]
    path.write_text("\n".join([*lines, f"objno 0 {code}"]) + "\n")
