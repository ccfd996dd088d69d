"""Problem files: strict YAML, defaults beside the code that uses them, dotted overrides."""

from __future__ import annotations

import copy
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, ValidationError

from soup_nlp.config_errors import Place, explain
from soup_nlp.config_inputs import Input, Positive
from soup_nlp.config_mirror import Strict, attribute_docs, mirror
from soup_nlp.data.flow import dis_flow
from soup_nlp.errors import ConfigError
from soup_nlp.model.energy import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import HESSIANS
from soup_nlp.refine.records import RefineOptions
from soup_nlp.solve.soup import SolverOptions
from soup_nlp.start.propose import StartOptions

# smoothing belongs to the solver's stages, the seed to the problem
EnergyWeights: Any = mirror(Weights, "EnergyWeights", module=__name__)
BendingWeights: Any = mirror(
    Weights,
    "BendingWeights",
    module=__name__,
    defaults={"cont": 0.05, "orient": 4.0, "sigma_arap": 1.0, "leak_arap": 0.05},
)
StartConfig: Any = mirror(StartOptions, "StartConfig", module=__name__, leave_out=("seed",))
FormulationConfig: Any = mirror(
    Formulation,
    "FormulationConfig",
    module=__name__,
    leave_out=("eps", "eps_pixel"),
    choices={"hessian": HESSIANS},
)
SolverConfig: Any = mirror(SolverOptions, "SolverConfig", module=__name__)
RefineConfig: Any = mirror(RefineOptions, "RefineConfig", module=__name__)
DisConfig: Any = mirror(
    dis_flow, "DisConfig", module=__name__, choices={"preset": ("ultrafast", "fast", "medium")}
)


class SegmentationConfig(Strict):
    """Superpixels and graphs.

    Attributes:
        superpixels: Wanted number; the answer may differ by a few per cent.
        method: slic, or grid (the paper's worst case).
        compactness: SLIC's balance of colour and distance.
        smoothing_px: Gaussian pre-smoothing of SLIC, pixels.
        follow_flow_px: A pixel on a border goes to the neighbour whose affine flow is nearer to its
            own by more than this, pixels; null leaves the borders to the image alone.
        neighbours: K of the K-NN graph, less than the number of superpixels.
        beta: Fall-off of w1, w2 with distance, 1/pixel.
        beta_colour: Fall-off of w4 with colour difference, colours in [0, 1].
        boundary_samples: Points per shared boundary, or all.
    """

    superpixels: Annotated[int, Field(ge=1)] = 1000
    method: Literal["slic", "grid"] = "slic"
    compactness: Positive = 10.0
    smoothing_px: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    follow_flow_px: Positive | None = 1.0
    neighbours: Annotated[int, Field(ge=1)] = 15
    beta: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.02
    beta_colour: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    boundary_samples: Annotated[int, Field(ge=1)] | Literal["all"] = 3


class FlowConfig(Strict):
    """Where the flow comes from.

    Attributes:
        source: dis, truth, a file (.flo, KITTI .png, .npy), or the name of a plug-in.
        occluded_confidence: Confidence of occluded pixels when the source is truth.
        reweight_px: Pixels that disagree with their superpixel's affine flow by more than about
            this count less; null for never.
        dis: Options of OpenCV's DIS flow and of its forward-backward check.
    """

    source: str = "dis"
    occluded_confidence: Annotated[float, Field(ge=0, le=1)] = 1.0
    reweight_px: Positive | None = None
    dis: DisConfig = DisConfig()


class BendingConfig(Strict):
    """The energy where the start finds that surfaces bend, always in pixels.

    Bending is a difference of rotations that keeps lengths: E_arap compares motions at the
    anchors, where a surface that bends hangs together, and its rotations count for next to
    nothing. The relief is then held by lengths, continuity and orientation.

    Attributes:
        widest_eps: Widest smoothing of the presolve, pixels: wider ones of solver.presolve_eps
            become this. What shows relief is a fraction of a pixel, a wide norm flattens it.
        rotation_px: Pixels per radian of rotation difference.
        arap_across: Factor of E_arap where the flow tears; 1 is the paper's, as of the others.
        cont_across: Factor of E_cont there.
        orient_across: Factor of E_orient there.
        weights: Factors of the terms and their truncations; orient is that of 1,000 superpixels and
            grows with their number.
    """

    widest_eps: Positive = 0.1
    rotation_px: Positive = 1e-3
    arap_across: Annotated[float, Field(ge=0, le=1)] = 0.3
    cont_across: Annotated[float, Field(ge=0, le=1)] = 0.01
    orient_across: Annotated[float, Field(ge=0, le=1)] = 0.3
    weights: BendingWeights = BendingWeights()


