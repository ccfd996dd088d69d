"""The constraints of a soup, as residuals that anyone can test: the one definition of them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.errors import DataError, expect
from soup_nlp.geometry.soup import Soup

WORST = 3
"""Number of superpixels that are named for a kind."""


class Definition(NamedTuple):
    """A kind of constraint: its equation, the unit of its residual, the limit of our answers."""

    equation: str
    unit: str = ""
    limit: float = 0.0


DEFINITIONS: Mapping[str, Definition] = {
    "so3": Definition("R'R = I", "entry of R'R", 1e-8),
    "det": Definition("det R = 1", "det R", 1e-8),
    "normal": Definition("|n|^2 = 1", "|n|^2", 1e-8),
    "simplex": Definition("sum lam = 1", "sum of all lam", 1e-10),
    "positive": Definition("lam, d > 0", "lam or d", 0.0),
    # solvers keep inequalities to their own tolerance
    "visible": Definition("-n . r >= c", "-n . r, rays with z = 1", 1e-6),
    "bounds": Definition("lbx <= x <= ubx"),
    "rows": Definition("lbg <= g <= ubg"),
}
"""Kinds of constraint in the order of tables; the last two are those of an NLP's vectors."""


@dataclass(frozen=True, eq=False)
class Kind:
    """Residuals of one kind of constraint.

    Attributes:
        name: One of DEFINITIONS.
        values: (N,) violation by superpixel, nonnegative, inf where a number is not finite; one of
            the simplex.
        limit: Largest allowed violation.
    """

    name: str
    values: Float = field(repr=False)
    limit: float

    @property
    def superpixels(self) -> bool:
        """Whether the values belong to superpixels."""
        return self.name not in ("simplex", "bounds", "rows")

    @property
    def largest(self) -> float:
        """Largest violation."""
        return float(self.values.max(initial=0.0))

    @property
    def worst(self) -> tuple[tuple[int, float], ...]:
        """(superpixel, violation) of the largest ones, worst first; none where nothing is off."""
        order = np.argsort(-self.values, kind="stable")[: WORST if self.superpixels else 0]
        return tuple((int(k), float(self.values[k])) for k in order if self.values[k] > 0)

    @property
    def beyond(self) -> int:
        """Number of violations above the limit."""
        return int((self.values > self.limit).sum())

    @property
    def ok(self) -> bool:
        """Whether the largest violation is within the limit."""
        return self.largest <= self.limit

    @property
    def note(self) -> str:
        """The worst superpixels in words, and how many are beyond the limit."""
        if not self.worst:
            return ""
        count = f"{self.beyond} of {len(self.values)} beyond {self.limit:.1e}; "
        return f"{count if self.beyond else ''}worst superpixels {self._listed}"

    @property
    def _listed(self) -> str:
        return "  ".join(f"{i} ({v:.1e})" for i, v in self.worst)

    def __str__(self) -> str:
        return (
            f"{'ok  ' if self.ok else 'FAIL'} {self.name:<9}"
            f" {DEFINITIONS[self.name].equation:<17}{self.largest:>9.1e} {self.limit:>9.1e}"
            f" {self.beyond:>6} of {len(self.values):<6} {self._listed}"
        ).rstrip()


def kind(name: str, violation: Float, limit: float | None = None) -> Kind:
    """A kind of nonnegative violations (M,); NaN is an infinite one. The default limit is ours."""
    values = np.where(np.isfinite(violation), violation, np.inf)
    return Kind(name, values, DEFINITIONS[name].limit if limit is None else limit)


def table(kinds: Iterable[Kind]) -> str:
    """Kinds as a table with its header."""
    head = f"     {'kind':<9} {'equation':<17}{'largest':>9} {'limit':>9} {'beyond':>9}"
    return "\n".join([f"{head}{'':<8}worst superpixels", *map(str, kinds)])


