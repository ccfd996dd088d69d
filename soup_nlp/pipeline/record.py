"""Records of a case before its solve and of a run after it: inputs, energy, solution, scores."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from soup_nlp.arrays import Float, FloatMap
from soup_nlp.config.problem import Problem
from soup_nlp.data.pair import Pair
from soup_nlp.data.working_size import full_depth, resized
from soup_nlp.evaluation.confidence import Confidence
from soup_nlp.evaluation.metrics import DepthMetrics
from soup_nlp.evaluation.scoring import score_depths
from soup_nlp.geometry.components import Components, find_components
from soup_nlp.geometry.constraints import Constraints, constraints
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.rotation import RigidMotion
from soup_nlp.geometry.soup import Reconstruction, Soup
from soup_nlp.geometry.superpixels import Labels
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import UNBOUNDED, Formulation
from soup_nlp.model.layout import Layout, MatrixLayout, TangentLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.programs import build_matrix_nlp, build_tangent_nlp, exact_chart
from soup_nlp.refine.records import Refined
from soup_nlp.solve.solver_options import Stages
from soup_nlp.solve.stages import Solution
from soup_nlp.start.given_depth import GivenDepth
from soup_nlp.start.propose import Start


@dataclass(frozen=True, eq=False)
class Case:
    """A problem before it is solved.

    Attributes:
        problem: The merged problem.
        pair: Images, cameras, flow, truth.
        segmentation: Superpixels and graphs.
        start: The unorganised soup.
        data: Numbers of the energy.
        weights: Constants of the energy.
        soup: The best soup so far, where solvers start: the start, or the presolve's answer.
        options: Stages and limits of the problem.
        original: The pair at its own size, where it was larger than `max_size`; else None.
        given: Depth prior as judged against the flow; None without a prior.
    """

    problem: Problem
    pair: Pair
    segmentation: Segmentation
    start: Start
    data: EnergyData
    weights: Weights
    soup: Soup
    options: Stages
    original: Pair | None = None
    given: GivenDepth | None = None

    def __len__(self) -> int:
        return len(self.segmentation)

    def formulation(self, **changes: object) -> Formulation:
        """The formulation and smoothing of the problem, with some fields changed."""
        options, eps = dict(self.problem.formulation), self.options.eps
        free = {} if options["min_facing"] else {"depth_ratio": UNBOUNDED}
        return Formulation(**{**options, **free, "eps": eps, "eps_pixel": eps, **changes})

    def nlp(self, form: Formulation) -> tuple[NLP, Layout]:
        """The NLP of a formulation at the case's soup; tangent coordinates are about the start."""
        energy = self.data, self.weights, form
        if form.coordinates == "matrix":
            return build_matrix_nlp(self.soup, *energy)
        base = TangentLayout.about(self.start.soup, self.data, exact_chart(self.data))
        return build_tangent_nlp(self.soup, *energy, layout=base)


