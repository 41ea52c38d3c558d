"""Random MuJoCo models step as kernels as they do in MJX."""

import pytest

from helpers.mjx_comparison import MjxExplodesError, assert_moves_as_in_mjx
from helpers.random_models import random_model
from onekernel import default_backend

pytestmark = pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")

QUICK = (101,)
"""Of the smaller ones, one with actuators, sensors and limits."""
COUNT = 210
INSTANCES = 16


@pytest.mark.parametrize("seed", QUICK)
def test_a_random_model_moves_as_in_mjx(seed):
    assert_moves_as_in_mjx(*random_model(seed, INSTANCES))


@pytest.mark.slow
@pytest.mark.parametrize("seed", sorted({*range(COUNT)} - {*QUICK}))
def test_hundreds_of_random_models_move_as_in_mjx(seed):
    try:
        assert_moves_as_in_mjx(*random_model(seed, INSTANCES))
    except MjxExplodesError as error:
        pytest.skip(str(error))
