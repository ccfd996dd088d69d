"""The NLP in two more forms: CasADi's serialised functions, and HDF5 of everything at the start."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from soup_nlp.model.nlp import NLP, to_scipy
from soup_nlp.storage.atomic import atomic_path
from soup_nlp.storage.store import Array, Tree, write_h5

Float = NDArray[np.float64]

FORMATS = ("nl", "casadi", "h5")
FUNCTIONS = ("oracle", "grad_f", "jac_g", "hess_lag")


def write_casadi(folder: Path, nlp: NLP) -> list[str]:
    """Write `oracle.casadi` and the other functions; `casadi.Function.load` reads them.

    The NLP must be built with `compiled=False`. Inputs are (x, p), for the Hessian (x, p, lam_f,
    lam_g); p, x0 and the bounds are what `write_start_h5` writes.

    Returns:
        Names of the files.
    """
    names = []
    for name in FUNCTIONS:
        with atomic_path(folder / f"{name}.casadi") as temporary:
            getattr(nlp, name).save(str(temporary))
        names.append(f"{name}.casadi")
    return names


def write_start_h5(
    path: Path, nlp: NLP, names: tuple[list[str], list[str]], attrs: dict[str, object]
) -> None:
    """Write sizes, bounds, parameters, sparsities and values at the start.

    Args:
        path: The .h5 file.
        nlp: The NLP; its Hessian is written as it is, with lam_f = 1 and lam_g = 1.
        names: Of variables and constraints.
        attrs: Root attributes.
    """
    f, grad = nlp.grad_f(nlp.x0, nlp.p)
    g, jac = nlp.jac_g(nlp.x0, nlp.p)
    hess = nlp.hess_lag(nlp.x0, nlp.p, 1.0, np.ones(nlp.ng))

    def vector(value: object, text: str, letter: str) -> Array:
        return Array(np.asarray(value, float).ravel(), "1", text, letter)

    def matrix(value: object, text: str) -> dict[str, Array]:
        m = to_scipy(value).tocoo()
        return {
            "row": Array(m.row.astype(np.int64), "1", "row of every entry", "Z"),
            "column": Array(m.col.astype(np.int64), "1", "column of every entry", "Z"),
            "value": Array(m.data, "1", text, "Z"),
            "shape": Array(np.array(m.shape), "1", "rows, columns", "2"),
        }

    tree: Tree = {
        "x0": vector(nlp.x0, "start", "X"),
        "lbx": vector(nlp.lbx, "lower bounds", "X"),
        "ubx": vector(nlp.ubx, "upper bounds", "X"),
        "lbg": vector(nlp.lbg, "lower bounds of g", "G"),
        "ubg": vector(nlp.ubg, "upper bounds of g", "G"),
        "p": vector(nlp.p, "parameters of the functions", "P"),
        "x_names": Array(np.array(names[0]), "1", "variables", "X"),
        "g_names": Array(np.array(names[1]), "1", "constraints", "G"),
        "at_start": {
            "f": Array(np.float64(f), "1", "objective"),
            "g": vector(g, "constraints", "G"),
            "grad_f": vector(grad, "gradient of the objective", "X"),
            "jac_g": matrix(jac, "Jacobian of g"),
            "hess_lag": matrix(hess, f"triu Hessian, lam_f = lam_g = 1 ({nlp.hessian})"),
        },
    }
    write_h5(path, tree, attrs)
