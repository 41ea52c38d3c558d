"""The whole configuration: its order, its representation, and the checks across sections."""

import re

import pytest
from pydantic import ValidationError
from ruamel.yaml import YAML

from jetbot_mjx.config import Config, ConfigError, load_config, parse_config, shipped_configs


def test_the_resolved_yaml_holds_every_key_in_the_order_of_the_code():
    written = YAML(typ="safe", pure=True).load(Config().to_yaml())
    assert written == Config().model_dump(mode="json")
    assert list(written) == list(Config.model_fields)
    assert list(written["ppo"]) == list(type(Config().ppo).model_fields)


@pytest.mark.parametrize(
    ("section", "key"), [((), "seed"), (("ppo",), "num_envs"), (("ppo", "network"), "activation")]
)
def test_a_configuration_is_frozen(section, key):
    part = Config()
    for name in section:
        part = getattr(part, name)
    before = getattr(part, key)
    with pytest.raises(ValidationError, match="frozen"):
        setattr(part, key, before)
    with pytest.raises(ValidationError):
        part.a_new_key = 1


def test_a_configuration_shows_what_differs_from_the_defaults():
    config = load_config("jetbot_egocentric", {"seed": 3})
    assert repr(config) == (
        "Config(seed=3, checkpoint_interval=65536, task=TaskConfig(observation='egocentric'),"
        " ppo=PPOConfig(num_timesteps=524288, num_envs=256, batch_size=64))"
    )
    assert repr(Config()) == "Config()"


def test_the_suggested_checkpoint_interval_is_the_smallest_that_works(refusal, write):
    # 4 unrolls a minibatch · 2 minibatches · 5 steps an unroll = 40 steps
    ppo = "ppo: {num_envs: 8, batch_size: 4, num_minibatches: 2, unroll_length: 5}"
    message = refusal(ppo, "checkpoint_interval=39")
    assert "checkpoint_interval = 39 is shorter than one training step of 40" in message
    assert message.endswith("make it at least 40")
    assert load_config(write(ppo), ["checkpoint_interval=40"]).checkpoint_interval == 40


@pytest.mark.parametrize(
    ("num_envs", "batch_size", "devices", "key"),
    [
        (100, 100, 8, "num_envs"),
        (1, 1, 2, "num_envs"),
        (8, 4, 8, "batch_size"),
        (30, 10, 6, "batch_size"),
    ],
)
def test_environments_that_devices_cannot_share_are_refused(num_envs, batch_size, devices, key):
    ppo = {"num_envs": num_envs, "batch_size": batch_size, "num_minibatches": 12}
    config = parse_config({"ppo": ppo})
    config.check_devices(1)
    with pytest.raises(ConfigError) as caught:
        config.check_devices(devices)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert f"ppo.{key} = {ppo[key]} cannot be shared evenly by {devices} devices" in message
    fit = int(re.search(rf"ppo\.{key} = (\d+)$", message)[1])
    assert fit >= 1
    assert fit % devices == 0


@pytest.mark.parametrize("name", sorted(shipped_configs()))
def test_brax_s_trainer_takes_every_configuration_of_the_package(name):
    config = load_config(name, ["trainer=brax"])
    assert (config.ppo.normalizer, config.ppo.network.shared_cnn) == ("brax", False)
    # A setting that is given is not replaced by a default.
    own = config.environment is not None
    told = "needs the units" if own else "is not supported"
    with pytest.raises(ConfigError, match=rf"ppo\.normalizer = 'physical' {told}"):
        load_config(name, ["trainer=brax", "ppo.normalizer=physical"])
    assert load_config(name).ppo.normalizer == ("brax" if own else "physical")
