"""The soup's nonlinear programs: the constrained one (the product) and the tangent presolve."""

from __future__ import annotations

from soup_nlp.model.matrix import build_matrix_nlp
from soup_nlp.model.options import Formulation
from soup_nlp.model.tangent import build_tangent_nlp

__all__ = ["Formulation", "build_matrix_nlp", "build_tangent_nlp"]
