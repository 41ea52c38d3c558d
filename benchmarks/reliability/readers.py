"""All readers of files and messages, each with valid samples, for `fuzz.py`.

A reader is made in an empty folder, with what it needs beside the file in question, and is then
called with one content after the other.
"""

import base64
import contextlib
import functools
import hashlib
import hmac
import io
import json
import shutil
import sqlite3
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from benchmarks import CONFIGS, ROOT
from benchmarks.harness.mutations import dump
from jetbot_mjx.errors import UserError

# The programs of the robot import each other by their names.
sys.path.append(str(ROOT / "deploy"))

PRETRAINED = ROOT / "jetbot_mjx" / "assets" / "pretrained" / "jetbot_egocentric"

Read = Callable[[bytes], object]


class Reader(NamedTuple):
    """A `Reader` is what is fuzzed."""

    make: Callable[[Path], Read]
    """From an empty folder to a function that reads one content."""
    samples: Callable[[], Sequence[bytes]]
    """Valid contents."""
    quick: int
    """Number of inputs of a short run."""
    share: int = 1
    """Its part of the time of a long run, in which it has at least its number of inputs too."""


def _examples(*names: str) -> list[bytes]:
    return [(ROOT / "examples" / name).read_bytes() for name in names]


def _text(content: bytes) -> str:
    return content.decode("utf-8", "surrogateescape")


def _write(file: Path) -> Callable[[Callable[[], object]], Read]:
    """Return a decorator: the function is called when the file holds the content."""

    def decorate(read: Callable[[], object]) -> Read:
        def write_and_read(content: bytes) -> object:
            file.write_bytes(content)
            return read()

        return write_and_read

    return decorate


# Configurations.


def _make_config(folder: Path) -> Read:
    from jetbot_mjx.config import load_config

    for name in ("car.xml", "rover.xml", "turtlebot.xml"):
        (folder / name).write_bytes((ROOT / "examples" / name).read_bytes())
    return _write(folder / "mine.yaml")(lambda: load_config(folder / "mine.yaml"))


def _config_samples() -> list[bytes]:
    names = ("smoke", "camera_gpu", "jetbot_egocentric", "real_jetbot")
    own = [(CONFIGS / f"{name}.yaml").read_bytes() for name in names]
    short = (b"seed: 1\nppo: {num_envs: 64, batch_size: 32, network: {activation: relu}}\n",)
    return [*own, *_examples("car.yaml", "rover.yaml", "cartpole.yaml"), *short * 4]


def _make_override(folder: Path) -> Read:
    from jetbot_mjx.config import load_config

    robot = ROOT / "jetbot_mjx" / "assets" / "robots" / "real.yaml"
    (folder / "real.yaml").write_bytes(robot.read_bytes())
    return lambda content: load_config(None, [_text(content)])


def _override_samples() -> list[bytes]:
    texts = (
        *("ppo.num_envs=256", "ppo.network.policy_hidden_layer_sizes=[64, 64]", "seed=3"),
        *("robot.file=real.yaml", "robot.preset=real", "task.options.width=0.4", "wandb=jetbot"),
        *("task.name=my_task:MyTask", "environment=my_env.py:Balance", "camera.colour=grey"),
        *("randomization.friction=[0.5, 1.0]", "physics.iterations=9", "init_from=runs/mine"),
    )
    return [text.encode() for text in texts]


def _make_robot(folder: Path) -> Read:
    from jetbot_mjx.config import load_config

    (folder / "mine.yaml").write_text("robot: {file: robot.yaml}\n")
    return _write(folder / "robot.yaml")(lambda: load_config(folder / "mine.yaml"))


def _robot_samples() -> list[bytes]:
    folder = ROOT / "jetbot_mjx" / "assets" / "robots"
    return [b"wheel_radius: 0.04\n", *(file.read_bytes() for file in sorted(folder.glob("*.yaml")))]


