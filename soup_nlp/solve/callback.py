"""Base class of iteration callbacks of CasADi's nlpsol."""

from __future__ import annotations

import casadi as ca


class IterationCallback(ca.Callback):
    """Called at every iteration: `eval` gets nlpsol's outputs and returns 1 to stop.

    A subclass sets what its `eval` needs and then calls `start`.
    """

    def start(self, name: str, nx: int, ng: int, parameters: int = 0) -> None:
        """Make the CasADi function of it."""
        sizes = {"f": 1, "x": nx, "lam_x": nx, "g": ng, "lam_g": ng, "lam_p": parameters}
        self._sizes = [sizes[ca.nlpsol_out(i)] for i in range(ca.nlpsol_n_out())]
        self.construct(name, {})

    def get_n_in(self) -> int:
        """Outputs of nlpsol."""
        return len(self._sizes)

    def get_n_out(self) -> int:
        """Whether to stop."""
        return 1

    def get_name_in(self, i: int) -> str:
        """Name of nlpsol's output i."""
        return str(ca.nlpsol_out(i))

    def get_name_out(self, i: int) -> str:
        """The name that nlpsol asks for."""
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Dense; empty outputs are 0 x 1."""
        size = self._sizes[i]
        return ca.Sparsity.dense(size) if size else ca.Sparsity(0, 1)
