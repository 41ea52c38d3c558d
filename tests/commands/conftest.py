"""What tests of several commands need: an empty folder, a run that nobody trained, refusals."""

import re
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs

from jetbot_mjx import cli
from jetbot_mjx.agents.networks import PolicyParams, make_networks
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.task import WORLD, layout_data
from jetbot_mjx.runs import checkpoint_store
from jetbot_mjx.runs.checkpoint import FORMAT


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to stand in; what a command leaves behind is left here."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def refused(here, capfd):
    """Gives a command arguments that it must refuse; returns the one line that it says."""

    def refused(command, *arguments):
        before = sorted(here.rglob("*"))
        with pytest.raises(SystemExit) as caught:
            cli.run_command(lambda _: command.main([str(argument) for argument in arguments]))
        out, err = capfd.readouterr()
        assert caught.value.code == 2
        assert out == ""
        assert err.endswith("\n")
        # Work that ended before the error is told with its seconds.
        err = re.sub(r"^ *\d+\.\d s  .*\n", "", err, flags=re.MULTILINE)
        assert len(err.splitlines()) == 1
        assert sorted(here.rglob("*")) == before
        return err

    return refused


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run folder with two checkpoints, untrained."""
    network = {"policy_hidden_layer_sizes": [4], "value_hidden_layer_sizes": [4]}
    config = parse_config({"ppo": {"network": network}})
    networks = make_networks(config.ppo, 16, 2)
    key = jax.random.PRNGKey(0)
    params = PolicyParams(
        running_statistics.init_state(specs.Array((16,), np.dtype("float32"))),
        networks.policy_network.init(key),
        networks.value_network.init(key),
    )
    about = {
        "format": FORMAT,
        "config": config.model_dump(mode="json"),
        "layout": layout_data(WORLD),
        "observation_size": 16,
        "action_size": 2,
    }
    folder = tmp_path_factory.mktemp("trained") / "run"
    folder.mkdir()
    params = jax.tree.map(lambda leaf: np.asarray(jnp.asarray(leaf)), params)
    about["metrics"] = {"success_rate": 0.5}
    with checkpoint_store.CheckpointStore(folder, keep=5) as checkpoints:
        for env_steps in (0, 2048):
            checkpoints.save(env_steps, {"policy": params}, about, 0.5)
    return folder


@pytest.fixture
def damaged(trained, here):
    """A copy of the run, and the folder of its last checkpoint, to be damaged."""
    shutil.copytree(trained, here / "run")
    return here / "run" / "checkpoints" / "000000002048"
