"""The Lagrangian's Hessian as Ipopt takes it, by the fastest way there is."""

from __future__ import annotations

import logging

import casadi as ca
import numpy as np

from soup_nlp.model.lanes import NoLanesError
from soup_nlp.model.nlp import NLP
from soup_nlp.model.sums import LaneSums

log = logging.getLogger(__name__)


def fast_hessian(nlp: NLP) -> ca.Function:
    """`hess_lag` of an NLP on vectors of elements; its own where that is impossible.

    Assembling CasADi's takes as long as all of Ipopt's iterations from a good start.
    """
    if nlp.compiled:
        try:
            return LaneHessian(nlp)
        except NoLanesError as error:
            log.info("no machine code on vectors: %s", error)
    return nlp.hess_lag


class LaneHessian(ca.Callback):
    """(x, p, lam_f, lam_g) -> upper triangle of the Lagrangian's Hessian; the kernels' data are
    those of the NLP, whatever p says beyond its leading parameters theta."""

    def __init__(self, nlp: NLP) -> None:
        """Compile it or take it from the cache.

        Raises:
            NoLanesError: That is not possible here.
        """
        ca.Callback.__init__(self)
        self._nlp = nlp
        self._sums = LaneSums(nlp, [nlp.hessian], first_order=False)
        self._pattern = self._sums.upper.sparsity()
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

    def eval(self, arg: list[ca.DM]) -> list[ca.DM]:
        """Its value."""
        thetas = len(self._nlp.theta)
        self._sums.p = np.asarray(arg[1][:thetas]).ravel()
        x, lam_g = (np.ascontiguousarray(np.asarray(arg[i]).ravel()) for i in (0, 3))
        values = self._sums.hessian(self._nlp.hessian, x, lam_g, float(arg[2]))
        return [ca.DM(self._pattern, values)]
