"""Problem files: strict YAML, defaults beside the code that uses them, dotted overrides."""

from __future__ import annotations

import difflib
import hashlib
import json
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from soup_nlp.errors import ConfigError
from soup_nlp.model.energy import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.solve.soup import SolverOptions
from soup_nlp.start.propose import StartOptions


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


# what a number may be, by field name: everything not named is just finite
_RANGES: Mapping[str, tuple[float | None, float | None]] = {
    **dict.fromkeys(
        ("arap", "proj", "cont", "orient", "theta", "ridge", "presolve_ridge", "smoothness"),
        (0, None),
    ),
    **dict.fromkeys(("eps", "tol", "presolve_tol", "eps_pixel", "max_seconds"), (1e-12, None)),
    **dict.fromkeys(("sigma_cont", "sigma_cont_ref", "sigma_orient", "sigma_arap"), (1e-12, None)),
    **dict.fromkeys(("samples", "dominant", "pieces", "piece_size"), (1, None)),
    "presolve_iterations": (1, None),
    "sigma_proj": (1e-12, None),
    "presolve_last_iterations": (0, None),
    "max_iter": (0, None),
    "depth_ratio": (1.0, None),
    "min_facing": (0, 0.5),
    "presolve_theta": (0, 1),
}


def _mirror(record: type, name: str, **fixed: Any) -> type[_Strict]:
    """Strict model with the fields and defaults of a dataclass."""
    hints = typing.get_type_hints(record)
    made: dict[str, Any] = {}
    for f in fields(record):
        if f.name in fixed:
            continue
        factory: Any = f.default_factory
        default: Any = factory() if f.default is MISSING else f.default
        kind: Any = hints[f.name]
        if typing.get_origin(kind) is tuple:
            kind = list[float]
            default = list(default)
        elif typing.get_origin(kind) in (Mapping, types.MappingProxyType) or "Mapping" in str(kind):
            kind = dict[str, Any]
            default = dict(default)
        elif kind is float and f.name.startswith("sigma"):
            kind = Annotated[float, Field(gt=0, allow_inf_nan=True, strict=False)]
        elif kind in (float, int):
            low, high = _RANGES.get(f.name, (None, None))
            kind = Annotated[kind, Field(ge=low, le=high, allow_inf_nan=False)]
        made[f.name] = (kind, default)
    return create_model(name, __base__=_Strict, **made)


EnergyWeights: Any = _mirror(Weights, "EnergyWeights")
StartConfig: Any = _mirror(StartOptions, "StartConfig")
FormulationConfig: Any = _mirror(Formulation, "FormulationConfig", eps=0, eps_pixel=0)
SolverConfig: Any = _mirror(SolverOptions, "SolverConfig")

Four = Annotated[list[float], Field(min_length=4, max_length=4)]


class FilesInput(_Strict):
    """Two image files and their cameras.

    Attributes:
        ref, next: Images.
        intrinsics: fx, fy, cx, cy of the reference frame, pixels.
        intrinsics_next: Of the next frame; default the same.
        depth: Optional true depth of the reference frame.
    """

    kind: Literal["files"]
    ref: str
    next: str
    intrinsics: Four
    intrinsics_next: Four | None = None
    depth: str | None = None


class FolderInput(_Strict):
    """A folder with frame_0, frame_1, K.txt and optional truth."""

    kind: Literal["folder"]
    path: str
    depth_scale: Annotated[float, Field(gt=0)] = 1000.0
    unit: str = "m"


class MotorcycleInput(_Strict):
    """The Middlebury motorcycle pair that scikit-image ships."""

    kind: Literal["motorcycle"]


class SceneInput(_Strict):
    """A rendered dynamic scene."""

    kind: Literal["scene"]
    scene: Literal["street", "room", "sheet", "orbit", "still"]
    seed: Annotated[int, Field(ge=0)] = 0
    width: Annotated[int, Field(ge=64)] = 1024
    height: Annotated[int, Field(ge=48)] = 436


