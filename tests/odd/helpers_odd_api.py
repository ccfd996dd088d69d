"""Arguments of the Python API that are of another kind."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from helpers_odd_run import Case
from helpers_odd_world import SIZE, World

import soup_nlp
from soup_nlp.data.formats import camera_files, images, map_files

THINGS: dict[str, Any] = {
    "None": None,
    "list": [],
    "dict": {},
    "nested list": [[1, [2]]],
    "int": 3,
    "float": math.nan,
    "huge int": 10**400,
    "text": "word",
    "bytes": b"\xff\0",
    "object": object(),
    "type": dict,
    "function": len,
    "scalar array": np.zeros(()),
    "vector": np.zeros(3),
    "objects": np.array([None, {}], object),
    "texts": np.array(["a", "b"]),
    "image": np.zeros((*SIZE, 3), np.uint8),
    "complex": np.zeros(SIZE, complex),
}


def api_cases() -> Iterator[Case]:
    def images_of(w: World) -> tuple[Any, Any, Any]:
        K = camera_files.intrinsics(60.0, 60.0, 32.0, 24.0)
        return images.read_image(w.good("a.png")), images.read_image(w.good("b.png")), K

    def pair(w: World, **changes: Any) -> Any:
        a, b, K = images_of(w)
        own = {"image_ref": a, "image_next": b, "K_ref": K, "K_next": K} | changes
        return soup_nlp.Pair(**own)

    def flow(w: World, **changes: Any) -> Any:
        uv = np.zeros((*SIZE, 2), np.float32)
        return soup_nlp.Flow(**({"uv": uv, "confidence": np.ones(SIZE, np.float32)} | changes))

    calls: dict[str, Callable[[World, Path, Any], Any]] = {
        "run": lambda w, o, x: soup_nlp.run(x),
        "run pair": lambda w, o, x: soup_nlp.run(soup_nlp.load_problem(w.good("p.yaml")), pair=x),
        "solve_pair": lambda w, o, x: soup_nlp.solve_pair(x),
        "solve_pair segmentation": lambda w, o, x: soup_nlp.solve_pair(pair(w), segmentation=x),
        "solve_pair superpixels": lambda w, o, x: soup_nlp.solve_pair(
            pair(w), segmentation={"superpixels": x}
        ),
        "load_problem": lambda w, o, x: soup_nlp.load_problem(x),
        "load_problem overrides": lambda w, o, x: soup_nlp.load_problem(w.good("p.yaml"), [x]),
        "make_problem": lambda w, o, x: soup_nlp.make_problem(x),
        "evaluate folder": lambda w, o, x: soup_nlp.evaluate(x, w.good("d.npy")),
        "evaluate depth": lambda w, o, x: soup_nlp.evaluate(w.result, x),
        "evaluate cap": lambda w, o, x: soup_nlp.evaluate(w.result, w.good("d.npy"), cap=x),
        "evaluate scale": lambda w, o, x: soup_nlp.evaluate(w.result, w.good("d.npy"), scale=x),
        **{
            f"Pair {key}": lambda w, o, x, key=key: pair(w, **{key: x})
            for key in ("image_ref", "image_next", "K_ref", "K_next", "flow", "truth", "name")
        },
        **{
            f"Flow {key}": lambda w, o, x, key=key: flow(w, **{key: x})
            for key in ("uv", "confidence")
        },
        **{
            f"Truth {key}": lambda w, o, x, key=key: pair(w, truth=soup_nlp.Truth(**{key: x}))
            for key in (
                "depth_ref",
                "depth_next",
                "flow",
                "occluded",
                "components",
                "motions",
                "points",
                "scene_flow",
            )
        },
        **{
            f"read {f.__name__}": lambda w, o, x, f=f: f(x)
            for f in (
                images.read_image,
                map_files.read_flow,
                map_files.read_depth,
                camera_files.read_intrinsics,
            )
        },
    }
    fine = {
        ("run pair", "None"),
        ("Pair K_ref", "None"),
        ("Pair K_next", "None"),
        # a picture has the shape of a scene flow
        ("Truth scene_flow", "image"),
        ("Flow confidence", "None"),
        ("evaluate cap", "huge int"),
        ("Pair flow", "None"),
        ("Pair truth", "None"),
        ("Pair name", "text"),
        ("evaluate cap", "None"),
        ("evaluate cap", "int"),
        ("Pair image_ref", "image"),
        ("Pair image_next", "image"),
        ("solve_pair segmentation", "dict"),
        ("solve_pair superpixels", "int"),
        ("make_problem", "dict"),
    }
    for name, call in calls.items():
        for what, thing in THINGS.items():
            allowed = (name, what) in fine or (name.startswith("Truth") and what == "None")
            if name == "solve_pair superpixels" and what == "int":
                continue
            if name == "solve_pair segmentation" and what == "dict":
                continue

            def do(w: World, o: Path, call=call, thing=thing) -> None:
                call(w, o, thing)

            yield Case("5 Python API", f"api {name} {what}", do, quiet=allowed)
