"""Problem files: strict YAML, defaults beside the code that uses them, dotted overrides."""

import copy
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, Field, ValidationError

from soup_nlp.config.trees import PRESETS, Dumper, merged, override, parse
from soup_nlp.data.flow.sources import FlowOptions
from soup_nlp.data.inputs import Input, PriorOptions, pair_hash
from soup_nlp.data.pair import Pair
from soup_nlp.errors import ConfigError, expect, printable
from soup_nlp.model.energy_options import EnergyOptions
from soup_nlp.model.formulation import FormulationOptions
from soup_nlp.refine.records import RefineOptions
from soup_nlp.schema.section import Keys, Positive, Section, Seed, Whole, explain, nearest
from soup_nlp.solve.solver_options import SolverOptions, refuse_libraries
from soup_nlp.start.views import StartOptions
from soup_nlp.storage.files import as_path, is_file, is_folder, read_text
from soup_nlp.storage.folders import digest_of

LONGEST_NAME = 100
"""Characters of a problem's name."""


class SegmentationOptions(Section):
    """Superpixels and graphs."""

    superpixels: Annotated[int, Field(ge=1, le=20_000)] = 1000
    """Number that is asked for; the actual number differs by about 3 % at most."""
    method: Literal["slic", "grid"] = "slic"
    """slic, or grid (the paper's worst case)."""
    follow_flow_px: Positive | None = 1.0
    """A pixel on a border goes to the neighbour whose affine flow is nearer to its own by more
    than this, pixels; null leaves the borders to the image alone."""
    neighbours: Annotated[int, Field(ge=1, le=100)] = 15
    """K of the K-NN graph, less than the number of superpixels."""
    boundary_samples: Whole | Literal["all"] = 3
    """Points per shared boundary, or all."""


class Expected(Section):
    """The accuracy that a run should reach; solve exits with 1 if it does not."""

    mre_at_most: Positive | None = None
    """Largest mean relative error of the solution's depth, after one median scale; null for no
    claim."""


class OutputOptions(Section):
    """What a result folder holds beside what it always holds."""

    page: bool = True
    """Write report.html, the page with the 3D view."""


def title(text: object) -> str:
    """A text as the name of a problem: forbidden characters become underscores."""
    kept = (c if c.isprintable() and c not in "/\\" else "_" for c in printable(text))
    return "".join(kept)[:LONGEST_NAME] or "problem"


def _is_title(text: str) -> str:
    if title(text) != text:
        raise ValueError(
            f"1 to {LONGEST_NAME} printable characters without / and \\: it names files"
        )
    return text


