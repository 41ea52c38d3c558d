"""Policies loaded from checkpoints, and errors for damaged ones."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest
import tensorstore as ts

from jetbot_mjx import load_policy
from jetbot_mjx.errors import InvalidError
from jetbot_mjx.runs import checkpoint_store
from jetbot_mjx.runs.checkpoint import (
    FORMAT,
    POLICY,
    CheckpointError,
    explanation,
    find_checkpoint,
    load_checkpoint,
)
from jetbot_mjx.runs.checkpoint_store import CheckpointStore, checkpoint_steps, digest
from jetbot_mjx.runs.resumption import TRAINING


@pytest.fixture
def run_copy(smoke_run, tmp_path):
    return shutil.copytree(smoke_run, tmp_path / "run")


def test_a_checkpoint_holds_its_metadata(smoke_run):
    checkpoint = load_checkpoint(smoke_run, "last")
    assert checkpoint.env_steps == 65_536
    assert checkpoint.config.task.observation == "egocentric"
    names = [field["name"] for field in checkpoint.about["layout"]]
    assert names[0] == "goal_position"
    assert checkpoint.about["versions"]["packages"]["brax"]
    assert checkpoint.about["metrics"]["success_rate"] >= 0.0
    assert checkpoint.run_dir == smoke_run


def test_a_run_is_found_from_a_folder_beside_it(smoke_run, monkeypatch, tmp_path):
    (tmp_path / "notebooks").mkdir()
    shutil.copytree(smoke_run, tmp_path / "run")
    monkeypatch.chdir(tmp_path / "notebooks")
    assert load_checkpoint("../run", "last").env_steps == 65_536


def test_checkpoints_stand_at_the_stated_interval(smoke_run):
    assert checkpoint_steps(smoke_run) == [0, 16_384, 32_768, 49_152, 65_536]


@pytest.fixture
def write(smoke_run, tmp_path):
    """Writes checkpoints with the parameters of the smoke run, and what else a test changes."""
    checkpoint = load_checkpoint(smoke_run)
    run_dir = tmp_path / "run"
    run_dir.mkdir()

    def write(*steps, trees=None, without=(), **changes):
        about = {**checkpoint.about, **changes}
        for key in without:
            del about[key]
        with CheckpointStore(run_dir, keep=50) as store:
            for env_steps, success_rate in steps:
                judged = {} if success_rate is None else {"success_rate": success_rate}
                explained = {**about, "metrics": judged}
                store.save(env_steps, trees or {POLICY: checkpoint.params}, explained, success_rate)
        return run_dir

    return write


def test_the_best_is_the_one_with_the_highest_success_and_of_equals_the_latest(tmp_path, write):
    write((0, 0.1), (10, 0.9), (20, 0.9), (30, 0.5))
    assert load_checkpoint(tmp_path / "run", "best").env_steps == 20
    assert load_checkpoint(tmp_path / "run", "last").env_steps == 30
    assert load_checkpoint(tmp_path / "run", 10).env_steps == 10


def test_a_checkpoint_without_an_evaluation_is_not_the_best(write):
    run_dir = write((0, 0.0), (10, None))
    assert load_checkpoint(run_dir, "best").env_steps == 0
    assert load_checkpoint(run_dir, "last").env_steps == 10


def test_a_checkpoint_is_read_back_unchanged(smoke_run, write):
    checkpoint = load_checkpoint(smoke_run)
    again = load_checkpoint(write((1, 1.0))).params
    assert jax.tree.structure(again) == jax.tree.structure(checkpoint.params)
    jax.tree.map(np.testing.assert_array_equal, again, checkpoint.params)
    assert digest(again) == digest(checkpoint.params) == checkpoint.about["sha256"][POLICY]
    assert np.any(np.asarray(again.normalizer.mean) != 0)


_ACT = """
import sys, numpy as np
from jetbot_mjx import load_policy
obs = np.load(sys.argv[2])
np.save(sys.argv[3], np.asarray(load_policy(sys.argv[1])(obs)))
"""


@pytest.mark.slow
def test_a_fresh_process_gives_identical_actions(smoke_run, tmp_path):
    obs = np.asarray(jax.random.normal(jax.random.PRNGKey(5), (257, 7)))
    np.save(tmp_path / "obs.npy", obs)
    subprocess.run(
        [sys.executable, "-c", _ACT, smoke_run, tmp_path / "obs.npy", tmp_path / "out.npy"],
        check=True,
    )
    here = np.asarray(load_policy(smoke_run)(obs))
    np.testing.assert_array_equal(here, np.load(tmp_path / "out.npy"))
    assert np.ptp(here, axis=0).min() > 0.1


def test_a_policy_is_deterministic_without_a_key_and_samples_with_one(smoke_run):
    policy = load_policy(smoke_run)
    obs = jnp.ones(7)
    one, two = (policy(obs, jax.random.PRNGKey(i)) for i in (0, 1))
    assert policy(obs).shape == one.shape == (2,)
    np.testing.assert_array_equal(policy(obs), policy(obs))
    assert not np.allclose(one, two)
    batched = jnp.stack([obs, 2 * obs])
    # A GPU multiplies matrices of a batch in TF32 unless told otherwise, and a vector in float32.
    with jax.default_matmul_precision("highest"):
        np.testing.assert_allclose(policy(batched)[0], policy(obs), rtol=1e-5)
    assert np.all(np.abs(policy(100.0 * batched)) <= 1.0)


def test_a_list_of_numbers_is_an_observation(smoke_run):
    policy = load_policy(smoke_run)
    np.testing.assert_array_equal(policy([0.1] * 7), policy(np.full(7, 0.1, np.float32)))


@pytest.mark.parametrize(
    ("obs", "got"),
    [
        (np.zeros(16), "got 16"),
        (np.zeros((7, 3)), "got 3"),
        ([0.0] * 6, "got 6"),
        (1.0, "got one number without an axis"),
    ],
)
def test_an_observation_of_another_size_is_refused_with_what_is_expected(smoke_run, obs, got):
    policy = load_policy(smoke_run)
    with pytest.raises(ValueError, match=r"^observation: expected 7 numbers, goal_") as caught:
        policy(obs)
    assert isinstance(caught.value, InvalidError)
    assert str(caught.value).endswith(f"; {got}")


def test_a_policy_says_what_it_is_and_can_be_compiled(smoke_run, monkeypatch):
    monkeypatch.chdir(smoke_run.parent)
    policy = load_policy(smoke_run, "last")
    assert repr(policy) == (
        f"Policy(run='{smoke_run.name}', env_steps=65536, observation_size=7, action_size=2)"
    )
    observations = np.linspace(-1.0, 1.0, 21, dtype=np.float32).reshape(3, 7)
    actions = np.asarray(policy(observations))
    for compiled in (jax.jit(policy), jax.vmap(policy)):
        np.testing.assert_allclose(np.asarray(compiled(observations)), actions, atol=1e-6)


def test_a_word_that_names_no_checkpoint_is_refused_as_such(smoke_run):
    with pytest.raises(
        InvalidError, match=r"^which = 'lats' is neither best, last nor a number of"
    ):
        load_policy(smoke_run, "lats")


def test_a_single_checkpoint_folder_can_be_loaded(smoke_run):
    folder = find_checkpoint(smoke_run, 16_384)
    assert load_checkpoint(folder).env_steps == 16_384
    for steps in (np.int64(16_384), jnp.int32(16_384)):
        assert find_checkpoint(smoke_run, steps) == folder


def refused(path, which="best"):
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(path, which)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_missing_checkpoint_is_refused(smoke_run, tmp_path):
    assert "no such folder" in refused(tmp_path / "nothing")
    assert "neither" in refused(tmp_path)
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    assert "saved none" in refused(tmp_path / "run")
    assert "16384" in refused(smoke_run, 123)


def test_a_foreign_checkpoint_is_refused(tmp_path):
    with ocp.StandardCheckpointer() as writer:
        writer.save(tmp_path / "000000000001" / "policy", {"weights": np.ones(3)})
    assert "not one of jetbot_mjx" in refused(tmp_path / "000000000001")


def test_another_shape_is_refused(smoke_run, write):
    config = load_checkpoint(smoke_run).about["config"]
    config["ppo"]["network"]["policy_hidden_layer_sizes"] = [32, 48]
    said = refused(write((1, 0.5), config=config))
    assert "cannot be read: policy.params.hidden_1." in said
    assert "is float32[32], and should be float32[48]" in said


@pytest.mark.parametrize("key", ["config", "observation_size", "format", "layout"])
def test_incomplete_metadata_is_refused(write, key):
    assert f"has unusable metadata: no {key}" in refused(write((1, 0.5), without=[key]), 1)


@pytest.mark.parametrize("key", ["config", "layout", "env_steps"])
def test_changed_metadata_is_refused(run_copy, key):
    folder = find_checkpoint(run_copy, "last")
    path = folder / "about" / "metadata"
    path.write_text(path.read_text().replace(f'"{key}"', f'"{key}s"', 1))
    for use in (lambda: refused(folder), lambda: refused(run_copy, "last")):
        assert "about/metadata changed after it was written" in use()


@pytest.mark.parametrize("number", ["jetbot_mjx/1", "jetbot_mjx/2", None, 2])
def test_another_format_is_refused_by_name(write, number):
    said = refused(write((1, 0.5), format=number))
    assert f"has the format {number!r}, and only {FORMAT!r} can be read" in said


@pytest.mark.parametrize("config", [{}, {"seed": -1}, {"sede": 0}, 3, None])
def test_a_configuration_that_cannot_run_is_refused(write, config):
    assert "checkpoint" in refused(write((1, 0.5), config=config))


def test_a_checkpoint_without_a_policy_is_refused(smoke_run, write):
    trees = {TRAINING: {"key": np.zeros(2, np.uint32)}}
    run_dir = write((1, 0.5), trees=trees)
    assert "holds no policy" in refused(run_dir)
    assert explanation(find_checkpoint(run_dir, 1))["env_steps"] == 1


def test_a_policy_from_another_checkpoint_is_refused(run_copy):
    folder = find_checkpoint(run_copy, 65_536)
    shutil.rmtree(folder / POLICY)
    shutil.copytree(find_checkpoint(run_copy, 49_152) / POLICY, folder / POLICY)
    assert "policy changed after it was written" in refused(folder)


def test_a_policy_is_loaded_beside_a_damaged_training_state(run_copy):
    folder = find_checkpoint(run_copy, "best")
    before = load_checkpoint(folder)
    shutil.rmtree(folder / TRAINING)
    assert digest(load_checkpoint(run_copy).params) == digest(before.params)


def stored_bytes(folder):
    return [path for path in folder.rglob("*") if path.is_file() and path.parent.name == "d"]


@pytest.mark.parametrize("harm", ["empty", "cut", "flip", "gone"])
def test_a_damaged_checkpoint_is_refused(run_copy, harm, capfd):
    folder = find_checkpoint(run_copy, "best")
    for path in stored_bytes(folder / POLICY):
        match harm:
            case "empty":
                path.write_bytes(b"")
            case "cut":
                path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
            case "flip":
                data = bytearray(path.read_bytes())
                data[::50] = (byte ^ 4 for byte in data[::50])
                path.write_bytes(data)
            case "gone":
                path.unlink()
    assert "cannot be read" in refused(folder)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("observation_size", (-3, 0, 2**40, "7", None, [7], {"pixels/front": [-1, 2, 3]})),
        ("action_size", (-1, 0, 10**12, "2", None, 2.5)),
        ("layout", (None, 3, [3], [{}], [{"frame": "body", "name": "a", "size": -1, "unit": "m"}])),
    ],
)
def test_metadata_that_no_training_wrote_is_refused_by_name(write, key, values):
    for number, value in enumerate(values):
        said = refused(write((number, 0.5), **{key: value}), number)
        assert f"has unusable metadata: {key} = {value!r} is wrong" in said


@pytest.mark.parametrize("size", [{}, {"pixels/front": [32, 32]}, {"x": [7]}])
def test_sizes_that_make_no_network_are_refused(write, size):
    said = refused(write((1, 0.5), observation_size=size), 1)
    assert f"observation_size = {size!r} and action_size = 2 do not fit its configuration" in said


def test_a_format_of_any_length_is_shown_in_a_line(write):
    assert len(refused(write((1, 0.5), format="x" * 100_000))) < 1000


_LARGE = 1_000_000


def ask_for_memory(folder, shapes, chunks):
    """Change the shapes and chunks that the files of a policy state."""
    place = {"driver": "file", "path": f"{folder / POLICY}/"}
    store = ts.KvStore.open({"driver": "ocdbt", "base": place}).result()
    for key in store.list().result():
        name = key.decode().removesuffix("/.zarray").removeprefix("policy.params.")
        if key.endswith(b"/.zarray") and name in {*shapes, *chunks}:
            about = json.loads(store[key])
            about["shape"] = shapes.get(name, about["shape"])
            about["chunks"] = chunks.get(name, about["shape"])
            store[key] = json.dumps(about).encode()


def test_metadata_alone_asks_for_no_memory(smoke_run, write):
    config = load_checkpoint(smoke_run).about["config"]
    config["ppo"]["network"]["policy_hidden_layer_sizes"] = [_LARGE, _LARGE]
    folder = find_checkpoint(write((1, 0.5), config=config), 1)
    shapes = {
        "hidden_0.kernel": [7, _LARGE],
        "hidden_0.bias": [_LARGE],
        "hidden_1.kernel": [_LARGE, _LARGE],
        "hidden_1.bias": [_LARGE],
        "hidden_2.kernel": [_LARGE, 4],
    }
    ask_for_memory(folder, shapes, {})
    assert "policy asks for 4.0e+12 bytes of memory, and its files hold" in refused(folder)


def test_a_chunk_asks_for_no_more_memory_than_its_array(write):
    folder = find_checkpoint(write((1, 0.5)), 1)
    ask_for_memory(folder, {}, {"hidden_1.kernel": [_LARGE, _LARGE]})
    assert "policy asks for 4.0e+12 bytes of memory, and its files hold" in refused(folder)


def replaced_by(make):
    def harm(path):
        path.unlink()
        make(path)

    return harm


UNREADABLE = {
    "folder": replaced_by(Path.mkdir),
    "pipe": replaced_by(os.mkfifo),
    "loop": replaced_by(lambda path: path.symlink_to(path.name)),
    "device": replaced_by(lambda path: path.symlink_to("/dev/zero")),
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:100]),
    "flipped": lambda path: path.write_bytes(bytes(x ^ 4 for x in path.read_bytes())),
}


@pytest.mark.parametrize("harm", UNREADABLE.values(), ids=UNREADABLE)
@pytest.mark.parametrize("file", ["about/metadata", "policy/manifest.ocdbt", "policy/d"])
def test_a_file_that_cannot_be_read_costs_one_line_and_no_time(run_copy, harm, file):
    folder = find_checkpoint(run_copy, "best")
    path = folder / file
    # Of several files, the one with the arrays: TensorStore may leave nodes that nothing refers to.
    harm(max(path.iterdir(), key=lambda one: one.stat().st_size) if path.is_dir() else path)
    said = refused(folder)
    assert len(said) < 400
    assert any(reason in said for reason in ("cannot be read", "damaged", "changed after"))
    # Another one is the best now, or all is refused.
    load_checkpoint(run_copy, 0)


@pytest.mark.parametrize("score", ["high", [1], {}, None])
def test_a_checkpoint_without_a_score_is_not_the_best(write, score):
    run_dir = write((0, 0.1), (10, 0.2))
    path = run_dir / "checkpoints" / f"{10:012}" / "about" / "metadata"
    about = json.loads(path.read_text())
    about["score"] = score
    del about["sha256"]["about"]
    about["sha256"]["about"] = checkpoint_store._digest_json(about)
    path.write_text(json.dumps(about))
    assert load_checkpoint(run_dir).env_steps == 0


def test_the_best_is_found_beside_one_that_cannot_be_read(run_copy):
    best = find_checkpoint(run_copy, "best")
    other = next(path for path in best.parent.iterdir() if path.name.isdecimal() and path != best)
    shutil.rmtree(other / "about")
    assert find_checkpoint(run_copy, "best") == best
