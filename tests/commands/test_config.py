"""The configuration: what loads, what comes back, and what is refused in one line that helps."""

import copy
import re
from pathlib import Path

import pytest
from pydantic import ValidationError
from ruamel.yaml import YAML

from jetbot_mjx.config import Config, ConfigError, load_config, parse_config, shipped_configs
from jetbot_mjx.envs.jetbot_env import make_env
from jetbot_mjx.errors import UserError

CONFIGS = sorted(Path(__file__).parents[2].joinpath("configs").glob("*.yaml"))
assert CONFIGS


@pytest.fixture
def write(tmp_path):
    """Writes a YAML file and gives its path."""

    def write(text):
        path = tmp_path / "mine.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def refusal(write):
    """The one line by which a file, with overrides, is refused."""

    def refusal(text, *overrides):
        with pytest.raises(ConfigError) as caught:
            load_config(write(text), overrides)
        message = str(caught.value)
        assert len(message.splitlines()) == 1
        return message

    return refusal


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


def test_the_resolved_yaml_holds_every_key_in_the_order_of_the_code():
    written = YAML(typ="safe", pure=True).load(Config().to_yaml())
    assert written == Config().model_dump(mode="json")
    assert list(written) == list(Config.model_fields)
    assert list(written["ppo"]) == list(type(Config().ppo).model_fields)


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


