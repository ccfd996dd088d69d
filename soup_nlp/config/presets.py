"""Named sets of options that a problem's keys override. `preset: paper` is the method as printed.

The paper prints the factor 1 of E_arap, K of 15 to 20, 1,000 to 2,000 superpixels, 50 particles
and 5 to 10 rounds. alpha1 to alpha3, beta, sigma and n were "tuned differently for different
datasets" and are not printed: the values here are one set for 1,000 superpixels, see
docs/formulation.md. E is 1 / alpha1 times the printed one, so that a pixel of re-projection error
costs 1 as in the defaults: only ratios matter, and the solver's tolerances are absolute.
"""

import copy
import json
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import yaml

Tree = dict[str, Any]

_INF = float("inf")

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "paper": {
            "max_size": None,
            "segmentation": {
                "superpixels": 1000,
                "method": "slic",
                "follow_flow_px": None,
                "neighbours": 15,
            },
            "flow": {"consistency": False},
            "start": {
                "method": "homography",
                "samples": 100,
                "threshold_px": 0.5,
                "bending": False,
                "ground": False,
            },
            "energy": {
                "units": "paper",
                "arap_at_anchors": False,
                "across": 1.0,
                "arap_scene": 0.0,
                "weights": {
                    "arap": 500.0,
                    "proj": 1.0,
                    "cont": 15.0,
                    "orient": 0.1,
                    "prior": 0.0,
                    "depth": 0.0,
                    "order": 0.0,
                    "sigma_cont": 0.02,
                    "sigma_cont_ref": _INF,
                    "sigma_orient": 0.5,
                    "sigma_arap": _INF,
                    "leak_arap": 0.0,
                    "sigma_proj": _INF,
                },
            },
            "formulation": {"gauge": "unit-translation", "min_facing": 0.0, "depth_ratio": 1e6},
            "refine": {
                "enabled": True,
                "from_start": False,
                "rounds": 5,
                "particles": 50,
                "proposals": "walks",
                "stagnation": 0.0,
                "photo": 0.0,
            },
        }
    }
)
"""Options by name."""


def with_preset(tree: Mapping[str, Any]) -> Tree:
    """The tree of a problem merged over the options of its preset; unchanged without a preset.

    An unknown name is rejected later, by the validation of the problem.
    """
    name = tree.get("preset")
    if not isinstance(name, str) or name not in PRESETS:
        return dict(tree)
    return _over(PRESETS[name], tree)


def _over(below: Mapping[str, Any], above: Mapping[str, Any]) -> Tree:
    """Both trees merged section by section; where a key is in both, `above` has the value."""
    out: Tree = copy.deepcopy(dict(below))
    for key, value in above.items():
        old = out.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            out[key] = _over(old, value)
        else:
            out[key] = value
    return out


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of every option."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def overrides_of(name: str) -> tuple[str, ...]:
    """The options of a preset as `--set` takes them."""
    return tuple(as_override(key, value) for key, value in leaves(PRESETS[name]))


def dump_preset(name: str) -> str:
    """The options of a preset as YAML."""
    return yaml.safe_dump(PRESETS[name], sort_keys=False)


def as_override(key: str, value: Any) -> str:
    """An option as `a.b=value`, as `--set` takes it."""
    return f"{key}={'.inf' if value == _INF else json.dumps(value)}"
