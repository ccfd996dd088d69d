"""The Lagrangian's Hessian for Ipopt, compiled when it is first evaluated."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from soup_nlp.model.nlp import NLP
from soup_nlp.model.sums import Sums


class LagrangianHessian(ca.Callback):
    """(x, p, lam_f, lam_g) -> upper triangle of the Lagrangian's Hessian.

    It reads the leading parameters theta of p; the data come from the NLP's tables. The first call
    compiles it, because a start at a KKT point needs no Hessian.
    """

    def __init__(self, nlp: NLP) -> None:
        """Find the pattern; nothing is compiled."""
        ca.Callback.__init__(self)
        self._nlp = nlp
        self._sums: Sums | None = None
        self._pattern = nlp.hessian_pattern.sparsity()
        self.construct("nlp_hess_l", {})

    def get_n_in(self) -> int:
        """x, p, lam_f, lam_g."""
        return 4

    def get_n_out(self) -> int:
        """The nonzeros of the upper triangle."""
        return 1

    def get_name_in(self, i: int) -> str:
        """Name of input i."""
        return ("x", "p", "lam_f", "lam_g")[i]

    def get_name_out(self, i: int) -> str:
        """Name of output i."""
        return "triu_hess_gamma_x_x"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Shape of input i."""
        return ca.Sparsity.dense((self._nlp.nx, len(self._nlp.p), 1, self._nlp.ng)[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Pattern of the Hessian."""
        return self._pattern

    def has_eval_buffer(self) -> bool:
        """Numbers are passed as buffers, without CasADi's own matrices."""
        return True

    def eval_buffer(self, arg: Sequence[memoryview], res: Sequence[memoryview]) -> int:
        """Write the nonzeros of the Hessian."""
        nlp = self._nlp
        if self._sums is None:
            self._sums = Sums(nlp, [nlp.hessian], first_order=False)
        x, p, lam_f, lam_g = (np.frombuffer(a, dtype=float) for a in arg)
        self._sums.theta = p[: len(nlp.theta)].copy()
        out = np.frombuffer(res[0], dtype=float)
        out[:] = self._sums.hessian(nlp.hessian, x, lam_g, float(lam_f[0]))
        return 0