class SintelInput(_Strict):
    """MPI Sintel, official layout."""

    kind: Literal["sintel"]
    root: str
    scene: str
    frame: Annotated[int, Field(ge=0)]
    render: str = "clean"
    step: int = 1


class KittiInput(_Strict):
    """KITTI 2012 or 2015, official layout."""

    kind: Literal["kitti2012", "kitti2015"]
    root: str
    index: str
    occ: bool = True


class VkittiInput(_Strict):
    """Virtual KITTI 1 (scene = world) or 2, official layout."""

    kind: Literal["vkitti1", "vkitti2"]
    root: str
    scene: str
    frame: Annotated[int, Field(ge=0)]
    variation: str = "clone"
    step: int = 1


Input = Annotated[
    FilesInput
    | FolderInput
    | MotorcycleInput
    | SceneInput
    | SintelInput
    | KittiInput
    | VkittiInput,
    Field(discriminator="kind"),
]


class SegmentationConfig(_Strict):
    """Superpixels and graphs.

    Attributes:
        superpixels: Wanted number.
        method: "slic" or "grid".
        compactness: SLIC's balance of colour and distance.
        smoothing_px: Gaussian pre-smoothing of SLIC.
        neighbours: K of the K-NN graph.
        beta: Fall-off of w1, w2 with distance, 1/pixel.
        beta_colour: Fall-off of w4 with colour difference.
        boundary_samples: Points per shared boundary, or "all".
    """

    superpixels: Annotated[int, Field(ge=1)] = 1000
    method: Literal["slic", "grid"] = "slic"
    compactness: Annotated[float, Field(gt=0)] = 10.0
    smoothing_px: Annotated[float, Field(ge=0)] = 0.0
    neighbours: Annotated[int, Field(ge=1)] = 15
    beta: Annotated[float, Field(ge=0)] = 0.02
    beta_colour: Annotated[float, Field(ge=0)] = 1.0
    boundary_samples: Annotated[int, Field(ge=1)] | Literal["all"] = 3


class FlowConfig(_Strict):
    """Flow source: "dis", "truth", a file (.flo, KITTI .png, .npy), or a plug-in's name."""

    source: str = "dis"


class EnergyConfig(_Strict):
    """The energy.

    Attributes:
        units: "pixel" (every term in pixels, scale-free) or "paper" (one length unit).
        arap_at_anchors: Motion difference at the anchors instead of the camera's origin.
        rotation_px: Pixels per radian of rotation difference; null for the focal length.
        pixel_samples: Pixels per superpixel in E_proj, or "all".
        weights: alpha1 to alpha3 and the truncations.
    """

    units: Literal["pixel", "paper"] = "pixel"
    arap_at_anchors: bool = False
    rotation_px: Annotated[float, Field(gt=0)] | None = None
    pixel_samples: Annotated[int, Field(ge=1)] | Literal["all"] = 16
    weights: EnergyWeights = EnergyWeights()


class Expected(_Strict):
    """What a run should score, where known."""

    mre_at_most: float | None = None
    scale: Literal["median", "mre", "lsq", "none"] = "median"