BAD_VALUES = {
    # Keys that do not exist.
    "typo": ("ppo: {num_env: 3}", "ppo.num_env = 3", "did you mean ppo.num_envs?"),
    "typo in a nested section": (
        "ppo: {network: {activaton: relu}}",
        "ppo.network.activaton = 'relu'",
        "did you mean ppo.network.activation?",
    ),
    "typo of a section": ("pppo: {seed: 3}", "pppo.seed = 3", "did you mean seed?"),
    "unknown key": (
        "robot: {shade: red}",
        "robot.shade = 'red'",
        "is unknown: known are preset",
    ),
    "unknown section": ("zzz: {a: 1}", "zzz.a = 1", "known are seed, seeds, trainer,"),
    "key in the wrong section": ("num_envs: 3", "num_envs = 3", "did you mean ppo.num_envs?"),
    "key that is a number": ("ppo: {1: 2}", "ppo.1 = 1", "should be strings"),
    # Types.
    "string for a count": ("ppo: {num_envs: many}", "ppo.num_envs = 'many'", "whole number"),
    "string for a number": ("ppo: {learning_rate: '1e-3'}", "learning_rate = '1e-3'", "number"),
    "fraction for a number": ("physics: {ctrl_dt: 1/60}", "physics.ctrl_dt = '1/60'", "number"),
    "broken number for a count": ("ppo: {batch_size: 1.5}", "ppo.batch_size = 1.5", "whole number"),
    "bool for a count": ("seed: true", "seed = True", "whole number"),
    "bool for a number": ("task: {max_speed: true}", "task.max_speed = True", "number"),
    "number for a bool": (
        "ppo: {normalize_observations: 1}",
        "ppo.normalize_observations = 1",
        "true or false",
    ),
    # YAML 1.1 would read a bool.
    "word for a bool": (
        "ppo: {normalize_advantage: yes}",
        "ppo.normalize_advantage = 'yes'",
        "true or false",
    ),
    "number for a string": ("task: {name: 3}", "task.name = 3", "text"),
    "list for a scalar": ("ppo: {num_envs: [1, 2]}", "ppo.num_envs = [1, 2]", "whole number"),
    "mapping for a scalar": ("seed: {a: 1}", "seed = {'a': 1}", "whole number"),
    "scalar for a list": (
        "ppo: {network: {policy_hidden_layer_sizes: 32}}",
        "ppo.network.policy_hidden_layer_sizes = 32",
        "it should be",
    ),
    "scalar for a section": ("ppo: 3", "ppo = 3 is not a section", "set ppo.num_timesteps"),
    "list for a section": ("ppo: [1]", "ppo = [1] is not a section", "set ppo.num_timesteps"),
    "name for a section": ("robot: isaac", "robot = 'isaac'", "set robot.preset"),
    "nothing for a section": ("robot:", "robot = None", "write its keys below it"),
    "nothing for a value": ("ppo: {num_envs: }", "ppo.num_envs = None", "whole number"),
    "date for a count": ("seed: 2020-01-01", "seed = datetime.date(2020, 1, 1)", "whole number"),
    "two lines for a count": ("seed: |\n  a\n  b\n", "seed = 'a\\nb", "whole number"),
    "scalar for free options": ("task: {options: 3}", "task.options = 3", "dictionary"),
    "list in free options": ("task: {options: {a: [1]}}", "task.options.a", "[1]"),
    # Bounds.
    "no environments": ("ppo: {num_envs: 0}", "ppo.num_envs = 0", "greater than or equal to 1"),
    "negative size": ("ppo: {batch_size: -4}", "ppo.batch_size = -4", "than or equal to 1"),
    "layer of nothing": (
        "ppo: {network: {value_hidden_layer_sizes: [32, 0]}}",
        "ppo.network.value_hidden_layer_sizes.1 = 0",
        "greater than or equal to 1",
    ),
    "no layers": (
        "ppo: {network: {value_hidden_layer_sizes: []}}",
        "ppo.network.value_hidden_layer_sizes = []",
        "at least 1 item",
    ),
    "no steps": ("ppo: {num_timesteps: 0}", "ppo.num_timesteps = 0", "than or equal to 1"),
    "no episodes": ("evaluation: {episodes: 0}", "evaluation.episodes = 0", "or equal to 1"),
    "no solver": ("physics: {iterations: 0}", "physics.iterations = 0", "or equal to 1"),
    "standstill": ("task: {max_speed: 0}", "task.max_speed = 0", "greater than 0"),
    "negative span": (
        "task: {goal_distance_span: -1}",
        "task.goal_distance_span = -1",
        "greater than or equal to 0",
    ),
    "negative norm": ("ppo: {max_grad_norm: -1}", "ppo.max_grad_norm = -1", "greater than 0"),
    "discount above 1": ("ppo: {discounting: 1.5}", "ppo.discounting = 1.5", "or equal to 1"),
    "negative seed": ("seed: -1", "seed = -1", "greater than or equal to 0"),
    "seed of 33 bits": ("seed: 4294967296", "seed = 4294967296", "less than 4294967296"),
    "last seed of 33 bits": (
        "{seed: 4294967295, seeds: 2}",
        "seeds = 2",
        "seed at most 4294967294",
    ),
    "more than 32 bits": ("task: {max_speed: 1e39}", "task.max_speed: 1e+39", "at most 3.4e+38"),
    "goals out of sight": ("task: {goal_distance_min: 1e4}", "goal_distance_min = 10000.0", "1000"),
    "nan in free options": (
        "task: {options: {a: .nan}}",
        "task.options.a = nan",
        "a finite number",
    ),
    "infinite option": ("task: {options: {a: -.inf}}", "task.options.a = -inf", "a finite number"),
    "half a letter": ('task: {options: {a: "\\ud800"}}', r"task.options.a = '\ud800'", "text"),
    "half a letter for a key": ('task: {options: {"\\udcff": 1}}', r"'\udcff'", "is wrong"),
    "no letter of a project": ('wandb: "a\\ud800"', r"'a\ud800' is not a project", "characters"),
    "nan": ("ppo: {learning_rate: .nan}", "ppo.learning_rate = nan", "finite"),
    "infinity": ("ppo: {reward_scaling: .inf}", "ppo.reward_scaling = inf", "finite"),
    "infinity by overflow": ("ppo: {entropy_cost: 1e400}", "ppo.entropy_cost = inf", "finite"),
    "infinite count": ("ppo: {num_timesteps: .inf}", "ppo.num_timesteps = inf", "whole number"),
    # Choices.
    "unknown robot": ("robot: {preset: isac}", "robot.preset = 'isac'", "'isaac' or 'real'"),
    "unknown trainer": ("trainer: sac", "trainer = 'sac'", "should be 'resumable' or 'brax'"),
    "unknown observation": (
        "task: {observation: lidar}",
        "task.observation = 'lidar'",
        "'world', 'egocentric', 'camera'",
    ),
    "unknown activation": (
        "ppo: {network: {activation: sigmoid}}",
        "ppo.network.activation = 'sigmoid'",
        "'tanh', 'relu', 'elu' or 'swish'",
    ),
    "unknown schedule": (
        "ppo: {learning_rate_schedule: cosine}",
        "ppo.learning_rate_schedule = 'cosine'",
        "'NONE', 'LINEAR' or 'ADAPTIVE_KL'",
    ),
    # Ranges.
    "range upside down": (
        "randomization: {friction: [1.2, 0.4]}",
        "randomization.friction = [1.2, 0.4]",
        "[low, high], numbers from 0.05 to 5, the smaller one first",
    ),
    "one number for a range": (
        "randomization: {mass: 1.0}",
        "randomization.mass = 1.0",
        "it should be [low, high]",
    ),
    "range of one end": (
        "randomization: {com_x: [0.01]}",
        "randomization.com_x = [0.01]",
        "it should be [low, high]",
    ),
    "range out of bounds": (
        "randomization: {dead_band: [0, 1.5]}",
        "randomization.dead_band = [0, 1.5]",
        "from 0 to 0.9",
    ),
    "range of words": (
        "randomization: {motor_lag: [no, much]}",
        "randomization.motor_lag = ['no', 'much']",
        "numbers from 0 to 1",
    ),
    "half a step of delay": (
        "randomization: {action_delay: [0, 1.5]}",
        "randomization.action_delay = [0, 1.5]",
        "whole numbers from 0 to 60",
    ),
    "range without end": (
        "randomization: {yaw_noise: [0, .nan]}",
        "randomization.yaw_noise = [0, nan]",
        "numbers from 0 to 1",
    ),
    # Combinations.
    "step size outside its schedule": (
        "ppo: {learning_rate_schedule: ADAPTIVE_KL, learning_rate: 0.5}",
        "learning_rate = 0.5 lies outside the schedule's [1e-05, 0.01]",
        "choose it inside, or widen the bounds",
    ),
    "schedule upside down": (
        "ppo: {learning_rate_schedule: ADAPTIVE_KL, learning_rate_schedule_min_lr: 0.02}",
        "[0.02, 0.01]",
        "widen the bounds",
    ),
}


