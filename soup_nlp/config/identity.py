"""What "the same input" means: a hash of the contents of a problem's files and of its options."""

import hashlib
import json
from typing import Any

import numpy as np

from soup_nlp.config.problem import Problem
from soup_nlp.data.inputs import pair_hash
from soup_nlp.data.pair import Pair
from soup_nlp.storage.folders import digest_of

NOT_OPTIONS = {"name", "base", "preset", "expected"}
"""Keys of a problem that change no result."""
FILES = {
    "input": ("ref", "next", "intrinsics", "intrinsics_next", "depth", "depth_next"),
    "flow": ("source", "backward", "confidence"),
    "depth_prior": ("source",),
}
"""Keys that may name a file, whose contents count instead of its name."""


def identity(problem: Problem, pair: Pair | None = None) -> str:
    """Hash of the contents of images, cameras, truth, flow and prior of a problem, and its options.

    Names and places of files do not count: a data set that was moved is the same, a file that was
    replaced under its name is another one. Of folders and data sets the pair that they hold counts;
    `pair` is that of a problem whose pair is in memory only.
    """
    tree = problem.model_dump(mode="json", exclude=NOT_OPTIONS)
    if pair is None and problem.input.kind not in ("files", "scene"):
        pair = problem.load_pair()
    if pair is not None:
        tree["input"] = _pair_contents(pair)
    for section, keys in FILES.items():
        for key in keys:
            name = tree[section].get(key)
            if isinstance(name, str) and (section == "input" or problem.path(name).is_file()):
                tree[section][key] = digest_of(problem.path(name))
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:16]


def _pair_contents(pair: Pair) -> dict[str, Any]:
    """Hashes of a pair and of the arrays of its truth."""
    names = ("depth_ref", "depth_next", "points", "flow")
    arrays = {name: getattr(pair.truth, name, None) for name in names}
    known = {k: np.ascontiguousarray(v) for k, v in arrays.items() if v is not None}
    hashes = {k: hashlib.sha256(v.tobytes()).hexdigest() for k, v in known.items()}
    return {"pair": pair_hash(pair), **hashes}
