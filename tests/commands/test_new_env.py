"""The environment that `new_env` writes trains in a moment, and no file is overwritten."""

import importlib.util

import jax
import jax.numpy as jnp
import pytest

from jetbot_mjx import new_env
from jetbot_mjx.config import load_config
from jetbot_mjx.envs import write_environment_template
from jetbot_mjx.errors import UserError
from jetbot_mjx.training import session


def test_what_is_written_trains_to_success(tmp_path, capsys):
    assert new_env.main([str(tmp_path / "tools" / "push_it.py")]) == 0
    config = tmp_path / "tools" / "push_it.yaml"
    printed = capsys.readouterr().out
    assert f"check-env {config}\n" in printed
    assert f"train {config}\n" in printed
    written = (tmp_path / "tools" / "push_it.py").read_text("utf-8") + config.read_text("utf-8")
    assert "class PushIt:" in written
    assert "    jetbot-mjx train push_it.yaml\n" in written
    assert "point_env" not in written
    assert "PointEnv" not in written
    result = session.run(load_config(config), tmp_path / "run")
    assert result.best.success_rate >= 0.99
    assert result.best_steps < 1_000_000


def test_it_is_short_and_told(tmp_path):
    write_environment_template(tmp_path / "push_it.py")
    text = (tmp_path / "push_it.py").read_text("utf-8")
    assert len(text.splitlines()) <= 60
    spec = importlib.util.spec_from_file_location("push_it", tmp_path / "push_it.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    env = module.PushIt()
    assert all(x.__doc__ for x in (module, module.PushIt, env.reset, env.step, env.state))
    # Whoever pushes towards the goal reaches it, and earns the way that it was away.
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    way, earned = float(jnp.linalg.norm(state.obs[:2])), 0.0
    for _ in range(100):
        state = jax.jit(env.step)(state, state.obs[:2] - state.obs[2:])
        earned += float(state.reward)
        if state.done:
            break
    assert float(state.metrics["success"]) == 1
    assert way - 0.1 <= earned <= way


@pytest.mark.parametrize("there", ["mine.py", "mine.yaml"])
def test_nothing_is_overwritten(tmp_path, there):
    (tmp_path / there).write_text("mine")
    with pytest.raises(UserError, match=f"{there} exists already"):
        write_environment_template(tmp_path / "mine.py")
    assert [file.name for file in tmp_path.iterdir()] == [there]
    assert (tmp_path / there).read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("my-env.py", "name a Python module, such as my_env.py"),
        ("my_env", "name a Python module"),
        ("json.py", "a module json exists already"),
    ],
)
def test_names_that_cannot_be_imported_are_refused(tmp_path, name, told):
    with pytest.raises(UserError, match=told):
        write_environment_template(tmp_path / name)
    assert list(tmp_path.iterdir()) == []