@pytest.mark.parametrize(("text", "key_and_value", "remedy"), BAD_VALUES.values(), ids=BAD_VALUES)
def test_a_bad_value_is_refused_by_name(refusal, text, key_and_value, remedy):
    message = refusal(text)
    assert "mine.yaml: " in message
    assert key_and_value in message
    assert remedy in message


BAD_YAML = {
    "key given twice": ("seed: 1\nrobot: {}\nseed: 2", 'line 3 is not valid YAML: .* "seed"'),
    "nested key given twice": ("ppo: {num_envs: 3, num_envs: 4}", 'line 1 .* "num_envs"'),
    "open bracket": ("seed: 1\nppo: [", "line 2 is not valid YAML"),
    "open quote": ("seed: 'x", "line 1 is not valid YAML"),
    "tab": ("ppo:\n\tseed: 1", "line 2 is not valid YAML: a tab: indent by spaces"),
    "two colons": ("a: b: c", "line 1 is not valid YAML: mapping values are not allowed"),
    "unknown alias": ("seed: *nowhere", "line 1 is not valid YAML: .*nowhere"),
    "tag that runs code": ("seed: !!python/object:os.system x", "line 1 .* could not determine"),
    "two documents": ("seed: 1\n---\nseed: 2", "is not valid YAML: but found another document"),
    "control character": ("seed: 1\x07", "is not valid YAML: unacceptable character"),
    "list": ("- 1\n- 2", r"holds \[1, 2\]: write `key: value` lines"),
    "text": ("seed 3", "holds 'seed 3': write `key: value` lines"),
    "number": ("3", "holds 3: write `key: value` lines"),
}


@pytest.mark.parametrize(("text", "pattern"), BAD_YAML.values(), ids=BAD_YAML)
def test_a_file_that_is_no_mapping_is_refused(refusal, text, pattern):
    message = refusal(text)
    assert "mine.yaml" in message
    assert re.search(pattern, message)


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("missing.yaml", "does not exist: give the path of a YAML file"),
        ("folder", "is a folder: give a YAML file"),
        ("picture.png", "cannot be read: it is not UTF-8 text"),
        ("picture.png/x.yaml", "cannot be read: Not a directory"),
    ],
)
def test_a_path_that_is_no_text_file_is_refused(tmp_path, name, remedy):
    (tmp_path / "folder").mkdir()
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n\x00\xff")
    with pytest.raises(ConfigError) as caught:
        load_config(tmp_path / name)
    assert str(caught.value) == f"config {tmp_path / name} {remedy}"


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


def test_what_is_no_configuration_is_refused():
    with pytest.raises(ConfigError, match="config = 5 is wrong: it should be a name, a file or"):
        load_config(5)