def _make_mjcf(folder: Path) -> Read:
    from jetbot_mjx.config import load_config
    from jetbot_mjx.envs import make_env, make_mj_model

    names = ("rover", "turtlebot", "car")
    configs = [folder / f"{name}.yaml" for name in names]
    for file in configs:
        text = (ROOT / "examples" / file.name).read_text()
        file.write_text(text.replace(f"{file.stem}.xml", "model.xml"))

    def read() -> object:
        text = (folder / "model.xml").read_bytes()
        name = next((x for x in names if f'model="{x}"'.encode() in text), "rover")
        config = load_config(folder / f"{name}.yaml", imports=False)
        # Now and then all of it, which takes a hundred times as long.
        if len(text) % 32 == 0:
            return make_env(config)
        try:
            return make_mj_model(config.robot, config.physics)
        except (RuntimeError, ValueError) as error:
            raise UserError(str(error)) from None  # as `make_env` does

    return _write(folder / "model.xml")(read)


def _make_space(folder: Path) -> Read:
    from jetbot_mjx.config import load_config
    from jetbot_mjx.tuning import read_space

    config = load_config("smoke")
    return _write(folder / "space.yaml")(lambda: read_space(folder / "space.yaml", config))


def _space_samples() -> list[bytes]:
    own = b"ppo.learning_rate: {low: 1.0e-4, high: 1.0e-2, log: true}\n"
    own += b"ppo.unroll_length: {choices: [8, 16]}\n"
    return [own, own[: own.index(b"\n") + 1]]


def _make_study(folder: Path) -> Read:
    from jetbot_mjx.config import load_config
    from jetbot_mjx.tuning import Search, read_space, search

    config = load_config("smoke")
    space = read_space({"ppo.learning_rate": {"low": 1e-4, "high": 1e-2}}, config)
    (folder / "study").mkdir()
    # It would wait a second for other workers.
    search._OPENINGS = 1

    def read() -> object:
        study = Search(config, space, folder / "study")
        study.run(0, 1)
        return search.ranked_trials(study.study)

    return _write(folder / "study" / "study.db")(read)


@functools.cache
def _study_samples() -> list[bytes]:
    from jetbot_mjx.config import load_config
    from jetbot_mjx.tuning import Search, read_space, search

    config = load_config("smoke")
    space = read_space({"ppo.learning_rate": {"low": 1e-4, "high": 1e-2}}, config)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "study"
        study = Search(config, space, folder).study
        with search.quiet():
            for _ in range(3):
                trial = study.ask()
                for one in space:
                    one.suggest(trial)
                study.tell(trial, 0.5)
        with contextlib.closing(sqlite3.connect(folder / "study.db")) as database:
            database.execute("VACUUM")
        return [(folder / "study.db").read_bytes()]


# Run folders.


def _make_run(folder: Path) -> Read:
    from jetbot_mjx.runs import run_finder

    return _write(folder / "config.yaml")(lambda: run_finder.read_info(folder))


def _run_samples() -> list[bytes]:
    return [(PRETRAINED / "config.yaml").read_bytes()]


def _make_versions(folder: Path) -> Read:
    from jetbot_mjx.runs import run_dir

    known = run_dir.versions()
    # It asks git each time.
    run_dir.versions = lambda: known
    return _write(folder / "versions.json")(lambda: run_dir.changed_versions(folder))


def _versions_samples() -> list[bytes]:
    return [(PRETRAINED / "versions.json").read_bytes()]


def _make_metrics(folder: Path) -> Read:
    from jetbot_mjx.runs import JsonlSink, TensorBoardSink, read_history

    file = folder / "metrics.jsonl"

    def read() -> object:
        history = read_history(file)
        # A resumed training begins with them: now and then, for it takes a hundred times as long.
        if file.stat().st_size % 32 == 0:
            JsonlSink(folder / "again.jsonl", history).close()
            TensorBoardSink(folder / "tensorboard", history).close()
        return history

    return _write(file)(read)


def _metrics_samples() -> list[bytes]:
    lines = (PRETRAINED / "metrics.jsonl").read_bytes().splitlines(keepends=True)
    return [b"".join(lines[:2]), lines[0], lines[-1]]


