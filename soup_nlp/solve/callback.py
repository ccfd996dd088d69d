"""The iteration callback of CasADi's nlpsol, as far as every watcher has it alike."""

from __future__ import annotations

import casadi as ca


class IterationCallback(ca.Callback):
    """Base of what is called at every iteration; `eval` gets nlpsol's outputs, 1 says stop.

    A subclass sets what its `eval` needs and then calls `start`.
    """

    def start(self, name: str, nx: int, ng: int, parameters: int = 0) -> None:
        """Make the CasADi function of it.

        Args:
            name: Of the function.
            nx: Variables.
            ng: Rows.
            parameters: Parameters of the solver.
        """
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
        """As nlpsol names its outputs."""
        return str(ca.nlpsol_out(i))

    def get_name_out(self, i: int) -> str:
        """As nlpsol asks for it."""
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Dense, or nothing where there is nothing."""
        size = self._sizes[i]
        return ca.Sparsity.dense(size) if size else ca.Sparsity(0, 1)