def test_a_configuration_shows_what_differs_from_the_defaults():
    config = load_config("jetbot_egocentric", {"seed": 3})
    assert repr(config) == (
        "Config(seed=3, checkpoint_interval=65536, task=TaskConfig(observation='egocentric'),"
        " ppo=PPOConfig(num_timesteps=524288, num_envs=256, batch_size=64))"
    )
    assert repr(Config()) == "Config()"


# The remedies that name a number: does it work?


@pytest.mark.parametrize(
    ("num_envs", "batch_size", "num_minibatches"),
    [(512, 100, 4), (12, 7, 3), (4096, 128, 4), (7, 1, 1), (6, 100, 4), (1000, 64, 7)],
)
def test_the_suggested_batch_size_works(refusal, write, num_envs, batch_size, num_minibatches):
    text = f"checkpoint_interval: 10_000_000\nppo: {{num_envs: {num_envs}}}"
    minibatches = f"ppo.num_minibatches={num_minibatches}"
    message = refusal(text, minibatches, f"ppo.batch_size={batch_size}")
    product = batch_size * num_minibatches
    assert f"num_minibatches = {product} is not a multiple of num_envs = {num_envs}" in message
    fit = re.search(r"batch_size = (\d+)$", message)[1]
    config = load_config(write(text), [minibatches, f"ppo.batch_size={fit}"])
    assert config.ppo.batch_size == int(fit)


@pytest.mark.parametrize(
    ("ctrl_dt", "sim_dt", "n_substeps"),
    # Rounded ratios: 0.02 / 0.006 = 3.3; 0.05 / 0.0021 = 23.8; never less than one.
    [(0.02, 0.006, 3), (0.05, 0.0021, 24), (0.02, 0.03, 1), (0.02, 7.0, 1)],
)
def test_the_suggested_sim_dt_works(refusal, write, ctrl_dt, sim_dt, n_substeps):
    message = refusal(f"physics: {{ctrl_dt: {ctrl_dt}, sim_dt: {sim_dt}}}")
    assert f"sim_dt = {sim_dt:g} goes" in message
    assert f"ctrl_dt = {ctrl_dt:g}" in message
    fit = re.search(r"sim_dt = (\S+)$", message)[1]
    config = load_config(write(f"physics: {{ctrl_dt: {ctrl_dt}, sim_dt: {fit}}}"))
    assert config.physics.n_substeps == n_substeps


@pytest.mark.parametrize(
    ("ctrl_dt", "sim_dt", "n_substeps"),
    [("0.016667", "0.0083333", 2), ("0.01666667", "0.00333333", 5), ("0.02", "0.02", 1)],
)
def test_rounded_time_steps_are_whole_enough(write, ctrl_dt, sim_dt, n_substeps):
    config = load_config(write(f"physics: {{ctrl_dt: {ctrl_dt}, sim_dt: {sim_dt}}}"))
    assert config.physics.n_substeps == n_substeps


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


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("GoalTask", "is wrong: write package.module:Class"),
        ("jetbot_mjx.envs.task.GoalTask", "is wrong: write package.module:Class"),
        (":GoalTask", "is wrong: write package.module:Class"),
        ("jetbot_mjx.envs.task:", "is wrong: write package.module:Class"),
        ("no_such_package.task:Task", "there is no no_such_package/task.py beside the YAML file"),
        ("jetbot_mjx.no_such:Task", "there is no jetbot_mjx/no_such.py beside the YAML file"),
        ("jetbot_mjx:GaolTask", "jetbot_mjx has no 'GaolTask'"),
        ("builtins:str", "is not a task: it lacks "),
    ],
)
def test_a_task_that_is_none_is_refused(name, said):
    config = parse_config({"task": {"name": name}})
    with pytest.raises(UserError) as caught:
        make_env(config)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert message.startswith(f"task.name = {name!r}")
    assert said in message


@pytest.mark.parametrize("name", sorted(shipped_configs()))
def test_brax_s_trainer_takes_every_configuration_of_the_package(name):
    config = load_config(name, ["trainer=brax"])
    assert (config.ppo.normalizer, config.ppo.network.shared_cnn) == ("brax", False)
    # What is given stays: a default is none.
    with pytest.raises(ConfigError, match=r"ppo\.normalizer = 'physical' is not supported"):
        load_config(name, ["trainer=brax", "ppo.normalizer=physical"])
    assert load_config(name).ppo.normalizer == "physical"
