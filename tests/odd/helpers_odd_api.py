"""Arguments of wrong types for the Python API, and unusual uses of a run."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from helpers_odd_options import depth_png
from helpers_odd_run import Case, cases
from helpers_odd_world import SIZE, World

import soup_nlp

THINGS: dict[str, Any] = {
    "None": None,
    "list": [],
    "dict": {},
    "int": 3,
    "float": math.nan,
    "huge int": 10**400,
    "text": "word",
    "bytes": b"\xff\0",
    "object": object(),
    "function": len,
    "vector": np.zeros(3),
    "objects": np.array([None, {}], object),
    "texts": np.array(["a", "b"]),
    "image": np.zeros((*SIZE, 3), np.uint8),
    "complex": np.zeros(SIZE, complex),
}
STREET = {"input": {"kind": "scene", "scene": "street"}}
TRUTH = (
    "depth_ref", "depth_next", "flow", "occluded", "components", "motions", "points", "scene_flow",
)  # fmt: skip
CALLBACKS = ("listener", "stop", "log", "on_stage", "ipopt_log")


def pair(w: World, **changes: Any) -> Any:
    """A pair with other arguments."""
    known = {"image_ref": w.good("a.png"), "image_next": w.good("b.png")}
    return soup_nlp.Pair(**({**known, "K_ref": (60, 60, 32, 24)} | changes))


def flow(**changes: Any) -> Any:
    """A flow with other arguments."""
    uv, ones = np.zeros((*SIZE, 2), np.float32), np.ones(SIZE, np.float32)
    return soup_nlp.Flow(**({"uv": uv, "confidence": ones} | changes))


Call = Callable[[World, Path, Any], Any]
CALLS: dict[str, Call] = {
    "run": lambda w, o, x: soup_nlp.run(x),
    "run pair": lambda w, o, x: soup_nlp.run(soup_nlp.load_problem(w.good("p.yaml")), pair=x),
    **{
        f"run {name}": lambda w, o, x, n=name: soup_nlp.run(w.run.problem, **{n: x})
        for name in CALLBACKS
    },
    "solve_pair": lambda w, o, x: soup_nlp.solve_pair(x),
    "solve_pair segmentation": lambda w, o, x: soup_nlp.solve_pair(pair(w), segmentation=x),
    "solve_pair superpixels": lambda w, o, x: soup_nlp.solve_pair(
        pair(w), segmentation={"superpixels": x}
    ),
    "solve_pair preset": lambda w, o, x: soup_nlp.solve_pair(w.run.pair, preset=x),
    "solve_pair flow": lambda w, o, x: soup_nlp.solve_pair(w.run.pair, flow=x),
    "load_problem": lambda w, o, x: soup_nlp.load_problem(x),
    "load_problem overrides": lambda w, o, x: soup_nlp.load_problem(w.good("p.yaml"), [x]),
    "make_problem": lambda w, o, x: soup_nlp.make_problem(x),
    "make_problem overrides": lambda w, o, x: soup_nlp.make_problem(STREET, x),
    "make_problem where": lambda w, o, x: soup_nlp.make_problem(STREET, where=x),
    "make_problem preset": lambda w, o, x: soup_nlp.make_problem(STREET | {"preset": x}),
    "evaluate folder": lambda w, o, x: soup_nlp.evaluate(x, w.good("d.npy")),
    "evaluate depth": lambda w, o, x: soup_nlp.evaluate(w.result, x),
    "evaluate cap": lambda w, o, x: soup_nlp.evaluate(w.result, w.good("d.npy"), cap=x),
    "evaluate moving": lambda w, o, x: soup_nlp.evaluate(w.result, w.good("d.npy"), moving=x),
    "evaluate scale": lambda w, o, x: soup_nlp.evaluate(w.result, w.good("d.npy"), scale=x),
    "evaluate depth_scale": lambda w, o, x: soup_nlp.evaluate(
        w.result, depth_png(o), depth_scale=x
    ),
    **{
        f"Pair {key}": lambda w, o, x, key=key: pair(w, **{key: x})
        for key in ("image_ref", "image_next", "K_ref", "K_next", "flow", "truth", "name")
    },
    "Flow uv": lambda w, o, x: flow(uv=x),
    "Flow confidence": lambda w, o, x: flow(confidence=x),
    **{
        f"Truth {key}": lambda w, o, x, key=key: pair(w, truth=soup_nlp.Truth(**{key: x}))
        for key in TRUTH
    },
    "save folder": lambda w, o, x: w.run.save(x),
    "save formats": lambda w, o, x: w.run.save(o / "out", formats=x),
    "save format": lambda w, o, x: w.run.save(o / "out", formats=[x]),
    "load": lambda w, o, x: soup_nlp.load(x),
    "with_flow": lambda w, o, x: w.run.pair.with_flow(x),
    "components": lambda w, o, x: w.run.components[x],
}
FINE = {
    "run pair": "None",
    "Pair K_ref": "None",
    "Pair K_next": "None",
    "Pair flow": "None",
    "Pair truth": "None",
    "Pair name": "text",
    "Pair image_ref": "image",
    "Pair image_next": "image",
    "Flow confidence": "None",
    **{f"Truth {key}": "None" for key in TRUTH},
    # a picture has the shape of a scene flow
    "Truth scene_flow": "None, image",
    "evaluate cap": "None, int, huge int",
    "evaluate depth_scale": "None, int",
    "evaluate moving": "None",
    "make_problem": "dict",
    "make_problem preset": "None",
    "make_problem overrides": "list",
    "make_problem where": "text",
    "save formats": "None, list, dict",
    "with_flow": "None",
}
"""Arguments that are valid, or useless but harmless."""
LEFT_OUT = {
    # these solve
    "solve_pair segmentation": "dict",
    "solve_pair superpixels": "int",
    "solve_pair preset": "None",
    "solve_pair flow": "None, dict",
    "run stop": "None",
    # valid names of files, in the working folder
    "run ipopt_log": "None, text",
    "save folder": "text",
    # an exception of the caller's function is not an error of the package
    **{f"run {name}": "None, function" for name in ("listener", "log", "on_stage")},
}


def _called(do: Call) -> Any:
    """The call without its answer, which is no command line."""
    return lambda w, o, x: (do(w, o, x), None)[1]


def _strided(w: World, o: Path, _: object) -> None:
    """Views that are not contiguous, read-only arrays and other byte orders are arrays."""
    a, b = (np.asarray(x) for x in (w.run.pair.image_ref, w.run.pair.image_next))
    K = np.asarray(w.run.pair.K_ref, ">f8")
    made = soup_nlp.Pair(a[:, ::-1], np.asfortranarray(b), K)
    a.flags.writeable = False
    made.with_flow(soup_nlp.Flow(np.zeros((*SIZE, 2), ">f4"), np.ones(SIZE, np.float16)))


def api_cases() -> Iterator[Case]:
    """Calls of the Python API with every kind of argument."""
    for name, call in CALLS.items():
        fine, left = (table.get(name, "").split(", ") for table in (FINE, LEFT_OUT))
        for quiet in (False, True):
            things = {k: v for k, v in THINGS.items() if k not in left and (k in fine) is quiet}
            yield from cases(f"api {name} {{}}", _called(call), things, quiet=quiet)
    yield from cases("arrays of {}", _strided, ["other layouts"], quiet=True)
    huge = {"truth that overflows": np.full(SIZE, 1e300)}
    yield from cases("{}", _called(lambda w, o, x: soup_nlp.Truth(depth_ref=x)), huge)