def _checkpoint(folder: Path) -> Path:
    """Copy a run with one checkpoint; return the folder of the checkpoint."""
    shutil.copytree(PRETRAINED, folder / "run")
    return next((folder / "run" / "checkpoints").iterdir())


def _make_about(folder: Path) -> Read:
    from jetbot_mjx.runs import checkpoint, checkpoint_store, run_dir

    path = _checkpoint(folder)
    file = path / "about" / "metadata"

    def read(content: bytes) -> object:
        # Half of them with the digest that fits: of what somebody forged.
        with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):
            if len(content) % 2:
                about = json.loads(content)
                about["sha256"].pop("about", None)
                about["sha256"]["about"] = checkpoint_store._digest_json(about)
                content = dump(about)
        file.write_bytes(content)
        about = checkpoint.explanation(path)
        return run_dir.parse_stored(about["config"], path.parent.parent, "stored config")

    return read


def _about_samples() -> list[bytes]:
    path = next((PRETRAINED / "checkpoints").iterdir())
    return [(path / "about" / "metadata").read_bytes()]


def _make_checkpoint(folder: Path) -> Read:
    from jetbot_mjx.runs import load_checkpoint

    path = _checkpoint(folder)
    files = _files_of(path)
    whole = {file: file.read_bytes() for file in files}

    def read(content: bytes) -> object:
        # The first byte chooses the file of which the others are the content.
        file = files[content[0] % len(files)] if content else files[0]
        file.write_bytes(content[1:])
        try:
            return load_checkpoint(path)
        finally:
            file.write_bytes(whole[file])

    return read


def _checkpoint_samples() -> list[bytes]:
    path = next((PRETRAINED / "checkpoints").iterdir())
    return [bytes([number]) + x.read_bytes() for number, x in enumerate(_files_of(path))]


def _files_of(checkpoint: Path) -> list[Path]:
    """Return the files that a reader needs: there are others beside them, for Orbax."""
    found = sorted((checkpoint / "policy").rglob("*"))
    return [x for x in found if x.is_file() and "ocdbt" in str(x) or x.parent.name == "d"]


def _make_task_code(folder: Path) -> Read:
    from jetbot_mjx.config import load_config
    from jetbot_mjx.runs import read_task_code, trust

    (folder / "task").mkdir()
    (folder / "task" / "my_task.py").write_text("raise AssertionError\n")
    (folder / "secret").write_text("secret")
    config = load_config(None, ["task.name=my_task:MyTask"])

    def read() -> object:
        code = read_task_code(folder)
        return trust._is_recorded(trust._digest(config, code))

    return _write(folder / "task" / "sources.json")(read)


def _task_code_samples() -> list[bytes]:
    digest = hashlib.sha256(b"raise AssertionError\n").hexdigest()
    return [json.dumps({"module": "my_task", "sha256": {"my_task.py": digest}}).encode()]


def _make_nan_dump(folder: Path) -> Read:
    from jetbot_mjx.runs import nan_dump

    template = functools.cache(lambda text: nan_dump_template(text))
    nan_dump_template = _uncached_template
    nan_dump._template = lambda config, own_class: template(config.to_yaml())
    (folder / "nan_dumps").mkdir()
    file = folder / "nan_dumps" / "000000000001.npz"
    return _write(file)(lambda: nan_dump.load_nan_dump(file))


def _uncached_template(text: str) -> Any:
    from jetbot_mjx.agents import NanDump
    from jetbot_mjx.config import parse_config
    from jetbot_mjx.config.yaml_text import parse_yaml

    parse_config(parse_yaml(text, "config"))
    number: Any = np.float32(0)
    return NanDump(number, {"qpos": np.zeros(3)}, np.zeros((4, 2)), number)  # type: ignore[arg-type]


