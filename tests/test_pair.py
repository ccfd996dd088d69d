"""What a pair and its flow refuse."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.data.flow.sources import dis_flow
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.geometry.camera import intrinsics

IMAGE = np.zeros((40, 60, 3), np.uint8)
K = intrinsics(60, 60, 30, 20)


def test_rows_of_numbers_are_a_camera():
    pair = Pair(IMAGE, IMAGE, K.tolist(), K.astype(np.float32))
    np.testing.assert_array_equal(pair.K_ref, K)
    assert pair.K_ref.dtype == pair.K_next.dtype == np.float64


@pytest.mark.parametrize("bad", [[[1, 2], [3]], "K.txt", None, [["a"] * 3] * 3])
def test_what_is_no_matrix_is_refused(bad):
    with pytest.raises(DataError, match="intrinsics"):
        Pair(IMAGE, IMAGE, K, bad)


@pytest.mark.parametrize("focal", [(0.5, 0.8), (60, 0.8), (2.9, 60)])
def test_normalised_intrinsics_are_refused_with_a_hint(focal):
    with pytest.raises(DataError, match="normalised"):
        Pair(IMAGE, IMAGE, K, intrinsics(*focal, 0.5, 0.5))
    Pair(IMAGE, IMAGE, K, intrinsics(3.1, 2.1, 30, 20))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -0.1, 1.1])
def test_a_confidence_is_between_0_and_1(bad):
    confidence = np.ones((4, 5), np.float32)
    Flow(np.zeros((4, 5, 2), np.float32), confidence)
    confidence[2, 3] = bad
    with pytest.raises(DataError, match="confidence is out of range"):
        Flow(np.zeros((4, 5, 2), np.float32), confidence)


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        *((name, bad) for name in ("alpha", "delta", "gamma") for bad in (np.nan, np.inf, -1.0)),
        *(("refinement_iterations", bad) for bad in (np.nan, 2.5, -1, 10**9)),
        *((name, 1.5) for name in ("finest_scale", "patch_stride", "support", "planes")),
        ("tau", np.nan),
        ("alpha", "much"),
        ("planes", True),
    ],
)
def test_dis_options_that_opencv_would_not_survive_are_refused(name, bad):
    with pytest.raises(ConfigError, match=name):
        dis_flow(IMAGE, IMAGE, **{name: bad})