@dataclass(frozen=True, eq=False)
class FullSize:
    """Depth at the size of the images, in the soup's length unit.

    Attributes:
        depth_ref: (H, W) z of the reference frame, NaN where unknown.
        depth_next: (H', W') z of the next frame, NaN where nothing lands.
        metrics: Score of `depth_ref`; None without truth.
    """

    depth_ref: FloatMap
    depth_next: FloatMap
    metrics: DepthMetrics | None = None

    def __repr__(self) -> str:
        (h, w), (h2, w2) = self.depth_ref.shape, self.depth_next.shape
        return f"FullSize(reference {w}x{h}, next {w2}x{h2})"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Run(Case):
    """A case with the results of its solve; `soup` is the delivered one.

    Attributes:
        solution: Result of the constrained NLP, before any refinement.
        reconstruction: Dense 3D of `soup`.
        depth_maps: (H, W) z of the reference frame by "solution" (delivered), "start", "nlp" (where
            refined), and with a truth "rigid" (by one rigid motion for the whole image, in lengths
            of its translation, where one fits).
        metrics: By the names of `depth_maps`, "constant", and "solution_next" for the next frame;
            a key without truth is absent.
        seconds: Wall time by stage; those that start with nlp_ are parts of "nlp".
        confidence: Uncertainty of `reconstruction`.
        refined: Result of the refinement of `solution`; None where it is off.
        full: Depth at the images' own size, where the pair was solved at a smaller one.
        shrinkage: (N,) change of log depth of what is drawn; None without detail.
        ground: (3,) its inverse depth along a ray is their product, 0 without one; None without
            detail.
    """

    solution: Solution
    reconstruction: Reconstruction
    depth_maps: Mapping[str, Float]
    metrics: Mapping[str, DepthMetrics]
    seconds: Mapping[str, float]
    confidence: Confidence
    refined: Refined | None = None
    full: FullSize | None = None
    shrinkage: Float | None = None
    ground: Float | None = None

    def __str__(self) -> str:
        h, w = self.pair.size
        s, energy = self.solution, self.energy["total"]
        parts, source = self.components, "the refinement" if self.refined else self.delivered
        scores = "no truth"
        if "solution" in self.metrics:
            m = self.metrics["solution"]
            scores = f"MRE {m.mre:.4f} at {m.coverage:.1%} of the truth, {m.scale_rule} scale"
        return "\n".join(
            [
                f"Run({self.problem.name}, {w}x{h}, {len(self.segmentation)} superpixels,"
                f" {sum(v for k, v in self.seconds.items() if not k.startswith('nlp_')):.1f} s)",
                f"  {'good' if self.good else 'not good'}: {s.status}, E"
                f" {s.energy_start['total']:.5g} -> {energy:.5g}, delivered by {source}",
                f"  {self.reconstruction}",
                f"  camera {parts.camera}; components beside the background: {len(parts) - 1}",
                f"  {scores}",
            ]
        )

    __repr__ = __str__

    @cached_property
    def components(self) -> Components:
        """Rigid components with their motions; the first is the static scene."""
        pair, start = self.pair, self.start
        geometry = self.soup, self.segmentation, start.part, pair.K_ref, pair.K_next
        return find_components(*geometry, start.interpolated)

    @property
    def camera(self) -> RigidMotion:
        """next_from_ref of the static scene, in the unit of the reconstruction; its `centre` is the
        centre of the next camera in the reference frame."""
        return self.components.camera

    @property
    def delivered(self) -> str:
        """Origin of `solution.soup`: "constrained NLP", or "presolve" or "start" where these have
        the lower exact energy or the NLP was skipped."""
        return self.solution.delivered

    @property
    def answer(self) -> Soup:
        """Ipopt's last iterate, whose constraints hold to Ipopt's tolerance only; the start if the
        NLP was skipped."""
        if not self.solution.stages:
            return self.solution.soup
        layout = MatrixLayout(self.data.share, self.problem.formulation.gauge)
        return layout.unpack(self.solution.stages[-1].x)

    @property
    def energy(self) -> Mapping[str, float]:
        """Exact energy E by term of `soup`; E_photo of the refinement is not part of it."""
        if self.refined is None:
            return self.solution.energy
        return oracle.energy(self.soup, self.data, self.weights)

    @property
    def residuals(self) -> dict[str, float]:
        """Constraint residuals of `soup`, beside those of Ipopt's answer."""
        return {**self.solution.residuals, **self.constraints.largest}

    @property
    def constraints(self) -> Constraints:
        """Residuals of `soup` by kind of constraint, with the worst superpixels."""
        return constraints(self.soup, self.data.rim_ray, self.problem.formulation.min_facing)

    @property
    def good(self) -> bool:
        """Whether the solve ended well and at most half of the image is drawn."""
        return self.solved and self.confidence.share("drawn") <= 0.5

    @property
    def solved(self) -> bool:
        """Whether the NLP converged (or was skipped) and the refinement was not interrupted."""
        solved = self.solution.converged or self.solution.status == "Skipped"
        return solved and (self.refined is None or self.refined.status != "interrupted")


def full_size(full: Pair, pair: Pair, result: Reconstruction) -> FullSize:
    """Bring a reconstruction of a smaller pair to the size of the full one.

    Planes are evaluated at every pixel, in the next frame after their motions. With detail, their
    depth is changed as that of the nearest pixel of the smaller pair.
    """

    def enlarged(
        frame: str, labels: Labels, normal: Float, offset: Float, depth: Float
    ) -> FloatMap:
        K, K_small = (getattr(p, f"K_{frame}") for p in (full, pair))
        size = getattr(full, f"image_{frame}").shape[:2]
        z = full_depth(labels, size, normal, offset, K)
        if result.detail is None:
            return z
        flat = full_depth(labels, depth.shape, normal, offset, K_small)
        return z * resized(depth.astype(np.float32) / flat, size)

    soup, source = result.soup, result.source_next
    depth_ref = enlarged("ref", result.labels, soup.n, soup.distance, result.depth_ref)
    # X' = R X + t carries n . X + D = 0 to (R n) . X' + D - (R n) . t = 0
    turned = np.einsum("nij,nj->ni", soup.R, soup.n)
    moved = soup.distance - np.einsum("ni,ni->n", turned, soup.translation)
    shown = np.where(source >= 0, result.labels.ravel()[source], -1).astype(np.int32)
    depth_next = enlarged("next", shown, turned, moved, result.depth_next)
    scores = score_depths(full.truth, {"full": depth_ref.astype(np.float64)})
    return FullSize(depth_ref, depth_next, scores.get("full"))
