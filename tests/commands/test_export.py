"""What leaves the package does as JAX does, runs without the package, and is whole or not there."""

import ast
import functools
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jetbot_mjx
from helpers import point_mass
from helpers.bare_python import NUMPY, alone, site_with
from helpers.further import slow_fixture
from jetbot_mjx import export, training
from jetbot_mjx.agents.networks import PolicyParams, init_normalizer, make_networks
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.deployment import export_policy, exporters, numpy_policy, policy_export
from jetbot_mjx.deployment.exporters import FORMATS
from jetbot_mjx.deployment.numpy_policy import (
    TOLERANCE,
    Recording,
    as_jax,
    difference,
    portable_policy,
    record,
)
from jetbot_mjx.deployment.policy_spec import policy_spec
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.errors import InvalidError, MissingPackageError, UserError
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.runs.checkpoint import Checkpoint, about_policy, load_checkpoint
from jetbot_mjx.runs.run_dir import write_json

ROOT = Path(__file__).parents[2]

for package in FORMATS["onnx"].needs:
    pytest.importorskip(package)


@pytest.fixture(scope="module")
def run_dir(smoke_run, tmp_path_factory):
    """A copy of the run, to export from."""
    return shutil.copytree(smoke_run, tmp_path_factory.mktemp("export") / "run")


@pytest.fixture(scope="module")
def exported(run_dir):
    assert export.main([str(run_dir), "--format", "all"]) == 0
    return run_dir / "policy"


@pytest.fixture
def shortly(monkeypatch):
    """Exports are checked on few observations."""
    monkeypatch.setattr(policy_export, "record", functools.partial(record, count=20))


def checkpoint_of(settings, tmp_path):
    """A policy that nobody trained, with a normaliser that matters."""
    config = parse_config(settings)
    env = make_env(config)
    size = env.observation_size
    networks = make_networks(config.ppo, size, 2)
    key = jax.random.PRNGKey(3)
    normalizer = init_normalizer(size)
    normalizer = normalizer.replace(
        mean=jax.tree.map(lambda x: jnp.linspace(-1.0, 1.0, x.size), normalizer.mean),
        std=jax.tree.map(lambda x: jnp.linspace(0.1, 2.0, x.size), normalizer.std),
    )
    params = PolicyParams(normalizer, networks.policy_network.init(key), None)
    return Checkpoint(
        path=tmp_path / "checkpoints" / "000000000000",
        run_dir=tmp_path,
        env_steps=0,
        config=config,
        params=params,
        networks=networks,
        about=about_policy(config, env),
    ), env


def outputs_of(checkpoint, env, **inputs):
    action, wheel_speeds = jax.device_get(jax.jit(as_jax(checkpoint, env))(*inputs.values()))
    return Recording(inputs, action, wheel_speeds)


@pytest.mark.parametrize(
    ("activation", "distribution", "normalize"),
    [
        ("tanh", "tanh_normal", False),
        ("relu", "normal", True),
        ("elu", "tanh_normal", True),
        ("swish", "normal", True),
    ],
)
def test_every_network_is_written_as_it_is(activation, distribution, normalize, tmp_path):
    network = {"activation": activation, "distribution_type": distribution}
    layers = {"policy_hidden_layer_sizes": [24, 16]}
    ppo = {"network": {**network, **layers}, "normalize_observations": normalize}
    checkpoint, env = checkpoint_of({"ppo": ppo, "task": {"max_speed": 0.4}}, tmp_path)
    obs = np.random.default_rng(0).normal(size=(200, 16)).astype(np.float32) * 3.0
    recording = outputs_of(checkpoint, env, obs=obs)
    assert recording.action.std() > 0.1
    policy = portable_policy(checkpoint, checkpoint.make_env())
    for name in ("numpy", "onnx"):
        path = tmp_path / FORMATS[name].file
        FORMATS[name].write(policy, as_jax(checkpoint, env), path)
        found = difference(recording, FORMATS[name].read(path)(obs), policy.controller)
        assert found < TOLERANCE, name
    one, speeds = FORMATS["numpy"].read(tmp_path / "policy.py")(obs[0])
    assert np.abs(one - recording.action[0]).max() < TOLERANCE
    assert speeds.shape == (2,)


