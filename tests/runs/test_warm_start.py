"""A training that starts from another run's policy: what is copied, and what is refused."""

import shutil

import jax
import numpy as np
import pytest

from helpers import gliding, point_mass
from jetbot_mjx.agents.networks import make_networks, make_policy
from jetbot_mjx.config import ConfigError, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup, warm_start
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.run_dir import stored_config
from jetbot_mjx.training import session

SOURCE = "pretrained:jetbot_egocentric"


def config_of(**more):
    return parse_config(
        {
            "task": {"observation": "egocentric", "episode_length": 32, **more.pop("task", {})},
            "checkpoint_interval": 1024,
            "evaluation": {"episodes": 8},
            "tensorboard": False,
            "ppo": {
                "num_timesteps": 2048,
                "num_envs": 16,
                "unroll_length": 16,
                "batch_size": 16,
                "num_minibatches": 4,
                **more.pop("ppo", {}),
            },
            **more,
        }
    )


@pytest.fixture(scope="module")
def source():
    return load_checkpoint(SOURCE)


def test_rows_are_matched_by_field():
    a, b, c = (
        {"name": name, "size": size, "unit": "m", "frame": "body"}
        for name, size in (("a", 2), ("b", 1), ("c", 3))
    )
    assert warm_start.match_rows([a, b], [b, a]).tolist() == [2, 0, 1]
    assert warm_start.match_rows([a, b], [c, b]).tolist() == [-1, -1, -1, 2]
    # Another unit, frame or size is another field.
    for other in ({**a, "unit": "1"}, {**a, "frame": "world"}, {**a, "size": 1}):
        assert (warm_start.match_rows([a], [other]) == -1).all()