def _nan_dump_samples() -> list[bytes]:
    from jetbot_mjx.config import load_config
    from jetbot_mjx.runs.checkpoint_store import flatten
    from jetbot_mjx.runs.nan_dump import _FORMAT

    config = load_config("smoke")
    about = {"format": _FORMAT, "config": config.model_dump(mode="json"), "env_steps": 3}
    content = io.BytesIO()
    arrays = flatten(_uncached_template(config.to_yaml()))
    np.savez(content, about=np.array(json.dumps(about)), **arrays)
    return [content.getvalue()]


def _make_report(folder: Path) -> Read:
    from jetbot_mjx.deployment import policy_spec
    from jetbot_mjx.evaluation import result_names

    (folder / "evaluations" / "1").mkdir(parents=True)
    found: Any = SimpleNamespace(run_dir=folder, path=folder / "checkpoints" / "1")
    file = folder / "evaluations" / "1" / "report.json"

    def read() -> object:
        policy_spec._evaluation(found)
        return result_names._goals_and_parts(file.parent)

    return _write(file)(read)


def _report_samples() -> list[bytes]:
    from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION

    policy = {"episodes": 2048, "success_rate": 0.99, "time_to_goal_median": 1.5}
    report = {"goal_set_version": GOAL_SET_VERSION, "policy": policy, "mujoco": {"rendered": 8}}
    return [json.dumps(report).encode()]


# What a robot reads, and what it writes.


class _Clock:
    """The clock of a drive that takes no time."""

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds


_POLICY = """def act(obs, state=None):
    return (0.5, 0.0), (6.0, 6.0)
def stack(image, before):
    return image
"""


def _make_policy_spec(folder: Path) -> Read:
    import drive

    (folder / "policy.py").write_text(_POLICY)
    arguments = [str(folder), "--dry-run", "--timeout", "0.1", "--log", str(folder / "log")]

    def read() -> object:
        policy = drive.load_policy(str(folder))
        kind = ["--camera"] if "image" in policy.spec else ["--goal", "1", "0"]
        camera = SimpleNamespace(value=np.full((64, 64, 3), 90, np.uint8))
        drive.make_camera = lambda: camera
        said = io.StringIO()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            code = drive.main([*arguments, *kind], _Clock())
        if code == 2:
            raise drive.DriveError(said.getvalue().removeprefix("error: ").removesuffix("\n"))
        return code

    return _write(folder / "policy.json")(read)


@functools.cache
def _policy_spec_samples() -> list[bytes]:
    from jetbot_mjx.config import CameraConfig
    from jetbot_mjx.deployment.numpy_policy import portable_policy
    from jetbot_mjx.deployment.policy_spec import _image, policy_spec
    from jetbot_mjx.runs import load_checkpoint

    checkpoint = load_checkpoint(PRETRAINED)
    env: Any = checkpoint.make_env()
    spec = policy_spec(checkpoint, env, portable_policy(checkpoint, env))
    spec["files"] = {"numpy": {"file": "policy.py"}}
    seeing = {**spec, "observation": [], "image": _image(CameraConfig(width=32, height=32), 0.05)}
    return [json.dumps(spec).encode(), json.dumps(seeing).encode()]


def _make_exported(folder: Path) -> Read:
    from jetbot_mjx.deployment import read_exported

    read = _write(folder / "policy.py")(lambda: read_exported(folder))

    def read_either(content: bytes) -> object:
        # Of half of them only what the file must know is damaged, and read as it is.
        about, begin, numbers = content.partition(b"@")
        return read(_exported_text(about, numbers) if begin else content)

    return read_either


def _exported_text(about: bytes, numbers: bytes) -> bytes:
    from jetbot_mjx.deployment import exporters

    text = exporters._numpy_text({}, "").encode()
    text = text.replace(b'"""{}"""', b'"""' + about + b'"""')
    return text.replace(b'NUMBERS = """\n\n"""', b'NUMBERS = """\n' + numbers + b'\n"""')