def test_an_export_tells_how_far_each_file_is_from_jax(exported, run_dir, shortly, capsys):
    told = json.loads((exported / "policy.json").read_text())
    names = {path.name for path in exported.iterdir()}
    assert names == {"policy.json", "recording.npz", *(one.file for one in FORMATS.values())}
    assert told["recording"]["observations"] == 10_000
    for name, file in told["files"].items():
        assert file["file"] == FORMATS[name].file
        assert file["largest_difference"] < 1e-5
    # Again, in place of the first, from a run folder that holds `policy/` by now.
    assert export.main([str(run_dir), "--output", str(run_dir / "again")]) == 0
    assert "20 observations" in capsys.readouterr().out
    assert json.loads((run_dir / "again" / "policy.json").read_text())["files"].keys() == {"numpy"}
    same = (run_dir / "again" / "policy.py").read_bytes()
    assert same == (exported / "policy.py").read_bytes()


def test_the_recording_is_what_the_policy_saw_in_its_environment(exported, run_dir):
    checkpoint = load_checkpoint(run_dir)
    env = checkpoint.make_env()
    with np.load(exported / "recording.npz") as recording:
        obs, action = recording["obs"], recording["action"]
    assert obs.shape == (10_000, env.observation_size)
    keys = report_keys(1)
    np.testing.assert_array_equal(obs[0], jax.jit(env.reset)(keys[0]).obs)
    # In C MuJoCo it moves as it was told: MJX, one step on.
    physics = env.reset(keys[0]).pipeline_state
    data = mujoco.MjData(env.mj_model)
    data.ctrl[:] = env.wheel_targets(jnp.asarray(action[0]))
    mujoco.mj_step(env.mj_model, data, env.config.physics.n_substeps)
    physics = physics.replace(qpos=jnp.asarray(data.qpos), qvel=jnp.asarray(data.qvel))
    seen = env.task.observe(robot_state(physics), env.reset(keys[0]).goal)
    np.testing.assert_allclose(obs[1], seen, atol=1e-6)
    # Where the distance grows at once, another episode has begun.
    distance = obs[:, env.observation_size - 3]
    assert np.count_nonzero(np.abs(np.diff(distance)) > 0.1) > 30


def test_the_contract_tells_the_layout_and_the_formula(exported, run_dir):
    told = json.loads((exported / "policy.json").read_text())
    env = load_checkpoint(run_dir).make_env()
    layout = [
        (one["name"], len(one["index"]), one["unit"], one["frame"]) for one in told["observation"]
    ]
    assert layout == [field[:4] for field in env.task.layout]
    indices = [index for one in told["observation"] for index in one["index"]]
    assert indices == list(range(env.observation_size))
    assert told["control_rate"] == pytest.approx(60.0)
    assert (told["rest_height"], told["evaluation"]) == (env.mj_model.qpos0[2], None)
    with np.load(exported / "recording.npz") as recording:
        action, wheel_speeds = recording["action"].astype(float), recording["wheel_speeds"]
    names = {"drive": action[:, 0], "turn": action[:, 1], **told["wheel_speeds"]}
    for line in told["wheel_speeds"]["formula"]:
        name, _, expression = line.partition(" = ")
        names[name] = eval(expression, {}, names)
    np.testing.assert_allclose(names["left"], wheel_speeds[:, 0], atol=1e-4)
    np.testing.assert_allclose(names["right"], wheel_speeds[:, 1], atol=1e-4)


def test_the_contract_holds_the_summary_of_a_report(run_dir, tmp_path):
    checkpoint = load_checkpoint(run_dir)._replace(run_dir=tmp_path)
    folder = tmp_path / "evaluations" / checkpoint.path.name
    folder.mkdir(parents=True)
    env = checkpoint.make_env()
    policy = portable_policy(checkpoint, env)
    for text in ("", "{}", "[]"):
        (folder / "report.json").write_text(text)
        assert policy_spec(checkpoint, env, policy)["evaluation"] is None
    write_json(folder / "report.json", {"goal_set_version": 7, "policy": {"success_rate": 0.5}})
    told = policy_spec(checkpoint, env, policy)["evaluation"]
    assert told == {"goal_set_version": 7, "success_rate": 0.5}


