"""The file that describes a search space, and the errors for mistakes in it."""

import numpy as np
import pytest

from jetbot_mjx.config import ConfigError, parse_config
from jetbot_mjx.tuning.space import Parameter, read_space, with_values

CONFIG = parse_config({})


def write(folder, text):
    path = folder / "space.yaml"
    path.write_text(text)
    return path


def test_ranges_and_choices_are_read(tmp_path):
    path = write(
        tmp_path,
        "ppo.learning_rate: {low: 1.0e-4, high: 1.0e-2, log: true}\n"
        "ppo.num_updates_per_batch: {low: 1, high: 8}\n"
        "ppo.unroll_length: {choices: [8, 16]}\n"
        "ppo.network.value_hidden_layer_sizes: {choices: [[64, 64], [128]]}\n"
        "randomization.friction: {choices: [null, [0.5, 1]]}\n",
    )
    assert read_space(path, CONFIG) == [
        Parameter("ppo.learning_rate", 1e-4, 1e-2, log=True),
        Parameter("ppo.num_updates_per_batch", 1, 8),
        Parameter("ppo.unroll_length", choices=(8, 16)),
        Parameter("ppo.network.value_hidden_layer_sizes", choices=((64, 64), (128,))),
        Parameter("randomization.friction", choices=(None, (0.5, 1))),
    ]
    assert [isinstance(one.low, int) for one in read_space(path, CONFIG)] == [
        False,
        True,
        False,
        False,
        False,
    ]


@pytest.mark.parametrize("space", [None, 3, ["ppo.discounting"]])
def test_what_names_no_space_is_told_what_does(space):
    with pytest.raises(ConfigError, match="is wrong: give a YAML file, its content, or the name"):
        read_space(space, CONFIG)


def test_the_setting_decides_whether_numbers_are_whole(tmp_path):
    path = write(
        tmp_path,
        "ppo.max_grad_norm: {low: 1, high: 3}\n"
        "ppo.num_timesteps: {low: 1e5, high: 1e6}\n"
        "task.options.pillars: {low: 1, high: 3}\n"
        "task.options.height: {low: 1, high: 2.5}\n",
    )
    for config in (CONFIG, parse_config({"ppo": {"max_grad_norm": None}})):
        assert [isinstance(one.low, int) for one in read_space(path, config)] == [
            False,
            True,
            True,
            False,
        ]


@pytest.mark.parametrize("name", ["ppo", "ppo.yaml", "configs/spaces/ppo.yaml"])
def test_a_shipped_space_is_found_by_name_and_path(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert "ppo.learning_rate" in {one.name for one in read_space(name, CONFIG)}


def test_an_unknown_space_is_refused_with_the_shipped_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="--space sac does not exist: give a file, or one of ppo"):
        read_space("sac", CONFIG)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("", "is empty: write lines such as"),
        ("ppo.learning_rate: 3", "write {low: A, high: B} or {choices: [...]}"),
        ("ppo.learning_rate: {low: 0.1, hihg: 0.2}", "hihg is unknown: did you mean high?"),
        ("ppo.learning_rate: {low: 2, high: 1}", "low the smaller"),
        ("ppo.learning_rate: {low: true, high: 1}", "should be numbers"),
        ("ppo.learning_rate: {low: 0, high: 1, log: true}", "true needs a low above 0"),
        ("ppo.learning_rate: {choices: []}", "choices should be a list"),
        ("ppo.learning_rate: {choices: [1.0], low: 1}", "without other keys"),
        ("ppo.learning_rate: {low: -1.0, high: 1.0}", "ppo.learning_rate = -1.0"),
        ("ppo.learning_rat: {low: 0.1, high: 1.0}", "did you mean ppo.learning_rate?"),
        ("rate: {low: 0.1, high: 1.0}", "rate = 0.1 is unknown"),
        ("ppo: {learning_rate: {low: 0.1, high: 1.0}}", "write ppo.learning_rate: {low: A, high"),
        ("ppo.network: {choices: [{activation: elu}]}", "such as ppo.network.activation"),
        ("ppo.unroll_length: {choices: [8, 16, 8]}", "8 is given twice among the choices"),
        ("ppo.network.policy_hidden_layer_sizes: {choices: [[64], [0]]}", "sizes.0 = 0"),
        ("ppo.learning_rate: {choices: [[1.0e-3]]}", "ppo.learning_rate = [0.001] is wrong"),
        ("seed: {low: 0, high: 9}", "seed cannot be searched: only settings of robot, task"),
        ("evaluation.episodes: {choices: [8, 16]}", "evaluation.episodes cannot be searched"),
        ("pqo.rate: {low: 0.1, high: 1.0}", "pqo.rate is unknown: write section.key"),
    ],
)
def test_a_mistake_is_told_in_one_line(tmp_path, line, told):
    with pytest.raises(ConfigError) as caught:
        read_space(write(tmp_path, line), CONFIG)
    assert told in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_a_space_may_have_numbers_and_arrays_of_numpy():
    sizes = "ppo.network.policy_hidden_layer_sizes"
    space = {
        "ppo.num_envs": {"low": np.int64(64), "high": np.int32(128), "log": np.bool_(True)},
        sizes: {"choices": [np.array([16]), [32, 32]]},
    }
    assert read_space(space, CONFIG) == [
        Parameter("ppo.num_envs", 64, 128, log=True),
        Parameter(sizes, choices=((16,), (32, 32))),
    ]


def test_a_space_may_be_a_mapping_with_tuples():
    name = "ppo.network.policy_hidden_layer_sizes"
    space = {name: {"choices": ([64, 64], (128,))}, "ppo.learning_rate": {"low": 1e-4, "high": 1}}
    assert read_space(space, CONFIG) == [
        Parameter(name, choices=((64, 64), (128,))),
        Parameter("ppo.learning_rate", 1e-4, 1.0),
    ]


@pytest.mark.parametrize(
    "entry",
    [
        {"choices": [{"key" * 1000: 1}]},
        {"choices": ["long" * 1000] * 2},
        {"low": 1, "high": 2, "log": "long" * 1000},
        {"long" * 1000: 1},
        ["long" * 1000],
    ],
)
def test_a_message_shows_long_values_in_short(entry):
    with pytest.raises(ConfigError) as caught:
        read_space({"ppo.learning_rate": entry}, CONFIG)
    assert len(str(caught.value)) < 1000


def test_values_that_fit_only_together_pass_alone(tmp_path):
    # 96 unrolls are no multiple of 512 environments: another number of environments may come too.
    path = write(tmp_path, "ppo.batch_size: {choices: [128, 24]}")
    assert read_space(path, CONFIG)
    with pytest.raises(ConfigError, match="not a multiple"):
        with_values(CONFIG, {"ppo.batch_size": 24}, source="trial 3")
    assert with_values(CONFIG, {"ppo.discounting": 0.9}, source="it").ppo.discounting == 0.9


def test_a_range_says_what_it_contains():
    rate = Parameter("ppo.learning_rate", 1e-4, 1e-2)
    assert [rate.contains(x) for x in (1e-3, 1e-5, 1.0, None)] == [True, False, False, False]
    assert Parameter("x", choices=(8, 16)).contains(16)
    assert not Parameter("x", choices=(8, 16)).contains(12)
