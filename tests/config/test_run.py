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
        "Config(seed=3, checkpoint_interval=65536, "
        "task=TaskConfig(observation='egocentric', step_cost=0.02),"
        " ppo=PPOConfig(num_timesteps=524288, num_envs=256, batch_size=64, learning_rate=0.002,"
        " discounting=0.97, network=NetworkConfig(activation='swish')))"
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


OWN = "environment: hopper.py:Hopper"


def test_an_environment_is_named_by_its_file_or_its_module(write):
    for name in ("hopper.py:Hopper", "hopper:Hopper"):
        config = load_config(write(f"environment: {name}"))
        assert (config.environment, config.code) == ("hopper:Hopper", "hopper:Hopper")
    assert load_config(write("environment: tools/park.py:A.B")).environment == "tools.park:A.B"
    assert load_config(write("environment: brax.envs:get_environment")).code.startswith("brax.")
    assert Config().code == Config().task.name


def test_an_environment_has_no_units(write):
    assert load_config(write(OWN)).ppo.normalizer == "brax"
    # What is set beside it stays.
    config = load_config(write(f"{OWN}\nppo: {{num_envs: 512}}"))
    assert (config.ppo.normalizer, config.ppo.num_envs) == ("brax", 512)


@pytest.mark.parametrize(
    "settings",
    [
        "task: {episode_length: 77}",
        "physics: {impl: xla}",
        "ppo: {network: {distribution_type: categorical}}",
        "environment_options: {env_name: ant, depth: {of: [1, 2.5, null, true]}}",
        "stop_at_return: -5.5",
    ],
)
def test_an_environment_takes_what_is_not_of_the_robot(write, settings):
    load_config(write(f"{OWN}\n{settings}"))


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ("environment: hopper.py", "with a file beside the configuration, or package.module:Class"),
        ("environment: hopper.Hopper", "or package.module:Class, perhaps hopper:Hopper"),
        (
            "environment: 'my-env.py:Env'",
            "environment: 'my-env.py:Env' is wrong: Python cannot import 'my-env': rename the file",
        ),
        ("environment: 'a b/envs.py:Env'", "Python cannot import 'a b': rename the file or folder"),
        ("environment: examples", "environment: 'examples' is wrong: write file.py:Class"),
        ("environment: examples/", "environment: 'examples/' is wrong: write file.py:Class"),
        ("environment: 3", "environment = 3 is wrong: it should be text"),
        (
            f"{OWN}\ntask: {{observation: world, options: {{a: 1}}}}",
            "task.options = {'a': 1} is of",
        ),
        (f"{OWN}\ntask: {{name: my_task:Mine}}", "task.name = 'my_task:Mine' is of the JetBot"),
        (
            f"{OWN}\nrobot: {{wheel_radius: 0.02}}",
            "robot.wheel_radius = 0.02 is of the JetBot, which environment =",
        ),
        (f"{OWN}\ncamera: {{width: 16}}", "camera.width = 16 is of the JetBot"),
        (f"{OWN}\nphysics: {{tolerance: 0.001}}", "physics.tolerance = 0.001 is of the JetBot"),
        (f"{OWN}\nrandomization: {{mass: [0.9, 1.1]}}", "randomization.mass"),
        (f"{OWN}\nppo: {{normalizer: physical}}", "needs the units of the observation, which"),
        (f"{OWN}\nenvironment_options: {{1: 2}}", "environment_options"),
        (f"{OWN}\nenvironment_options: [1]", "environment_options = [1]"),
        (f"{OWN}\nenvironment_options: {{mass: .nan}}", "environment_options"),
        ("environment_options: {a: 1}", "{'a': 1} are the arguments of an environment, and there"),
        (
            "ppo: {network: {distribution_type: categorical}}",
            "is for an environment whose actions are choices, and those of the robot are numbers",
        ),
    ],
)
def test_what_does_not_fit_an_environment_is_refused(refusal, settings, told):
    message = refusal(settings)
    assert told in message
    assert "\n" not in message
    assert "perhaps hopper:py" not in message
