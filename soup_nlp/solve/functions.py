"""An NLP's functions for Ipopt: sums of machine code over its tables, behind CasADi's interface.

CasADi's own functions of an NLP (`assemble`) take the data of all tables as a parameter, which they
copy at every call, and take seconds to build at real sizes. Only the parameters theta are passed
here, the data stay in the tables.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.model.nlp import NLP
from soup_nlp.model.sums import Sums


@dataclass(frozen=True)
class Output:
    """One output of a `Buffered` function.

    Attributes:
        sparsity: Its nonzeros.
        evaluate: Their values from the function's inputs.
    """

    sparsity: ca.Sparsity
    evaluate: Callable[..., Float | float]


class Buffered(ca.Callback):
    """A CasADi function whose outputs are computed by functions of numpy arrays.

    Numbers are passed as buffers, without CasADi's own matrices.
    """

    def __init__(self, name: str, inputs: Mapping[str, int], outputs: Mapping[str, Output]) -> None:
        """Make the function.

        Args:
            name: Its name.
            inputs: Lengths of its inputs, vectors.
            outputs: Its outputs; only those that are asked for are computed.
        """
        ca.Callback.__init__(self)
        self._inputs, self._outputs = list(inputs.items()), list(outputs.items())
        self.construct(name, {})

    def get_n_in(self) -> int:
        """Inputs."""
        return len(self._inputs)

    def get_n_out(self) -> int:
        """Outputs."""
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        """Name of input i."""
        return self._inputs[i][0]

    def get_name_out(self, i: int) -> str:
        """Name of output i."""
        return self._outputs[i][0]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Shape of input i."""
        return ca.Sparsity.dense(self._inputs[i][1], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Nonzeros of output i."""
        return self._outputs[i][1].sparsity

    def has_eval_buffer(self) -> bool:
        """Numbers are passed as buffers."""
        return True

    def eval_buffer(
        self, arg: Sequence[memoryview | None], res: Sequence[memoryview | None]
    ) -> int:
        """Write the nonzeros of the outputs that are asked for."""
        given = [_array(a) for a in arg]
        for buffer, (_, output) in zip(res, self._outputs):
            if buffer is not None:
                _array(buffer)[:] = output.evaluate(*given)
        return 0


def _array(buffer: memoryview | None) -> Float:
    # numpy refuses a buffer without bytes
    return np.frombuffer(buffer, dtype=float) if buffer else np.zeros(0)


class Functions:
    """What Ipopt calls; theta is their only parameter p.

    The first call of the Hessian compiles it, because a start at a KKT point needs none.

    Attributes:
        oracle: (x, p) -> f, g.
        grad_f: (x, p) -> f, gradient.
        jac_g: (x, p) -> g, Jacobian.
        hess_lag: (x, p, lam_f, lam_g) -> upper triangle of the Lagrangian's Hessian.
    """

    def __init__(self, nlp: NLP) -> None:
        """Find the patterns; the Hessian is not compiled."""
        self._nlp = nlp
        # a copy, since theta is set here and the NLP's own sums keep theirs
        self._first = copy(nlp.sums)
        self._second: Sums | None = None
        at = {"x": nlp.nx, "p": len(nlp.theta)}
        f = Output(ca.Sparsity.dense(1, 1), lambda x, p: self._at(p).value(x))
        g = Output(ca.Sparsity.dense(nlp.ng, 1), lambda x, p: self._at(p).constraints(x)[0])
        gradient = Output(ca.Sparsity.dense(nlp.nx, 1), lambda x, p: self._at(p).gradient(x))
        jacobian = Output(
            nlp.jacobian_pattern.sparsity(), lambda x, p: self._at(p).constraints(x)[1]
        )
        hessian = Output(nlp.hessian_nonzeros.sparsity(), self._hessian)
        self.oracle = Buffered("nlp", at, {"f": f, "g": g})
        self.grad_f = Buffered("nlp_grad_f", at, {"f": f, "grad_f_x": gradient})
        self.jac_g = Buffered("nlp_jac_g", at, {"g": g, "jac_g_x": jacobian})
        self.hess_lag = Buffered(
            "nlp_hess_l", {**at, "lam_f": 1, "lam_g": nlp.ng}, {"triu_hess_gamma_x_x": hessian}
        )

    def _at(self, theta: Float) -> Sums:
        self._first.theta = theta.copy()
        return self._first

    def _hessian(self, x: Float, p: Float, lam_f: Float, lam_g: Float) -> Float:
        nlp = self._nlp
        if self._second is None:
            self._second = Sums(nlp, first_order=False, second_order=True)
        self._second.theta = p.copy()
        return self._second.hessian(x, lam_g, float(lam_f[0]))