@functools.cache
def _exported_samples() -> list[bytes]:
    from jetbot_mjx.deployment import exporters

    about = {
        "inputs": ["obs"],
        "image": None,
        "strides": [],
        "activation": "tanh",
        "squash": True,
        "controller": None,
        "shapes": [[3], [3], [3, 2], [2]],
    }
    numbers = base64.b64encode(np.ones(14, "<f4").tobytes()).decode()
    short = json.dumps(about).encode() + b"@" + numbers.encode()
    return [exporters._numpy_text(about, numbers).encode(), short, short]


def _make_calibration(folder: Path) -> Read:
    import motors

    file = folder / "calibration.json"
    return _write(file)(lambda: motors.read_calibration(str(file)))


def _calibration_samples() -> list[bytes]:
    import motors

    return [json.dumps(motors.as_json(motors.default_calibration()), indent=2).encode()]


_LENS = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1.5e+02, 0., 3.2e+02, 0.,
       1.4e+02, 2.3e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.01, -0.005, 0.001, 0.002, 0. ]
"""


def _image_of_spec() -> dict[str, Any]:
    from jetbot_mjx.config import CameraConfig
    from jetbot_mjx.deployment.policy_spec import _image

    return _image(CameraConfig(width=32, height=32), 0.05)


def _make_lens(folder: Path) -> Read:
    import undistort

    file, image = folder / "lens.yaml", _image_of_spec()
    picture = np.full((48, 64, 3), 90, np.uint8)

    def read() -> object:
        return undistort.Reducer(image, picture.shape[:2], undistort.read_lens(str(file)))(picture)

    return _write(file)(read)


def _lens_samples() -> list[bytes]:
    return [_LENS.encode(), _LENS.replace("image_w", "fisheye_model: 1\nimage_w").encode()]


def _make_frames(folder: Path) -> Read:
    import camera_sense
    import motors

    image = {**_image_of_spec(), "frames": 1}
    spec = {"image": image, "observation": [], "rest_height": 0.0321}
    policy = SimpleNamespace(spec=spec, stack=None)
    camera = SimpleNamespace(value=None)
    calibration = motors.default_calibration()
    sense = camera_sense.CameraSense(camera, policy, calibration, camera_sense.CameraSettings())
    times = iter(range(10**9))

    def read(content: bytes) -> object:
        # The first bytes are its type, the number of its axes, and its size.
        kinds = ("u1", "u1", "u1", "i1", "f4", "u2", "?", "S1", "O")
        head = content[:5].ljust(5, b"\0")
        kind = np.dtype(kinds[head[0] % len(kinds)])
        shape = (head[2], head[3], 3 if head[4] < 200 else head[4])[: 3 if head[1] < 200 else 2]
        count = int(np.prod(shape))
        size = max(kind.itemsize, 1) * count
        if kind.hasobject:
            camera.value = [None, b"", 3, "picture", np.array(None), []][head[2] % 6]
        else:
            pixels = (content[5:] * (size // max(len(content) - 5, 1) + 1))[:size].ljust(size)
            camera.value = np.frombuffer(pixels, kind).reshape(shape)
        reading = sense.read(next(times) * 0.05)
        return json.dumps(reading.line, allow_nan=False)

    return read


def _frames_samples() -> list[bytes]:
    colours = bytes(range(256)) * 8
    return [bytes([0, 0, side, side, 0]) + colours for side in (32, 64, 31, 0)]


def _make_drive_log(folder: Path) -> Read:
    from jetbot_mjx.deployment.drive_log import metrics, read_log, replay

    file = folder / "drive.jsonl"

    def read() -> object:
        found = metrics(replay(read_log(file)))
        return json.dumps(found, allow_nan=False)

    return _write(file)(read)


@functools.cache
def _drive_log_samples() -> list[bytes]:
    import motors

    header = {
        "format": "jetbot_mjx-drive/1",
        "policy": {"run": "mine", "env_steps": 3, "task": "t", "robot": "real"},
        "goal": [0.5, 0.1],
        "control_period": 0.05,
        "pose_source": "odometry",
        "calibration": motors.as_json(motors.default_calibration()),
        "arrive_within": 0.1,
    }
    period = {"x": 0.0, "y": 0.0, "yaw": 0.0, "pose_age": 0.0, "fresh": True, "motors": [0.3, 0.4]}
    period |= {"speed": 0.1, "yaw_rate": 0.0, "latency": 0.001, "late": False}
    lines = [{**period, "t": 0.05 * i, "x": 0.01 * i} for i in range(5)]
    lines[-1]["outcome"] = "timed out"
    picture = base64.b64encode(bytes(32 * 32 * 3)).decode()
    seen = [header | {"image": _image_of_spec(), "goal": None}]
    seen += [{**line, "picture": picture} for line in lines[:2]]
    return [
        "".join(json.dumps(line) + "\n" for line in log).encode()
        for log in ([header, *lines], seen)
    ]


def _make_datagram(folder: Path) -> Read:
    import datagrams
    import poses

    key = folder / "tracker.key"
    key.write_text("0123456789abcdef")
    key.chmod(0o600)
    received: list[bytes] = []
    plain = poses.Tracker(lambda: received)
    secret = datagrams.Key(str(key))
    signed = poses.Tracker(lambda: received, key=secret)
    times = iter(range(10**9))

    def read(content: bytes) -> object:
        now = next(times) * 0.01
        received[:] = [content, hmac.new(b"0123456789abcdef", content, "sha256").digest() + content]
        found = [tracker.read(now) for tracker in (plain, signed)]
        # Those of a forged clock would be the newest ever.
        secret._newest, plain._sent, signed._sent = float("-inf"), 0.0, 0.0
        return json.dumps([pose and pose._asdict() for pose in found], allow_nan=False)

    return read


def _datagram_samples() -> list[bytes]:
    return [
        json.dumps({"time": 12.25, "x": 0.31, "y": -0.02, "yaw": 1.57}).encode(),
        b'{"time":1e9,"x":1,"y":2,"yaw":-3,"more":[1,{"a":null}]}',
    ]


def _make_key(folder: Path) -> Read:
    import datagrams

    file = folder / "tracker.key"
    newest = folder / "tracker.key.newest"

    def read(content: bytes) -> object:
        secret, _, time = content.partition(b"\n")
        file.write_bytes(secret)
        file.chmod(0o600)
        newest.write_bytes(time)
        return datagrams.Key(str(file))

    return read


READERS: dict[str, Reader] = {
    "configuration": Reader(_make_config, _config_samples, 60),
    "overrides": Reader(_make_override, _override_samples, 100),
    "robot": Reader(_make_robot, _robot_samples, 40),
    "MJCF": Reader(_make_mjcf, lambda: _examples("rover.xml", "turtlebot.xml", "car.xml"), 60),
    "search space": Reader(_make_space, _space_samples, 40),
    "study.db": Reader(_make_study, _study_samples, 5),
    "config.yaml of a run": Reader(_make_run, _run_samples, 20),
    "versions.json": Reader(_make_versions, _versions_samples, 200),
    "metrics.jsonl": Reader(_make_metrics, _metrics_samples, 400, share=4),
    "metadata of a checkpoint": Reader(_make_about, _about_samples, 40),
    "checkpoint": Reader(_make_checkpoint, _checkpoint_samples, 15),
    "stored code": Reader(_make_task_code, _task_code_samples, 200),
    "NaN dump": Reader(_make_nan_dump, _nan_dump_samples, 50),
    "report.json": Reader(_make_report, _report_samples, 200),
    "policy.json": Reader(_make_policy_spec, _policy_spec_samples, 100),
    "policy.py": Reader(_make_exported, _exported_samples, 100),
    "calibration.json": Reader(_make_calibration, _calibration_samples, 300, share=4),
    "lens calibration": Reader(_make_lens, _lens_samples, 100),
    "camera frames": Reader(_make_frames, _frames_samples, 100, share=2),
    "drive log": Reader(_make_drive_log, _drive_log_samples, 60),
    "datagrams": Reader(_make_datagram, _datagram_samples, 1000, share=10),
    "tracker key": Reader(_make_key, lambda: [b"0123456789abcdef\n1234.5"], 100, share=2),
}