class EnergyConfig(Strict):
    """The energy.

    Attributes:
        units: pixel (every term in pixels, free of scale) or paper (one length unit).
        arap_at_anchors: Motion difference at the anchors instead of the camera's origin.
        arap_across: Factor of E_arap between superpixels that the start gives to different bodies;
            1 is the paper's.
        cont_occluded: Factor of E_cont where one of these bodies hides another; 1 is the paper's.
        occlusion_gap: It does where the start leaves a larger gap in depth between them, relative
            to the farther side.
        rotation_px: Pixels per radian of rotation difference; null for the focal length.
        pixel_samples: Pixels per superpixel in E_proj, or all.
        weights: Factors of the terms and their truncations.
        bending: What replaces rotation_px, arap_at_anchors, weights and the solver's wide smoothing
            where surfaces bend.
    """

    units: Literal["pixel", "paper"] = "pixel"
    arap_at_anchors: bool = False
    arap_across: Annotated[float, Field(ge=0, le=1)] = 0.03
    cont_occluded: Annotated[float, Field(ge=0, le=1)] = 0.03
    occlusion_gap: Annotated[float, Field(ge=0, lt=1)] = 0.1
    rotation_px: Positive | None = None
    pixel_samples: Annotated[int, Field(ge=1)] | Literal["all"] = 16
    weights: EnergyWeights = EnergyWeights()
    bending: BendingConfig = BendingConfig()


class Expected(Strict):
    """What a run should score; solve exits with 1 where it does not.

    Attributes:
        mre_at_most: Largest mean relative error of the solution's depth; null for no claim.
        scale: Rule of the one global scale that depth metrics are after.
        cap: Truth beyond this depth is left out, unit of the truth; null for none.
    """

    mre_at_most: Positive | None = None
    scale: Literal["median", "mre", "lsq", "none"] = "median"
    cap: Positive | None = None


class Problem(Strict):
    """One problem file.

    Attributes:
        name: For titles.
        input: What to solve, by its kind.
        seed: Of every random draw.
        segmentation: Superpixels and graphs.
        flow: Where the flow comes from.
        start: How the start is made.
        energy: Terms, weights, units.
        formulation: How the energy is written for the solver.
        solver: Stages and limits; eps are smoothing widths in the energy's unit.
        refine: Discrete refinement by particles.
        expected: What the run should score.
        base: Folder that relative paths start from (the file's own).
    """

    name: str = "problem"
    input: Input
    seed: Annotated[int, Field(ge=0)] = 0
    segmentation: SegmentationConfig = SegmentationConfig()
    flow: FlowConfig = FlowConfig()
    start: StartConfig = StartConfig()
    energy: EnergyConfig = EnergyConfig()
    formulation: FormulationConfig = FormulationConfig()
    solver: SolverConfig = SolverConfig()
    refine: RefineConfig = RefineConfig()
    expected: Expected = Expected()
    base: str = "."

    def path(self, name: str) -> Path:
        """A path of this problem, relative ones from its file's folder."""
        return (Path(self.base) / Path(name).expanduser()).resolve()

    def digest(self) -> str:
        """Hash of everything that decides the result; neither the name nor the place does."""
        tree = self.model_dump(mode="json", exclude={"name", "base"})
        return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:12]