class Problem(_Strict):
    """One problem file.

    Attributes:
        name: For titles.
        input: What to solve, by `kind`.
        seed: Of every random draw.
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
    expected: Expected = Expected()
    base: str = "."

    def path(self, name: str) -> Path:
        """A path of this problem, relative ones from its file's folder."""
        return (Path(self.base) / Path(name).expanduser()).resolve()

    def digest(self) -> str:
        """Hash of everything that decides the result."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def load_problem(path: str | Path, overrides: Sequence[str] = ()) -> Problem:
    """Read a problem file.

    Args:
        path: YAML file.
        overrides: `a.b=value` with the value in YAML.

    Raises:
        ConfigError: the file is missing or not YAML, a key is unknown, a value is of the wrong
            type or out of range.
    """
    path = Path(path)
    try:
        text = path.read_text()
    except OSError as error:
        raise ConfigError(
            "problem file cannot be read", where=path, found=error.strerror, hint="see problems/"
        ) from error
    try:
        raw = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError("problem file is not YAML", where=path, found=str(error)) from error
    if not isinstance(raw, dict):
        raise ConfigError(
            "problem file must be a mapping", where=path, found=type(raw).__name__, expected="keys"
        )
    raw.setdefault("name", path.stem)
    raw.setdefault("base", str(path.resolve().parent))
    return make_problem(raw, overrides, where=str(path), text=text)


def make_problem(
    raw: Mapping[str, Any], overrides: Sequence[str] = (), where: str = "problem", text: str = ""
) -> Problem:
    """Check a mapping and its overrides; see `load_problem`."""
    tree = json.loads(json.dumps(raw))
    for item in overrides:
        _override(tree, item)
    try:
        return Problem.model_validate(tree)
    except ValidationError as error:
        raise _explain(error, where, text) from error


def _override(tree: dict[str, Any], item: str) -> None:
    key, eq, value = item.partition("=")
    if not eq or not key:
        raise ConfigError(
            "override is not key=value", where="--set", found=item, expected="solver.max_iter=200"
        )
    *parents, last = key.split(".")
    node = tree
    for part in parents:
        node = node.setdefault(part, {})
        if not isinstance(node, dict):
            raise ConfigError("override goes below a value", where="--set", found=item)
    node[last] = yaml.safe_load(value)


def _explain(error: ValidationError, where: str, text: str) -> ConfigError:
    """The first problem of a validation in our words: key, found, allowed, nearest spelling."""
    first = error.errors()[0]
    # the tagged union puts its tag into the location; it is no key of the file
    place = [str(p) for p in first["loc"]]
    if len(place) > 1 and place[0] == "input":
        place.pop(1)
    key = ".".join(place)
    line = _line(text, place[-1] if place else "")
    where = f"{where}{f', line {line}' if line else ''}, key {key or '(top)'}"
    if first["type"] == "extra_forbidden":
        allowed = sorted(_allowed(place[:-1], first["loc"]))
        near = difflib.get_close_matches(place[-1], allowed, 1)
        return ConfigError(
            "unknown key",
            where=where,
            found=place[-1],
            expected="one of " + ", ".join(allowed),
            hint=f"did you mean {near[0]}?" if near else None,
        )
    expected = first["msg"]
    hint = None
    if first["type"] == "literal_error":
        allowed = [
            s.strip("'")
            for s in str(first.get("ctx", {}).get("expected", "")).replace(" or ", ", ").split(", ")
        ]
        near = difflib.get_close_matches(str(first["input"]), allowed, 1, 0.4)
        hint = f"did you mean {near[0]}?" if near else None
    return ConfigError(
        "missing key" if first["type"] == "missing" else "value does not fit",
        where=where,
        found=None if first["type"] == "missing" else repr(first["input"]),
        expected=expected,
        hint=hint,
    )


def _allowed(place: list[str], loc: tuple[int | str, ...]) -> list[str]:
    """Keys that the model at a place has."""
    if place == ["input"]:
        kinds = typing.get_args(typing.get_args(Input)[0])
        tag = str(loc[1])
        models = [m for m in kinds if tag in typing.get_args(m.model_fields["kind"].annotation)]
        return [k for m in models for k in m.model_fields]
    model: Any = Problem
    for part in place:
        model = model.model_fields[part].annotation
    return [k for k in model.model_fields if k != "base"]


def _line(text: str, key: str) -> int | None:
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip().startswith(f"{key}:"):
            return number
    return None


def dump_problem(problem: Problem) -> str:
    """The complete, merged problem as YAML; it can be solved again."""
    return yaml.safe_dump(problem.model_dump(mode="json"), sort_keys=False)