class Constraints(dict[str, Kind]):
    """Residuals of a soup by kind; prints itself as a table.

    `c["so3"].largest`, `c["so3"].worst`, `c.within(1e-6)`, `dict(c.largest)`.
    """

    @property
    def largest(self) -> dict[str, float]:
        """Largest violation of every kind."""
        return {name: k.largest for name, k in self.items()}

    def within(self, tol: float | None = None) -> bool:
        """Whether every violation is at most `tol`; by default within the limits of our answers.

        Those are 1e-8 for so3, det and normal, 1e-10 for the simplex, 1e-6 for visibility, and
        0 for positive: lam and d are above 0, whatever `tol` is.
        """
        return all(
            k.largest <= (tol if tol is not None and k.limit else k.limit) for k in self.values()
        )

    def __repr__(self) -> str:
        units = (f"     {name:<9} in units of {DEFINITIONS[name].unit}" for name in self)
        return "\n".join([table(self.values()), *units])


def constraints(
    soup: Soup | Mapping[str, Float], rays: Float | None = None, min_facing: float = 1e-3
) -> Constraints:
    """Residuals of every constraint on the arrays of a soup, ours or anyone's.

    - so3: largest entry of `|R'R - I|`; det: `|det R - 1|`, which a reflection has at 2
    - normal: `| |n|^2 - 1 |`
    - simplex: `|sum lam - 1|`, one number
    - positive: how far lam or d is below 0; at 0 the smallest positive number
    - visible: how far `-n . r` is below c, where rays are given

    A superpixel with a number that is not finite violates every kind.

    Args:
        soup: A `Soup`, or a mapping with lam (N,), n (N, 3), d (N,), R (N, 3, 3), t (N, 3): planes
            `n . X + lam d = 0` that face the camera, motions `X' = R X + lam t`.
        rays: (N, V, 3) rays (z = 1) at which the plane of each superpixel has to be seen, such as
            `run.data.rim_ray`; without them visibility is not tested.
        min_facing: c.

    Raises:
        DataError: an array is missing, or has another shape.
    """
    make = "constraints(dict(lam=lam, n=n, d=d, R=R, t=t)), or run.constraints of a run"
    expect(soup, (Soup, Mapping), "soup", make)
    state = vars(soup) if isinstance(soup, Soup) else soup
    count = np.size(state["lam"]) if "lam" in state else 0
    shapes = {"lam": (count,), "n": (count, 3), "d": (count,), "R": (count, 3, 3), "t": (count, 3)}
    given = {k: _array(state.get(k), k, shape) for k, shape in shapes.items()}
    lam, n, d, R, _ = given.values()
    whole = [np.isfinite(a).reshape(count, -1).all(axis=1) for a in given.values()]
    broken, least = ~np.all(whole, axis=0), np.minimum(lam, d)
    # the arrays of a solver that failed may hold anything
    with np.errstate(all="ignore"):
        off = {
            "so3": np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).reshape(count, -1).max(axis=1),
            "det": np.abs(np.linalg.det(R) - 1),
            "normal": np.abs((n**2).sum(axis=1) - 1),
            "simplex": np.abs(lam.sum(keepdims=True) - 1),
            "positive": np.where(least > 0, 0.0, np.maximum(-least, np.finfo(float).tiny)),
        }
        if rays is not None:
            width = np.shape(rays)[1] if np.ndim(rays) == 3 else 1
            rays = _array(rays, "rays", (count, width, 3))
            facing = -np.einsum("nc,nvc->nv", n, rays)
            off["visible"] = np.maximum(0.0, (min_facing - facing).max(axis=1))
    off = {k: v if k == "simplex" else np.where(broken, np.inf, v) for k, v in off.items()}
    return Constraints({k: kind(k, v) for k, v in off.items()})


def _array(value: object, name: str, shape: tuple[int, ...]) -> Float:
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if not shape[0] or array.shape != shape:
        raise DataError(
            "array of a soup is missing or has another shape",
            where=name,
            found="nothing" if value is None else array.shape,
            expected=f"{('N', *shape[1:])}, N at least 1 and the same for all",
        )
    return array