def load_problem(path: str | Path, overrides: Sequence[str] = ()) -> Problem:
    """Read a problem file.

    Args:
        path: YAML file.
        overrides: `a.b=value` with the value in YAML.

    Raises:
        ConfigError: the file is missing or not YAML, a key is unknown or given twice, a value is
            of the wrong type or out of range.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            "problem file cannot be read",
            where=path,
            found=getattr(error, "strerror", None) or error,
            hint="soup-nlp list shows the problems of a folder",
        ) from error
    raw, lines = _parse(text, str(path))
    if not isinstance(raw, dict):
        raise ConfigError(
            "problem file must be a mapping",
            where=path,
            found=type(raw).__name__,
            expected="keys such as input: {kind: motorcycle}",
        )
    raw.setdefault("name", path.stem)
    raw.setdefault("base", str(path.resolve().parent))
    return make_problem(raw, overrides, where=str(path), lines=lines)


def make_problem(
    raw: Mapping[str, Any],
    overrides: Sequence[str] = (),
    where: str = "problem",
    lines: Mapping[Place, str] | None = None,
) -> Problem:
    """Check a mapping and its overrides; see `load_problem`.

    Args:
        raw: Sections by name.
        overrides: `a.b=value` with the value in YAML.
        where: Source of the mapping, for messages.
        lines: Where in the source each key is, for messages.

    Raises:
        ConfigError: as `load_problem`.
    """
    tree = copy.deepcopy(dict(raw))
    lines = dict(lines or {})
    for item in overrides:
        lines[_override(tree, item)] = f"--set {item}"
    try:
        return Problem.model_validate(tree)
    except ValidationError as error:
        raise explain(error, Problem, tree, where, lines) from error


def dump_problem(problem: Problem) -> str:
    """The complete, merged problem as YAML with a comment on every key; it can be solved again."""
    return "\n".join(_write(problem, "")) + "\n"


def _write(model: Strict, pad: str) -> Iterator[str]:
    docs = attribute_docs(type(model).__doc__)
    for key in type(model).model_fields:
        value = getattr(model, key)
        comment = f"  # {docs[key]}" if key in docs else ""
        if isinstance(value, Strict):
            yield f"{pad}{key}:{comment}"
            yield from _write(value, pad + "  ")
        else:
            flow = None if isinstance(value, list | dict) else False
            text = yaml.dump({key: value}, Dumper=_Dumper, default_flow_style=flow, width=10**6)
            yield f"{pad}{text.rstrip()}{comment}"


class _Loader(yaml.SafeLoader):
    """YAML with the numbers and booleans of version 1.2: 1e-3 is a number, `no` is a word."""


class _Dumper(yaml.SafeDumper):
    """Quotes whatever either version would not read as a string."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, rule) for tag, rule in rules if tag.split(":")[-1] in ("null", "merge")]
    for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _tag, _rule, _first in (
    ("bool", r"true|false|True|False|TRUE|FALSE", "tTfF"),
    ("int", r"[-+]?\d+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.\d+|\d+(\.\d*)?)([eE][-+]?\d+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
):
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_rule})\Z"), list(_first)
        )
# 010 is ten, not eight
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value))
_Loader.add_constructor(
    "tag:yaml.org,2002:float",
    lambda loader, node: float(node.value.lower().replace(".inf", "inf").replace(".nan", "nan")),
)


def _parse(text: str, source: str) -> tuple[Any, dict[Place, str]]:
    """The content of a YAML text, and the line of every key."""
    loader = _Loader(text)
    lines: dict[Place, str] = {}
    try:
        node = loader.get_single_node()
        if node is None:
            return None, lines
        _locate(node, (), lines, source)
        return loader.construct_document(node), lines
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        raise ConfigError(
            "text is not YAML",
            where=f"{source}, line {mark.line + 1}" if mark else source,
            found=getattr(error, "problem", None) or error,
        ) from error
    finally:
        loader.dispose()


def _locate(node: yaml.Node, place: Place, lines: dict[Place, str], source: str) -> None:
    """Fill in the line of every key; a key that is given twice is an error."""
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        here = (*place, str(key.value))
        line = f"line {key.start_mark.line + 1}"
        if here in lines:
            raise ConfigError("key is given twice", where=f"{source}, {line}", found=".".join(here))
        lines[here] = line
        _locate(value, here, lines, source)


def _override(tree: dict[str, Any], item: str) -> Place:
    key, eq, value = item.partition("=")
    place = tuple(key.strip().split("."))
    if not eq or not all(place):
        raise ConfigError(
            "override is not key=value", where="--set", found=item, expected="solver.max_iter=200"
        )
    node: Any = tree
    for k, part in enumerate(place[:-1]):
        node = node.setdefault(part, {})
        if not isinstance(node, dict):
            raise ConfigError(
                "override goes below a value",
                where="--set",
                found=item,
                expected=f"{'.'.join(place[: k + 1])} is a section",
            )
    node[place[-1]] = _parse(value, f"--set {item}")[0]
    return place
