"""What the end of a training says comes next."""

import importlib.util
from pathlib import Path

import pytest

from jetbot_mjx.training import session


@pytest.mark.parametrize("installed", [True, False])
def test_the_end_names_the_next_commands_and_tensorboard_where_it_is_installed(
    installed, monkeypatch
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if installed else None)
    mine = Path("runs/mine")
    lines = session.summary(session.Result(mine, [mine], [], [], True, 1.0)).splitlines()
    assert lines[1:4] == [
        "next: python -m jetbot_mjx.evaluate runs/mine",
        "      python -m jetbot_mjx.render runs/mine",
        "      python -m jetbot_mjx.play runs/mine",
    ]
    assert lines[4:] == (["      tensorboard --logdir runs"] if installed else [])
