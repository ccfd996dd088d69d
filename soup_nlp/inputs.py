"""From a problem to its frame pair and flow."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.config import Problem
from soup_nlp.config_inputs import (
    FilesInput,
    FolderInput,
    KittiInput,
    MemoryInput,
    MotorcycleInput,
    SceneInput,
    SintelInput,
    TumInput,
    VkittiInput,
)
from soup_nlp.data import datasets
from soup_nlp.data.flow import dis_flow, flow_from_truth, is_named, resolve_flow
from soup_nlp.data.formats import read_depth, read_image
from soup_nlp.data.formats_camera import read_intrinsics
from soup_nlp.data.pair import Flow, Pair, Truth
from soup_nlp.data.scenes import render_scene
from soup_nlp.errors import ConfigError
from soup_nlp.geometry.camera import intrinsics

Float = NDArray[np.float64]

FILE_KEYS = ("ref", "next", "intrinsics", "intrinsics_next", "depth", "depth_next")
"""Keys of an input of kind files that may name a file."""


def load_pair(problem: Problem) -> Pair:
    """The frame pair of a problem, without its flow.

    Raises:
        ConfigError: the pair was in memory only.
        DataError: a file is missing, damaged, or does not fit.
    """
    source = problem.input
    _refuse_memory(problem)
    if isinstance(source, MotorcycleInput):
        pair = datasets.load_motorcycle()
    elif isinstance(source, SceneInput):
        pair = render_scene(source.scene, source.seed, source.width, source.height)
    elif isinstance(source, FilesInput):
        pair = _load_files(problem, source)
    elif isinstance(source, FolderInput):
        pair = datasets.load_folder(
            problem.path(source.path), source.depth_scale, source.unit, source.white
        )
    elif isinstance(source, TumInput):
        pair = datasets.load_tum(problem.path(source.path), source.frame, source.step)
    elif isinstance(source, SintelInput):
        pair = datasets.load_sintel(
            problem.path(source.root), source.scene, source.frame, source.render, source.step
        )
    elif isinstance(source, KittiInput):
        twelve = source.kind == "kitti2012"
        kitti = datasets.load_kitti2012 if twelve else datasets.load_kitti2015
        pair = kitti(problem.path(source.root), source.index, source.occ)
    elif isinstance(source, VkittiInput):
        root, where = problem.path(source.root), (source.scene, source.frame, source.variation)
        if source.kind == "vkitti1":
            pair = datasets.load_vkitti1(root, *where, step=source.step)
        else:
            pair = datasets.load_vkitti2(root, *where, step=source.step)
    return replace(pair, name=problem.name)


def pair_hash(pair: Pair) -> str:
    """Hash of what decides a result: images, cameras and, where there is one, the flow."""
    digest = hashlib.sha256()
    arrays: list[NDArray[Any]] = [pair.image_ref, pair.image_next, pair.K_ref, pair.K_next]
    if pair.flow is not None:
        arrays += [pair.flow.uv, pair.flow.confidence]
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}\0".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def _refuse_memory(problem: Problem) -> None:
    """Raise ConfigError for a problem whose pair is nowhere but in the run that made it."""
    if isinstance(problem.input, MemoryInput):
        raise ConfigError(
            "pair of this problem was in memory and is not stored",
            where="input.kind",
            found=f"memory, hash {problem.input.hash}",
            expected="an input of files, such as kind: files",
            hint="solve it from Python with soup_nlp.solve_pair, or write the images to files",
        )


def input_paths(problem: Problem) -> list[Path]:
    """Files and folders that a problem reads; what is no file (a flow's name) is harmless here.

    Raises:
        ConfigError: the pair was in memory only.
    """
    source = problem.input
    _refuse_memory(problem)
    keys = (*FILE_KEYS, "path", "root")
    named = [value for key in keys if isinstance(value := getattr(source, key, None), str)]
    return [problem.path(name) for name in (*named, problem.flow.source)]


def _load_files(problem: Problem, source: FilesInput) -> Pair:
    ref, next_ = (read_image(problem.path(x), source.white) for x in (source.ref, source.next))
    depths = [
        None if name is None else read_depth(problem.path(name), source.depth_scale)
        for name in (source.depth, source.depth_next)
    ]
    truth = None
    if any(depth is not None for depth in depths):
        truth = Truth(depth_ref=depths[0], depth_next=depths[1], unit=source.unit)
    K_ref = _camera(problem, source.intrinsics)
    K_next = K_ref if source.intrinsics_next is None else _camera(problem, source.intrinsics_next)
    return Pair(ref, next_, K_ref, K_next, truth=truth)


def _camera(problem: Problem, given: list[float] | str) -> Float:
    """(3, 3) intrinsics of four numbers or of a file."""
    return read_intrinsics(problem.path(given)) if isinstance(given, str) else intrinsics(*given)


def load_flow_of(problem: Problem, pair: Pair) -> Flow:
    """The flow that a problem asks for.

    Raises:
        DataError: the source is unknown, or its flow is damaged or does not fit.
    """
    f = problem.flow
    if f.source == "dis":
        return dis_flow(pair.image_ref, pair.image_next, **f.dis.model_dump())
    if f.source == "truth":
        return flow_from_truth(pair, f.occluded_confidence)
    if is_named(f.source) or not (Path(f.source).suffix or "/" in f.source):
        return resolve_flow(pair, f.source)
    return resolve_flow(pair, str(problem.path(f.source)))