class Problem(Section):
    """One problem file."""

    name: Annotated[str, AfterValidator(_is_title)] = "problem"
    """Name for titles and folders."""
    preset: Literal["paper"] | None = None
    """Options below the keys of this file: paper, the method as printed (`soup-nlp show --preset
    paper`); null for the defaults."""
    input: Input
    """The frames to solve, by kind of input."""
    max_size: Positive | None = 1.5
    """Largest reference image that is solved as it is, megapixels. A larger pair is solved at this
    size, and its depth brought to the images' own size; null for no limit."""
    seed: Seed = 0
    """Seed of every random draw."""
    segmentation: SegmentationOptions = SegmentationOptions()
    """Superpixels and graphs."""
    flow: FlowOptions = FlowOptions()
    """Where the flow comes from."""
    depth_prior: PriorOptions = PriorOptions()
    """A depth of the reference frame from elsewhere."""
    start: StartOptions = StartOptions()
    """How the initialisation is computed."""
    energy: EnergyOptions = EnergyOptions()
    """Terms, weights, units."""
    formulation: FormulationOptions = FormulationOptions()
    """How the energy is written for the solver."""
    solver: SolverOptions = SolverOptions()
    """Stages and limits; eps are smoothing widths in the energy's unit."""
    refine: RefineOptions = RefineOptions()
    """Discrete refinement by particles."""
    expected: Expected = Expected()
    """The accuracy that the run should reach."""
    output: OutputOptions = OutputOptions()
    """What the result folder holds."""
    base: str = "."
    """Folder that relative paths start from (the file's own)."""

    def path(self, name: str) -> Path:
        """A path of this problem; a relative path starts from the folder of its file."""
        base, path = as_path(self.base, "folder of the problem"), as_path(name, "input", home=True)
        # realpath, unlike resolve, accepts a link to itself
        return Path(os.path.realpath(base / path))

    def digest(self) -> str:
        """Hash of all options that change the result: without names, folder and output files."""
        tree = self.model_dump(mode="json", exclude={"name", "base", "preset", "output"})
        return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:12]

    def identity(self) -> str:
        """Hash of the contents of images, cameras, truth, flow and prior, and of the options.

        Names and places of files do not count: a data set that was moved is the same, a file that
        was replaced under its name is another one. Of data sets the pair that they hold counts.
        """
        tree = self.model_dump(mode="json", exclude={"name", "base", "preset", "expected"})
        if self.input.kind not in ("files", "scene"):
            pair = self.load_pair()
            tree["input"] = {"pair": pair_hash(pair)}
            for key in ("depth_ref", "depth_next", "points", "flow"):
                if (known := getattr(pair.truth, key, None)) is not None:
                    content = np.ascontiguousarray(known).tobytes()
                    tree["input"][key] = hashlib.sha256(content).hexdigest()
        for section in tree.values():
            for key, name in section.items() if isinstance(section, dict) else ():
                named = isinstance(name, str) and is_file(self.path(name))
                if named or name in self.input.files():
                    section[key] = digest_of(self.path(name))
        return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def subject(self) -> str:
        """Name of the frames that are solved: kind of input, files or scene, without options."""
        options = self.input.model_dump()
        words = [options.pop("kind")]
        for key in ("root", "path", "ref", "next"):
            if key in options:
                words.append(str(self.path(options[key])))
        keys = ("scene", "seed", "variation", "render", "index", "frame", "step", "hash")
        return " ".join([*words, *(f"{key} {options[key]}" for key in keys if key in options)])

    def load_pair(self) -> Pair:
        """The frame pair, without its flow; SoupError if a file is missing or damaged."""
        self.depth_prior.require_prior()
        return replace(self.input.load(self.path), name=self.name)

    def input_paths(self) -> list[Path]:
        """Files and folders that are read; the name of a flow method is included as a path."""
        prior = [self.depth_prior.source] if self.depth_prior.source else []
        return [self.path(name) for name in (*self.input.files(), *self.flow.files(), *prior)]


def shipped_problems() -> dict[str, Path]:
    """Problem files that come with the package, by bare name."""
    package = Path(__file__).resolve().parents[1]
    # a wheel holds them inside the package, a checkout beside it
    homes = (package / "problems", package.parent / "problems")
    home = next((folder for folder in homes if folder.is_dir()), homes[0])
    return {path.stem: path for path in sorted(home.glob("*.yaml"))}


def load_problem(
    path: str | Path, overrides: Sequence[str] = (), *, solved: bool = True
) -> Problem:
    """Read a problem file, which is a ConfigError if it is missing or has a mistake.

    Args:
        path: YAML file, or the bare name of a problem of the package, such as "street", whose
            relative paths start from the working folder.
        overrides: `a.b=value` with the value in YAML.
        solved: Whether Ipopt may run. If so, the file must not name libraries or files of Ipopt,
            since whoever wrote it would decide which code runs and which file is overwritten.
    """
    path, base = _find(as_path(path, "problem file", error=ConfigError))
    text = read_text(path, "problem file", error=ConfigError)
    raw, lines = parse(text, str(path))
    if not isinstance(raw, dict):
        raise ConfigError(
            "problem file must be a mapping",
            where=path,
            found=type(raw).__name__,
            expected="keys such as input: {kind: motorcycle}",
        )
    if solved:
        refuse_libraries(raw.get("solver"), str(path))
    raw.setdefault("name", title(path.stem))
    raw.setdefault("base", str(base))
    return make_problem(raw, overrides, where=str(path), lines=lines)


