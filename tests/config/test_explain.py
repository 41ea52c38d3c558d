"""An invalid value is refused in one line that names the key and the remedy."""

import pytest

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
    # JAX would abort the process.
    "more devices than a CPU is divided into": (
        "cpu_devices: 20000",
        "cpu_devices = 20000",
        "less than or equal to 1024",
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
    "part of a caster": (
        "robot: {casters: [{x: -0.08, radius: 0.01}]}",
        "robot.casters.0.y is missing",
        "robot.casters.0 = {",
    ),
    "wheels of measures": (
        "robot: {wheels: {left: [l]}}",
        "robot.wheels.left = ['l'] is unknown",
        "only a robot that is a MuJoCo model has it, of robot.file: NAME.xml",
    ),
    "a camera of the robot": (
        "robot: {preset: real, camera: {pitch: 15.0}}",
        "robot.camera.pitch = 15.0 is unknown",
        "camera is a section of its own, beside robot",
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