def test_the_same_task_gives_the_same_policy(source):
    config = config_of()
    env = make_env(config)
    started = warm_start.make_warm_start(source, Setup(config, env=env))
    assert (started.new, started.dropped) == ([], [])
    for ours, theirs in zip(
        jax.tree.leaves(started.params), jax.tree.leaves(source.params), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


def test_a_new_field_begins_at_zero_with_statistics_of_its_own(source):
    config = config_of()
    env = make_env(config)
    # As if the other run had not seen the last field: the yaw rate.
    seen = source.about["layout"][:-1]
    rows = warm_start.match_rows(seen, source.about["layout"])
    assert rows.tolist() == [0, 1, 2, 3, 4, 5, -1]
    params = source.params
    poorer = source._replace(
        about={**source.about, "layout": seen, "observation_size": 6},
        params=params._replace(
            normalizer=params.normalizer.replace(
                mean=params.normalizer.mean[:6],
                std=params.normalizer.std[:6],
                summed_variance=params.normalizer.summed_variance[:6],
            ),
            policy=cut(params.policy),
            value=cut(params.value),
        ),
    )
    started = warm_start.make_warm_start(poorer, Setup(config, env=env))
    assert (started.new, started.dropped) == (["yaw_rate"], [])
    assert "new in its observation: yaw_rate" in started.describe()
    kernel = started.params.policy["params"]["hidden_0"]["kernel"]
    assert (kernel[6] == 0).all()
    assert np.abs(kernel[:6]).min(axis=1).max() > 0
    normalizer = started.params.normalizer
    np.testing.assert_array_equal(normalizer.mean[:6], params.normalizer.mean[:6])
    np.testing.assert_array_equal(normalizer.std[:6], params.normalizer.std[:6])
    # It turns, so the yaw rate's deviation is above the least one of 0.1 rad/s.
    assert normalizer.std[6] > 0.2
    # Whatever the new field is, the policy acts as it did.
    policy = make_policy(networks_of(config, env), started.params)
    obs = np.random.default_rng(0).normal(size=(2, 7)).astype(np.float32)
    obs[1, :6] = obs[0, :6]
    np.testing.assert_array_equal(*np.asarray(policy(obs)))


def cut(params):
    first = params["params"]["hidden_0"]
    kernel = {**first, "kernel": first["kernel"][:6]}
    return {**params, "params": {**params["params"], "hidden_0": kernel}}


def networks_of(config, env):
    return make_networks(config.ppo, env.observation_size, env.action_size)


def test_the_exploration_noise_is_reset_and_the_mean_action_kept(source):
    config = config_of()
    env = make_env(config)
    fresh = networks_of(config, env).policy_network.init(jax.random.PRNGKey(0))
    mixed = warm_start._with_new_noise(source.params.policy, fresh, 2)
    last, old, new = (
        x["params"]["hidden_3"]["kernel"] for x in (mixed, source.params.policy, fresh)
    )
    np.testing.assert_array_equal(last[:, :2], np.float32(0.25) * old[:, :2])
    np.testing.assert_array_equal(last[:, 2:], new[:, 2:])


@pytest.mark.slow
@gliding.everywhere()
def test_a_normal_distribution_starts_from_a_policy_too(tmp_path):
    network = {"network": {"distribution_type": "normal", "policy_hidden_layer_sizes": [16]}}
    assert session.run(config_of(ppo={**network}), tmp_path / "source").finished
    source = load_checkpoint(tmp_path / "source").params.policy["params"]
    changes = {"seed": 1, "init_from": str(tmp_path / "source"), "ppo": {**network}}
    assert session.run(config_of(**changes), tmp_path / "run").finished
    start = load_checkpoint(tmp_path / "run", 0).params.policy["params"]
    fresh = networks_of(config := config_of(**changes), make_env(config))
    new = fresh.policy_network.init(jax.random.PRNGKey(0))["params"]
    first = [x["MLP_0"]["hidden_0"]["kernel"] for x in (start, source)]
    np.testing.assert_array_equal(*first)
    mean = np.float32(0.25) * source["Dense_0"]["kernel"]
    np.testing.assert_array_equal(start["Dense_0"]["kernel"], mean)
    np.testing.assert_array_equal(start["std_param"]["value"], new["std_param"]["value"])
    assert not np.array_equal(source["std_param"]["value"], new["std_param"]["value"])
    # A field that is new, here in front of the first one, has a row of zeros.
    rows = np.asarray([-1, *range(7)])
    matched = warm_start._match_first_layer({"params": source}, rows)["params"]["MLP_0"]
    kernel = source["MLP_0"]["hidden_0"]["kernel"]
    np.testing.assert_array_equal(matched["hidden_0"]["kernel"][1:], kernel)
    assert not matched["hidden_0"]["kernel"][0].any()


@pytest.mark.slow
def test_choices_of_an_environment_begin_with_those_of_a_policy(tmp_path):
    session.run(point_mass.config("Choosing"), tmp_path / "source")
    changes = {"seed": 1, "init_from": str(tmp_path / "source")}
    session.run(point_mass.config("Choosing", **changes), tmp_path / "run")
    start, source = (
        load_checkpoint(tmp_path / name, which).params.policy["params"]
        for name, which in (("run", 0), ("source", "best"))
    )
    np.testing.assert_array_equal(start["hidden_0"]["kernel"], source["hidden_0"]["kernel"])
    # There is no noise that could be that of a new policy.
    scores = np.float32(0.25) * source["hidden_1"]["kernel"]
    np.testing.assert_array_equal(start["hidden_1"]["kernel"], scores)


def test_an_observation_of_another_size_is_refused_with_both(tmp_path):
    session.run(point_mass.config(), tmp_path / "source")
    other = load_checkpoint(tmp_path / "source")
    layout = [{"name": "observation", "size": 3, "unit": "", "frame": ""}]
    other = other._replace(about={**other.about, "layout": layout})
    said = r"no field of its observation \(observation\[3\]\) is one of .* \(observation\[2\]\)"
    with pytest.raises(UserError, match=said):
        warm_start.make_warm_start(other, Setup(point_mass.config()))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"ppo": {"network": {"policy_hidden_layer_sizes": [64, 64]}}},
            "policy_hidden_layer_sizes = [64,64]: give"
            " --set ppo.network.policy_hidden_layer_sizes=[128,128,128]",
        ),
        (
            {"ppo": {"network": {"activation": "swish"}}},
            "ppo.network.activation = swish: give --set ppo.network.activation=tanh",
        ),
        ({"ppo": {"normalize_observations": False}}, "ppo.normalize_observations = true"),
        ({"task": {"observation": "world"}}, "no field of its observation"),
        ({"init_from": "pretrained:nothing"}, "does not come with the package"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_written(changes, told, tmp_path):
    config = config_of(**{"init_from": SOURCE, **changes})
    with pytest.raises(UserError) as caught:
        session.run(config, tmp_path / "run")
    assert told in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_brax_s_trainer_cannot():
    with pytest.raises(ConfigError, match="init_from is not supported by trainer = 'brax'"):
        config_of(
            init_from=SOURCE,
            trainer="brax",
        )


@gliding.everywhere()
def test_a_training_begins_with_it_and_resumes_without_it(tmp_path, capsys):
    copied = tmp_path / "source"
    shutil.copytree(load_checkpoint(SOURCE).run_dir, copied)
    run_dir = tmp_path / "run"
    config = config_of(init_from=str(copied))
    first = session.run(config, run_dir, verbose=True)
    said = capsys.readouterr().out
    assert f"begins with the policy of {copied}" in said
    assert "its last layer is scaled by 0.25 and its noise is new: expect less of it" in said
    start = load_checkpoint(run_dir, 0).params
    np.testing.assert_array_equal(
        start.value["params"]["hidden_1"]["kernel"],
        load_checkpoint(SOURCE).params.value["params"]["hidden_1"]["kernel"],
    )
    assert first.finished
    # The other run may be gone.
    shutil.rmtree(copied)
    longer = parse_config(
        {
            **stored_config(run_dir).model_dump(mode="json"),
            "ppo": {**config.ppo.model_dump(mode="json"), "num_timesteps": 4096},
        }
    )
    assert session.run(longer, run_dir).finished
