"""Random MuJoCo models step as kernels as they do in MJX."""

import pytest

from helpers.mjx_comparison import MjxExplodesError, assert_moves_as_in_mjx
from helpers.random_models import random_model
from onekernel import default_backend

pytestmark = pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")

COUNT = 210
INSTANCES = 16


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(COUNT))
def test_hundreds_of_random_models_move_as_in_mjx(seed):
    try:
        assert_moves_as_in_mjx(*random_model(seed, INSTANCES))
    except MjxExplodesError as error:
        pytest.skip(str(error))
