"""A graph of scalars, and two of its inputs."""

import numpy as np
import pytest

from onekernel.lower.simplify import make_graph


@pytest.fixture
def graph():
    return make_graph()


@pytest.fixture
def x(graph):
    return graph.input(np.float32)


@pytest.fixture
def flag(graph):
    return graph.input(np.bool_)