def _find(path: Path) -> tuple[Path, Path]:
    """A problem file, and the folder that its relative paths start from."""
    bare = len(path.parts) == 1 and not path.suffix and not is_file(path)
    shipped = shipped_problems() if bare else {}
    if is_folder(path) and path.name not in shipped:
        raise ConfigError(
            "a problem is a file, not a folder",
            where=path,
            hint="soup-nlp chain FOLDER solves its frames, soup-nlp solve REF NEXT two images",
        )
    if not bare:
        return path, Path(os.path.realpath(path)).parent
    if path.name not in shipped:
        raise ConfigError(
            "neither a problem file nor a problem that comes with the package",
            where=path,
            expected=", ".join(shipped),
            hint=nearest(path.name[:60], [*shipped]) or "soup-nlp list says what each is",
        )
    return shipped[path.name], Path.cwd()


def make_problem(
    raw: Mapping[str, Any],
    overrides: Sequence[str] = (),
    where: str = "problem",
    lines: Mapping[Keys, str] | None = None,
) -> Problem:
    """Check a mapping of sections and its overrides, which both lie above the preset.

    `where` is the source of the mapping, and `lines` is where in it each key is, for messages; see
    `load_problem`.
    """
    expect(raw, Mapping, "problem", "a dict of sections: {'input': {'kind': 'motorcycle'}}")
    expect(overrides, (list, tuple), "overrides", "a list such as ['solver.max_iter=200']")
    for item in overrides:
        expect(item, str, "override", "text such as 'solver.max_iter=200'")
    expect(where, str, "where", "a name for messages")
    tree = copy.deepcopy(dict(raw))
    lines = {**(lines or {}), **{override(tree, item): f"--set {item}" for item in overrides}}
    preset = tree.get("preset")
    # the validation refuses an unknown one
    tree = merged(PRESETS.get(preset, {}) if isinstance(preset, str) else {}, tree)
    try:
        return Problem.model_validate(tree)
    except ValidationError as error:
        raise explain(error, Problem, tree, where, lines) from error


USUAL = (
    "max_size", "seed",
    "segmentation.superpixels", "segmentation.neighbours",
    "flow.source", "flow.backward", "flow.confidence",
    "depth_prior.source", "depth_prior.kind",
    "start.upright",
    "solver.max_iter", "solver.max_seconds",
    "refine.enabled", "refine.from_start", "refine.rounds", "refine.particles",
    "refine.max_seconds",
    "output.page",
)  # fmt: skip
"""Keys that users turn; `soup-nlp show` prints them and those that differ from their defaults."""


def dump_problem(problem: Problem, all_keys: bool = True) -> str:
    """The merged problem as YAML with a comment on every key; it can be solved again.

    Without `all_keys`, only keys of `USUAL` and those that are not at a default are written.
    """
    return "\n".join(_write(problem, "", "", all_keys)) + "\n"


def _write(model: Section, pad: str, prefix: str, all_keys: bool) -> Iterator[str]:
    for key, field in type(model).model_fields.items():
        value = getattr(model, key)
        comment = f"  # {' '.join((field.description or '').split())}"
        if isinstance(value, Section):
            lines = list(_write(value, pad + "  ", f"{prefix}{key}.", all_keys))
            yield from [f"{pad}{key}:{comment}", *lines] if lines else []
            continue
        # a required field differs from any default
        default = ... if field.is_required() else field.get_default(call_default_factory=True)
        if all_keys or f"{prefix}{key}" in USUAL or value != default:
            flow = None if isinstance(value, list | tuple | dict) else False
            text = yaml.dump({key: value}, Dumper=Dumper, default_flow_style=flow, width=10**6)
            yield f"{pad}{text.rstrip()}{comment}"
