"""What `nlpsol` calls, as CasADi callbacks: the functions of an NLP.

CasADi's own graph of an NLP (`export.symbolic`) takes the data of all tables as a parameter,
which it copies at every call, and takes seconds to build at real sizes. Only theta is one here.
"""

from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.model.nlp import NLP

Output = tuple[ca.Sparsity, Callable[..., Float | float]]
"""Nonzeros of an output of a `Buffered` function, and what computes them from its inputs."""


class Buffered(ca.Callback):
    """A CasADi function whose outputs are computed by functions of numpy arrays.

    Numbers are passed as buffers, without CasADi's own matrices.
    """

    def __init__(self, name: str, inputs: Mapping[str, int], outputs: Mapping[str, Output]) -> None:
        """Inputs are vectors of these lengths; only outputs that are asked for are computed."""
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
        return self._outputs[i][1][0]

    def has_eval_buffer(self) -> bool:
        """Numbers are passed as buffers."""
        return True

    def eval_buffer(
        self, arg: Sequence[memoryview | None], res: Sequence[memoryview | None]
    ) -> int:
        """Write the nonzeros of the outputs that are asked for."""
        given = [_array(a) for a in arg]
        for buffer, (_, (_, evaluate)) in zip(res, self._outputs):
            if buffer is not None:
                _array(buffer)[:] = evaluate(*given)
        return 0


def _array(buffer: memoryview | None) -> Float:
    # numpy refuses a buffer without bytes
    return np.frombuffer(buffer, dtype=float) if buffer else np.zeros(0)


class Functions:
    """The functions of an NLP; theta is their only parameter p. Keep this while they are in use.

    Attributes:
        oracle: (x, p) -> f, g.
        derivatives: Options of `nlpsol` that spare it the derivation: gradient, Jacobian, and the
            upper triangle of the Lagrangian's Hessian.
    """

    def __init__(self, nlp: NLP) -> None:
        """Find the patterns; kernels are translated by the first call."""
        at = {"x": nlp.nx, "p": len(nlp.theta)}
        f = ca.Sparsity.dense(1, 1), nlp.value
        g = ca.Sparsity.dense(nlp.ng, 1), nlp.constraints
        gradient = ca.Sparsity.dense(nlp.nx, 1), nlp.gradient
        jacobian = nlp.jacobian_pattern.sparsity, nlp.jacobian_nonzeros
        hessian = (
            nlp.hessian_pattern.sparsity,
            lambda x, p, lam_f, lam_g: nlp.hessian_nonzeros(x, lam_g, float(lam_f[0]), p),
        )
        more = {**at, "lam_f": 1, "lam_g": nlp.ng}
        self.oracle = Buffered("nlp", at, {"f": f, "g": g})
        self.derivatives: dict[str, ca.Function] = {
            "grad_f": Buffered("nlp_grad_f", at, {"f": f, "grad_f_x": gradient}),
            "jac_g": Buffered("nlp_jac_g", at, {"g": g, "jac_g_x": jacobian}),
            "hess_lag": Buffered("nlp_hess_l", more, {"triu_hess_gamma_x_x": hessian}),
        }
