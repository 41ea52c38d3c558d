"""Loading configurations: files, overrides and errors."""

import copy
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.config import Config, ConfigError, load_config, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.errors import UserError

CONFIGS = sorted(Path(__file__).parents[2].joinpath("configs").glob("*.yaml"))


assert CONFIGS


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_config_loads_and_comes_back_equal(write, path):
    before = path.read_bytes()
    config = load_config(path)
    assert config != Config()
    assert load_config(write(config.to_yaml())) == config
    assert load_config(path) == config
    assert path.read_bytes() == before


def test_loading_mutates_neither_its_arguments_nor_the_defaults(root):
    overrides = ["seed=7", "ppo.network.activation=relu", "task.options.depth=2"]
    load_config(root / "configs" / "smoke.yaml", overrides)
    assert overrides == ["seed=7", "ppo.network.activation=relu", "task.options.depth=2"]
    values = {"ppo": {"network": {"policy_hidden_layer_sizes": [8]}}, "task": {"options": {"a": 1}}}
    kept = copy.deepcopy(values)
    config = parse_config(values)
    assert values == kept
    values["task"]["options"]["a"] = 2
    assert config.task.options == {"a": 1}
    # The one thing in a configuration that can be changed belongs to that one alone.
    for make in (Config, lambda: parse_config({}), lambda: parse_config({"task": {"name": "x:Y"}})):
        make().task.options["a"] = 3
        assert make().task.options == {}


@pytest.mark.parametrize("text", ["", "# nothing but a comment\n", "---\n", "{}", "\ufeff"])
def test_a_file_that_says_nothing_means_the_defaults(write, text):
    assert load_config(write(text)) == Config() == parse_config({})


TEXTS = ("1e-3", "010", "yes", "null", "~", "1_0", "0x1", "", "x: y", "# no", "two\nlines", "é€😀")


@pytest.mark.parametrize("value", [*TEXTS, 1e22, 1e-7, 2.0, 10**20, True, 0])
def test_free_options_come_back_as_they_were(write, value):
    config = parse_config({"task": {"options": {"it": value}}})
    back = load_config(write(config.to_yaml())).task.options["it"]
    assert (back, type(back)) == (value, type(value))


@pytest.mark.parametrize("way", ["yaml", "override"])
@pytest.mark.parametrize(
    ("key", "text", "expected"),
    [
        ("learning_rate", "1e-3", 0.001),
        ("learning_rate", "1.0e-3", 0.001),
        ("learning_rate", "1E-3", 0.001),
        ("max_grad_norm", "1", 1.0),
        ("num_timesteps", "3e7", 30_000_000),
        ("num_timesteps", "10_240", 10_240),
        ("num_timesteps", "2.0", 2),
        ("num_timesteps", "0x400", 1024),
    ],
)
def test_numbers_are_numbers(write, way, key, text, expected):
    if way == "yaml":
        config = load_config(write(f"ppo:\n  {key}: {text}\n"))
    else:
        config = load_config(write(""), [f"ppo.{key}={text}"])
    got = getattr(config.ppo, key)
    assert (got, type(got)) == (expected, type(expected))


def test_the_last_override_wins_and_touches_nothing_else(write):
    path = write("seed: 1\nppo:\n  gae_lambda: 0.5\n  network:\n    activation: elu\n")
    config = load_config(
        path,
        [
            "seed=2",
            "ppo.network.policy_hidden_layer_sizes=[64, 32]",
            "ppo.max_grad_norm=null",
            " task.name = own.package:Task ",
            "task.options.colour=red",  # neither section is in the file
            "seed=3",
        ],
    )
    assert config == parse_config(
        {
            "seed": 3,
            "ppo": {
                "gae_lambda": 0.5,
                "max_grad_norm": None,
                "network": {"activation": "elu", "policy_hidden_layer_sizes": [64, 32]},
            },
            "task": {"name": "own.package:Task", "options": {"colour": "red"}},
        }
    )
    assert config.ppo.network.policy_hidden_layer_sizes == (64, 32)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("seed", "--set seed: write section.key=value"),
        ("=3", "--set =3: write section.key=value"),
        ("ppo.=3", "--set ppo.=3: write section.key=value"),
        ("ppo..num_envs=3", "--set ppo..num_envs=3: write section.key=value"),
        ("ppo.num_envs: 3", "--set ppo.num_envs: 3: write section.key=value"),
        ("seed.x=1", "--set seed.x=1: seed is a value, not a section"),
        ("ppo={num_envs: 8}", "num_envs: 8}: set single keys, as in --set ppo.num_envs=8"),
        ("ppo.network={}", "--set ppo.network={}: set single keys, as in --set ppo.network.key=va"),
        ("ppo.gae_lambda.x=1", "ppo.gae_lambda.x=1: gae_lambda is a value, not a section"),
        ("seed=[", "--set seed=[, line 1 is not valid YAML"),
        ("ppo.num_env=3", "ppo.num_env = 3 is unknown: did you mean ppo.num_envs?"),
        ("ppo.num_envs=3=4", "ppo.num_envs = '3=4' is wrong: it should be a whole number"),
        ("ppo.num_envs=", "ppo.num_envs = None is wrong: it should be a whole number"),
        ("ppo=3", "ppo = 3 is not a section"),
        (f"robot.file={'x' * 300}.yaml", "x.yaml cannot be read: File name too long"),
        (f"robot.file={'x' * 300}.xml", "x.xml cannot be read: File name too long"),
        ('robot.file="a\\0b.xml"', "cannot be read: embedded null byte"),
        ("trainer.x=1", "trainer = {'x': 1} is wrong: it should be 'resumable' or 'brax'"),
    ],
)
def test_a_bad_override_is_refused(refusal, override, said):
    assert said in refusal("seed: 1\nppo: {gae_lambda: 0.5}", override)