def test_the_time_of_an_action_is_told_for_every_file(exported, monkeypatch, capsys):
    from benchmarks.throughput import action_latency

    cores = os.sched_getaffinity(0)
    assert action_latency.main([str(exported), "--calls", "5"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [row[0] for row in rows] == list(FORMATS)
    assert all(0 < float(row[1]) <= float(row[2]) <= float(row[3]) for row in rows)
    assert os.sched_getaffinity(0) == cores
    assert action_latency.main([str(exported / "nothing")]) == 2


def towards(checkpoint, env):
    """In place of a policy: it drives towards what the task shows first a direction of."""
    del checkpoint

    def act(obs):
        bearing = jnp.arctan2(obs[:, 3], obs[:, 2])
        drive = jnp.where(jnp.abs(bearing) < 0.5, 0.3, -1.0)
        action = jnp.clip(jnp.stack([drive, bearing], axis=1), -1.0, 1.0)
        return action, jax.vmap(env.wheel_targets)(action)

    return act


@pytest.fixture
def record_example(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    monkeypatch.setattr(numpy_policy, "as_jax", towards)

    def record_example(name, count):
        settings = load_config(ROOT / "examples" / f"{name}.yaml").model_dump()
        return record(*checkpoint_of(settings, tmp_path), count).inputs["obs"]

    return record_example


def test_a_recording_passes_gate_after_gate(record_example):
    left = record_example("gates", 700)[:, 10]
    passed = -np.diff(left)
    assert set(left) == {3, 2, 1}  # the last gate ends the episode
    assert set(passed) == {0, 1, -2}  # -2: the next episode
    assert np.count_nonzero(passed == -2) >= 2


def test_a_recording_runs_into_solid_pillars(record_example):
    from pillars_task import BUMPER_POS, BUMPER_RADIUS, PILLAR_RADIUS

    nearest = record_example("pillars", 300)[:, -3]
    at_the_front = PILLAR_RADIUS + BUMPER_RADIUS + BUMPER_POS[0]
    assert nearest.min() == pytest.approx(at_the_front, abs=0.01)


# Without the package.


def test_the_numpy_file_needs_numpy_alone(exported, tmp_path):
    site = site_with(tmp_path, NUMPY)
    path = exported / "policy.py"
    done = alone(site, f"import runpy; runpy.run_path({str(path)!r}, run_name='__main__')")
    assert (done.returncode, done.stderr) == (0, "")
    assert "from JAX" in done.stdout
    assert alone(site, "import jax").returncode == 1
    # It would have told of a difference.
    other = path.read_text().replace('"max_speed": 1.0', '"max_speed": 1.001')
    (tmp_path / "policy.py").write_text(other)
    shutil.copy(exported / "recording.npz", tmp_path)
    done = alone(
        site,
        f"import runpy; runpy.run_path({str(tmp_path / 'policy.py')!r}, run_name='__main__')",
    )
    assert done.returncode == 1


def test_a_program_reads_an_export_as_it_reads_a_run(exported):
    recording = np.load(exported / "recording.npz")
    policy = jetbot_mjx.load_policy(exported)
    np.testing.assert_allclose(policy(recording["obs"]), recording["action"], atol=1e-5)
    with pytest.raises(InvalidError, match=r"observation: .* not 7 numbers"):
        policy(np.zeros(3))
    with pytest.raises(InvalidError, match="does not explore"):
        policy(recording["obs"][0], jax.random.PRNGKey(0))


def all_zero(numbers):
    """As many numbers, all 0: the deviations of the observation too, by which it is divided."""
    first, content, last = numbers.groups()
    return first + re.sub(r"[^=\n]", "A", content) + last


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text.replace("NUMBERS = ", "OTHERS = "),
        lambda text: text.replace('"shapes": [[7]', '"shapes": [[99999999]'),
        lambda text: text.replace('"activation"', '"activatio"'),
        lambda text: re.sub(r'(NUMBERS = """\n)(.*?)(\n""")', all_zero, text, flags=re.DOTALL),
    ],
)
def test_a_file_that_is_no_export_is_told_and_not_executed(spoil, exported, tmp_path):
    shutil.copy(exported / "policy.json", tmp_path)
    text = (exported / "policy.py").read_text("utf-8")
    assert spoil(text) != text
    (tmp_path / "policy.py").write_text(f"raise SystemExit\n{spoil(text)}", "utf-8")
    with pytest.raises(UserError, match=r"policy\.py is not an exported policy"):
        jetbot_mjx.load_policy(tmp_path)


def test_a_policy_of_the_package_is_exported_to_the_folder_of_results(
    shortly, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    exported = export_policy("pretrained:jetbot_egocentric")
    assert exported.folder == Path("runs/pretrained/jetbot_egocentric/policy")


def test_the_onnx_file_needs_onnxruntime_alone(exported, tmp_path):
    needed = [*NUMPY, "onnxruntime", "flatbuffers", "packaging", "google"]
    done = alone(
        site_with(tmp_path, needed),
        "import numpy as np, onnxruntime\n"
        f"recording = np.load({str(exported / 'recording.npz')!r})\n"
        f"session = onnxruntime.InferenceSession({str(exported / 'policy.onnx')!r})\n"
        "action, wheels = session.run(['action', 'wheel_speeds'], {'obs': recording['obs']})\n"
        "assert not {'jax', 'jetbot_mjx', 'onnx'} & set(sys.modules)\n"
        "print(abs(action - recording['action']).max())\n"
        "print(abs(wheels - recording['wheel_speeds']).max())",
    )
    assert done.returncode == 0, done.stderr
    action, wheels = map(float, done.stdout.split())
    assert action < 1e-5
    assert wheels < 36.2e-5


def test_the_files_for_a_robot_are_python_3_6(exported, root):
    paths = [path for path in (root / "deploy").glob("*.py") if "rehearse" not in path.name]
    assert len(paths) == 8
    for path in [*paths, exported / "policy.py"]:
        tree = ast.parse(path.read_text("utf-8"), feature_version=(3, 6))
        imported = {
            name.split(".")[0]
            for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)
            for name in (
                [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
            )
        }
        known = {"argparse", "base64", "contextlib", "hashlib", "hmac", "ipaddress", "json", "math"}
        known |= {"os", "re", "secrets", "signal", "socket", "stat", "sys", "time"}
        known |= {"numpy", "jetbot", "types", "typing"} | {one.stem for one in paths}
        assert imported <= known, path.name
        assert "'='" not in ast.dump(tree), path.name  # f"{x=}" came with 3.8
        if path.name == "policy.py":
            # A robot's terminal may know ASCII only.
            assert path.read_text("utf-8").isascii()


# Policies that see.


@pytest.fixture(scope="module")
def seeing(tmp_path_factory):
    """The export of the policy that comes with the package."""
    folder = tmp_path_factory.mktemp("seeing") / "policy"
    command = ["pretrained:jetbot_camera", "--format", "all", "--output", str(folder)]
    assert export.main(command) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cnn", "camera", "observation", "distribution"),
    [
        ("small", {"colour": "grey", "frames": 3, "width": 37}, "camera+egocentric", "normal"),
        pytest.param("tiny", {"width": 33}, "camera", "tanh_normal", marks=pytest.mark.slow),
        pytest.param(
            "nature",
            {"width": 40, "height": 37},
            "camera+world",
            "tanh_normal",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_every_encoder_is_written_as_it_is(cnn, camera, observation, distribution, tmp_path):
    network = {"cnn": cnn, "distribution_type": distribution, "cnn_dtype": "bfloat16"}
    settings = {"ppo": {"network": network}, "camera": camera, "task": {"observation": observation}}
    checkpoint, env = checkpoint_of(settings, tmp_path)
    policy, rng = portable_policy(checkpoint, checkpoint.make_env()), np.random.default_rng(0)
    inputs = {
        name: rng.integers(256, size=(50, *one.shape), dtype=np.uint8)
        if name == "image"
        else rng.normal(size=(50, *one.shape)).astype(np.float32) * 3.0
        for name, one in policy.inputs.items()
    }
    assert inputs["image"].shape[1:] == env.observation_size["pixels/front"]
    assert ("state" in inputs) == (observation != "camera")
    recording = outputs_of(checkpoint, env, **inputs)
    assert recording.action.std() > 1e-3
    for name, one in FORMATS.items():
        path = tmp_path / one.file
        one.write(policy, as_jax(checkpoint, env), path)
        found = difference(recording, one.read(path)(*inputs.values()), policy.controller)
        assert found < TOLERANCE, name
    single, speeds = FORMATS["numpy"].read(tmp_path / "policy.py")(*(x[0] for x in inputs.values()))
    assert np.abs(single - recording.action[0]).max() < TOLERANCE
    assert speeds.shape == (2,)


@pytest.mark.slow
def test_the_recording_of_a_policy_that_sees_is_of_its_drives(seeing, capsys):
    checkpoint = load_checkpoint("pretrained:jetbot_camera")
    env = checkpoint.make_env()
    with np.load(seeing / "recording.npz") as recording:
        images = recording["image"]
    assert (images.shape, images.dtype) == ((1000, 32, 32, 3), np.uint8)
    first = env.reset(report_keys(1)[0]).obs["pixels/front"]
    np.testing.assert_array_equal(images[0], first)
    # The robot turns to the cube and drives to it, again and again: it is red.
    red = images[..., 0].astype(int) - images[..., 1:].max(axis=-1) > 60
    share = red.mean(axis=(1, 2))
    assert share.max() > 0.1
    assert np.count_nonzero(np.diff(share) < -0.05) >= 3
    told = json.loads((seeing / "policy.json").read_text())
    assert all(one["largest_difference"] < TOLERANCE for one in told["files"].values())


def test_the_contract_of_a_policy_that_sees_tells_the_image_and_the_camera(seeing):
    told = json.loads((seeing / "policy.json").read_text())
    assert told["inputs"] == [{"name": "image", "dtype": "uint8", "shape": [32, 32, 3]}]
    assert told["observation"] == []
    image = told["image"]
    assert (image["height"], image["width"], image["frames"]) == (32, 32, 1)
    assert image["channels"] == ["red", "green", "blue"]
    assert (image["dtype"], image["range"]) == ("uint8", [0, 255])
    assert image["resize"].startswith("area mean")
    assert image["stacked_by"].startswith("the caller")
    camera = image["camera"]
    assert (camera["position"], camera["pitch_down_degrees"]) == ([0.018, 0.0, 0.059], 20.0)
    assert (camera["lens"], camera["distortion"]) == ("pinhole", [])
    # 115 degrees from the upper to the lower border.
    seen = np.degrees(2 * np.arctan(16 / camera["matrix"]["fy"]))
    assert seen == pytest.approx(115.0)


def test_the_numpy_file_that_sees_needs_numpy_alone(seeing, tmp_path):
    path = seeing / "policy.py"
    done = alone(
        site_with(tmp_path, NUMPY),
        f"import runpy; runpy.run_path({str(path)!r}, run_name='__main__')",
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "from JAX" in done.stdout
    ast.parse(path.read_text("utf-8"), feature_version=(3, 6))


def test_the_onnx_file_that_sees_takes_bytes(seeing):
    import onnxruntime

    session = onnxruntime.InferenceSession(seeing / "policy.onnx")
    (one,) = session.get_inputs()
    assert (one.name, one.type, one.shape) == ("image", "tensor(uint8)", ["batch", 32, 32, 3])


def test_the_time_of_a_frame_is_told_for_every_file(seeing, capsys):
    from benchmarks.throughput import action_latency

    assert action_latency.main([str(seeing), "--calls", "5"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [row[0] for row in rows] == list(FORMATS)


@pytest.mark.slow
def test_the_caller_stacks_images_as_the_environment_does(tmp_path):
    settings = {"task": {"observation": "camera"}, "camera": {"frames": 3}}
    checkpoint, env = checkpoint_of(settings, tmp_path)
    FORMATS["numpy"].write(
        portable_policy(checkpoint, env), as_jax(checkpoint, env), tmp_path / "p.py"
    )
    stack = FORMATS["numpy"].read(tmp_path / "p.py").__globals__["stack"]
    before = None
    for images in record(checkpoint, env, 8).inputs["image"]:
        before = stack(images[..., -3:], before)
        np.testing.assert_array_equal(before, images)
    assert (before[..., :3] != before[..., 3:6]).any()


@pytest.mark.parametrize(
    ("inputs", "said"),
    [
        ((np.zeros((32, 32, 3)),), r"the image is float64 of shape \(32, 32, 3\), not uint8"),
        ((np.zeros((3, 32, 32), np.uint8),), r"of shape \(3, 32, 32\), not uint8 of \[32, 32, 3\]"),
        ((np.zeros((32, 32, 3), np.uint8), np.zeros(7)), "give image$"),
    ],
)
def test_an_invalid_image_is_refused(inputs, said, seeing):
    with pytest.raises(ValueError, match=said):
        FORMATS["numpy"].read(seeing / "policy.py")(*inputs)


# Mistakes.


def test_what_differs_from_jax_is_not_written(run_dir, exported, shortly, monkeypatch, tmp_path):
    before = {path.name: path.read_bytes() for path in exported.iterdir()}
    write = FORMATS["numpy"].write

    def write_another(policy, as_jax, path):
        *layers, last = policy.layers
        other = last._replace(bias=last.bias + np.float32(1e-3))
        write(policy._replace(layers=(*layers, other)), as_jax, path)

    monkeypatch.setitem(exporters.FORMATS, "numpy", FORMATS["numpy"]._replace(write=write_another))
    for folder in (tmp_path / "new", exported):
        with pytest.raises(
            UserError, match=r"nothing was written to .*policy\.py differs from JAX"
        ):
            export_policy(run_dir, formats=("onnx", "numpy"), output=folder)
    assert os.listdir(tmp_path) == []
    assert {path.name: path.read_bytes() for path in exported.iterdir()} == before
    assert not [path for path in run_dir.iterdir() if path.name.startswith(".policy")]


def test_an_export_that_is_stopped_leaves_the_earlier_one(run_dir, exported, shortly, monkeypatch):
    def stop(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(policy_export.runs, "write_json", stop)
    with pytest.raises(KeyboardInterrupt):
        export_policy(run_dir)
    assert (exported / "policy.onnx").is_file()
    assert not [path for path in run_dir.iterdir() if path.name.startswith(".policy")]


@pytest.mark.parametrize(
    ("action", "wheel_speeds"),
    [
        (np.full((2, 2), np.nan), np.zeros((2, 2))),
        (np.zeros((2, 2)), np.full((2, 2), 1e-3)),
        (np.zeros((1, 2)), np.zeros((2, 2))),
    ],
)
def test_a_difference_is_seen(action, wheel_speeds, run_dir):
    checkpoint = load_checkpoint(run_dir)
    controller = portable_policy(checkpoint, checkpoint.make_env()).controller
    recording = Recording({"obs": np.zeros((2, 16))}, np.zeros((2, 2)), np.zeros((2, 2)))
    assert difference(recording, (action, wheel_speeds), controller) > TOLERANCE
    assert difference(recording, recording[1:], controller) == 0.0


def test_a_missing_package_is_told_with_its_remedy(run_dir, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(
        MissingPackageError, match=r"--format onnx needs onnx.*pip install 'jetbot_mjx\[export"
    ):
        export.main([str(run_dir), "--format", "all", "--output", str(tmp_path / "p")])
    assert os.listdir(tmp_path) == []


def test_a_folder_with_something_else_is_left_alone(run_dir, tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(UserError, match="exists and is not an export"):
        export_policy(run_dir, output=tmp_path)
    assert os.listdir(tmp_path) == ["thesis.txt"]


def test_a_folder_that_cannot_be_is_told(run_dir, tmp_path):
    with pytest.raises(UserError, match="cannot be written: File name too long"):
        export_policy(run_dir, output=tmp_path / ("x" * 300))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "arguments",
    [["--format", "stablehlo", "--format", "numpy"], ["--format", "stablehlo,numpy"]],
    ids=["twice", "a list"],
)
def test_several_formats_are_all_written(run_dir, tmp_path, shortly, arguments):
    out = tmp_path / "policy"
    assert export.main([str(run_dir), "--output", str(out), *arguments]) == 0
    names = {path.name for path in out.iterdir()}
    assert names == {"policy.stablehlo", "policy.py", "policy.json", "recording.npz"}


def test_without_a_format_it_is_numpy(run_dir, tmp_path, shortly):
    assert export.main([str(run_dir), "--output", str(tmp_path / "policy")]) == 0
    files = json.loads((tmp_path / "policy" / "policy.json").read_text())["files"]
    assert list(files) == ["numpy"]


def test_an_unknown_format_is_told(run_dir, capsys):
    with pytest.raises(SystemExit) as left:
        export.main([str(run_dir), "--format", "numpy,torch"])
    assert left.value.code == 2
    assert "'torch' is not one of numpy, onnx, stablehlo, all" in capsys.readouterr().err


def test_a_shorter_recording_is_the_beginning_of_a_longer_one(exported, run_dir):
    checkpoint = load_checkpoint(run_dir)
    short = record(checkpoint, checkpoint.make_env(), 20)
    with np.load(exported / "recording.npz") as recording:
        np.testing.assert_array_equal(short.inputs["obs"], recording["obs"][:20])


def test_the_formats_and_the_folder_are_those_of_the_exporters():
    assert tuple(FORMATS) == export._FORMATS
    assert export._FOLDER == policy_export.FOLDER


# Policies of an environment of one's own.


@slow_fixture(scope="module", params=["PointMass", "Choosing"])
def own(request, tmp_path_factory):
    """A run in an environment of one's own, and its export."""
    run_dir = tmp_path_factory.mktemp("own") / "run"
    training.run(point_mass.config(request.param), run_dir)
    assert export.main([str(run_dir), "--format", "all"]) == 0
    return run_dir, run_dir / "policy"


@pytest.mark.slow
def test_a_policy_of_an_environment_is_exported_with_its_contract(own):
    _, folder = own
    spec = json.loads((folder / "policy.json").read_text())
    choosing = spec["environment"].endswith("Choosing")
    assert spec["inputs"] == [{"name": "obs", "dtype": "float32", "shape": [2]}]
    assert [one["name"] for one in spec["action"]] == (
        ["choice_0", "choice_1", "choice_2"] if choosing else ["action_0"]
    )
    assert spec["control_period"] == (None if choosing else point_mass.DT)
    assert spec["network"]["squash"] == (None if choosing else "tanh")
    assert set(spec["files"]) == {*FORMATS}
    assert all(one["largest_difference"] < TOLERANCE for one in spec["files"].values())
    assert 9_900 < spec["recording"]["observations"] <= 10_000
    assert "wheel_speeds" not in spec


def test_an_exported_policy_of_an_environment_acts_as_the_run_does(own):
    run_dir, folder = own
    obs = np.random.default_rng(0).uniform(-1, 1, (200, 2)).astype(np.float32)
    action = np.asarray(jetbot_mjx.load_policy(run_dir)(obs))
    assert np.abs(np.asarray(jetbot_mjx.load_policy(folder)(obs)) - action).max() < TOLERANCE
    (onnx,) = FORMATS["onnx"].read(folder / "policy.onnx")(obs)
    assert np.abs(onnx - action).max() < TOLERANCE
    if action.shape[1] == 3:
        assert set(np.unique(action)) == {0.0, 1.0}
        assert (action.sum(axis=1) == 1).all()
    with pytest.raises(InvalidError, match="not 2 numbers"):
        jetbot_mjx.load_policy(folder)(np.zeros(3))


def test_the_file_of_an_environments_policy_checks_itself(own):
    _, folder = own
    done = subprocess.run([sys.executable, "policy.py"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "from JAX; a call takes" in done.stdout


def test_a_page_is_for_robots(own):
    with pytest.raises(UserError, match="has no robot that drives to a goal: this is for policies"):
        export.main([str(own[0]), "--format", "web"])
