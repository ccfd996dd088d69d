"""Writing of answers in the .sol text format of AMPL."""

from pathlib import Path

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.export.sol import OPTIONS
from soup_nlp.export.template import number
from soup_nlp.storage.files import write_text


def write_sol(
    path: str | Path,
    x: Float,
    lam_g: Float | None,
    variables: Int,
    rows: Int,
    message: str = "",
    code: int = 0,
) -> None:
    """Write an answer as a .sol file.

    Args:
        path: The file.
        x: (nx,) point, in the order of the NLP.
        lam_g: (ng,) multipliers in CasADi's sign, or None.
        variables: (nx,) order of the variables, see `NLFile`.
        rows: (ng,) order of the rows.
        message: First lines; empty lines are left out, and a line "Options" is quoted.
        code: solve_result_num, such as 0 for solved and 400 for a limit.
    """
    duals = [] if lam_g is None else [number(-v) for v in lam_g[rows].tolist()]
    head = [line for line in message.splitlines() if line.strip()]
    head = [f'"{line.strip()}"' if line.strip() == OPTIONS else line for line in head]
    sizes = (len(rows), len(duals), len(variables), len(variables))
    values = [number(v) for v in np.asarray(x, float)[variables].tolist()]
    lines = [*head, "", OPTIONS, "3", "0", "1", "0", *map(str, sizes), *duals, *values]
    write_text(path, "\n".join([*lines, f"objno 0 {code}"]) + "\n")