def test_overrides_may_be_a_mapping_and_the_configuration_an_object():
    given = ["seed=7", "ppo.network.policy_hidden_layer_sizes=[8]", "task.options.depth=2"]
    values = {
        "seed": 7,
        "ppo.network.policy_hidden_layer_sizes": [8],
        "task.options.depth": 2,
    }
    kept = copy.deepcopy(values)
    base = load_config("smoke")
    assert load_config("smoke", values) == load_config("smoke", given) == load_config(base, values)
    assert load_config(base, given) == load_config("smoke", given)
    assert load_config(base) is base
    assert values == kept
    assert base == load_config("smoke")


SIZES = "ppo.network.policy_hidden_layer_sizes"


@pytest.mark.parametrize(
    ("key", "value", "plain"),
    [
        ("seed", np.int64(3), 3),
        ("seed", np.int32(3), 3),
        ("seed", np.array(3), 3),
        ("seed", jnp.int32(3), 3),
        ("tensorboard", np.bool_(False), False),
        ("ppo.learning_rate", np.float32(0.5), 0.5),
        ("ppo.learning_rate", jnp.float32(0.5), 0.5),
        (SIZES, np.array([32, 16]), [32, 16]),
        (SIZES, jnp.array([32, 16]), [32, 16]),
        (SIZES, [np.int64(32), 16], [32, 16]),
        (SIZES, (32, 16), [32, 16]),
    ],
)
def test_numbers_and_arrays_of_numpy_and_jax_are_taken_as_python_s(key, value, plain):
    found = load_config("smoke", {key: value})
    assert found == load_config("smoke", {key: plain})
    assert found.to_yaml() == load_config("smoke", {key: plain}).to_yaml()
    with pytest.raises(ConfigError, match="seed = -3 is wrong"):
        load_config("smoke", {"seed": np.int64(-3)})


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"ppo": {"num_envs": 8}}, "ppo = {'num_envs': 8}: set single keys, as in 'ppo.num_envs'"),
        (
            {"ppo.num_env": 8},
            "smoke with {'ppo.num_env': 8}: ppo.num_env = 8 is unknown: did you mean",
        ),
        ({"ppo.num_envs": "many"}, "ppo.num_envs = 'many' is wrong: it should be a whole number"),
        (
            {"seed": 1, "ppo.num_envs.x": 1},
            "ppo.num_envs.x = 1: num_envs is a value, not a section",
        ),
        ({3: 4}, "3 = 4 is unknown"),
        ("seed=1", "overrides = 'seed=1' is wrong: give settings and values, as in {'ppo.num_en"),
    ],
)
def test_a_bad_override_in_python_is_refused_in_its_own_terms(overrides, said):
    with pytest.raises(ConfigError) as caught:
        load_config("smoke", overrides)
    assert said in str(caught.value)
    assert "--set" not in str(caught.value)


def test_an_object_that_is_no_configuration_is_refused():
    with pytest.raises(ConfigError, match="config = 5 is wrong: it should be a name, a file or"):
        load_config(5)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("no_such_package.task:Task", "there is no no_such_package/task.py beside the YAML file"),
        ("jetbot_mjx.no_such:Task", "there is no jetbot_mjx/no_such.py beside the YAML file"),
        ("jetbot_mjx:GaolTask", "jetbot_mjx has no 'GaolTask'"),
        ("builtins:str", "is not a task: it lacks "),
    ],
)
def test_a_class_that_is_no_task_is_refused(name, said):
    config = parse_config({"task": {"name": name}})
    with pytest.raises(UserError) as caught:
        make_env(config)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert message.startswith(f"task.name = {name!r}")
    assert said in message
