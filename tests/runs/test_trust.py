"""A run folder from a stranger: no command runs its code, or writes outside of it, unasked.

Each attack changes a copy of a small run so that something would write a file, the canary. Without
the check in `require_trust`, every one of them writes it.
"""

import importlib
import importlib.util
import json
import os
import pickle
import py_compile
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import jetbot_mjx
from helpers import fake_hub
from helpers.damage import damage_about
from helpers.untrained import write_untrained_run
from jetbot_mjx import cli
from jetbot_mjx.config import ConfigError, parse_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import nan_dump, task_code
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.nan_dump import load_nan_dump
from jetbot_mjx.runs.run_dir import write_run
from jetbot_mjx.runs.task_code import TaskCode, write_task_code
from jetbot_mjx.runs.trust import check_links, record_code, require_trust, trusted_class, trusting
from jetbot_mjx.training.composition import find_code

SMALL = {"network": {"policy_hidden_layer_sizes": [4], "value_hidden_layer_sizes": [4]}}

MODEL = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 0.1"><freejoint/><geom name="hull" size="0.1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """The state folder of a user who has trained nothing."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(task_code, "_modules", {})
    monkeypatch.setattr(task_code, "_said", set())
    return tmp_path / "state" / "jetbot_mjx" / "own_code"


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A run of the package's own task, and a dump of it."""
    folder = tmp_path_factory.mktemp("theirs") / "run"
    config = parse_config({"ppo": SMALL})
    write_untrained_run(folder, config)
    write_run(folder, config, {})
    (folder / "nan_dumps").mkdir()
    about = {"format": nan_dump._FORMAT, "config": config.model_dump(mode="json"), "env_steps": 0}
    np.savez(folder / "nan_dumps" / "0.npz", about=np.array(json.dumps(about)))
    return folder


@pytest.fixture
def run(stored, tmp_path, monkeypatch):
    """A copy of the run in a folder of its own, which is the current one."""
    folder = tmp_path / "downloads"
    folder.mkdir()
    monkeypatch.chdir(folder)
    shutil.copytree(stored, folder / "run")
    return folder / "run"


@pytest.fixture
def canary(tmp_path):
    return tmp_path / "canary"


def change(run, **settings):
    """Change settings in all places of a run that hold its configuration."""

    def change_about(about):
        about["config"] |= settings

    damage_about(change_about)(next((run / "checkpoints").iterdir()))
    dump = run / "nan_dumps" / "0.npz"
    with np.load(dump) as arrays:
        about = json.loads(str(arrays["about"]))
    about["config"] |= settings
    np.savez(dump, about=np.array(json.dumps(about)))
    (run / "config.yaml").write_text(parse_config(about["config"]).to_yaml())


def environment(run, name, options=None):
    config = load_checkpoint(run).about["config"]
    ppo = config["ppo"] | {"normalizer": "brax"}
    change(run, environment=name, environment_options=options or {}, ppo=ppo)


def task(run, name):
    change(run, task=load_checkpoint(run).about["config"]["task"] | {"name": name})


def payload(canary):
    return f"from pathlib import Path\nPath({str(canary)!r}).write_text('ran')\n"


def store(run, files):
    """Store source in a run, as a training does."""
    code = TaskCode(next(iter(files)).removesuffix(".py"), tuple(sorted(files.items())))
    write_task_code(run, code)
    return code


def a_stored_task(run, canary):
    store(run, {"evil.py": payload(canary).encode()})
    task(run, "evil:Task")


def a_stored_environment(run, canary):
    store(run, {"evil.py": payload(canary).encode()})
    environment(run, "evil:Env")


def a_program(run, canary):
    environment(run, "subprocess:run", {"args": ["touch", str(canary)]})


def a_shell(run, canary):
    environment(run, "os:system", {"command": f"touch {canary}"})


def a_script(run, canary):
    (run / "script.txt").write_text(payload(canary))
    environment(run, "runpy:run_path", {"path_name": str(run / "script.txt")})


class Pickled:
    def __init__(self, canary):
        self.canary = canary

    def __reduce__(self):
        return Path.touch, (self.canary,)


def a_pickle_by_numpy(run, canary):
    (run / "array.npy").write_bytes(pickle.dumps(Pickled(canary)))
    environment(run, "numpy:load", {"file": str(run / "array.npy"), "allow_pickle": True})


def a_file_in_the_current_folder(run, canary):
    Path("beside.py").write_text(payload(canary))
    task(run, "beside:Task")


def a_file_in_the_run(run, canary):
    (run / "inside.py").write_text(payload(canary))
    (run / "checkpoints" / "inside.py").write_text(payload(canary))
    os.chdir(run)
    task(run, "inside:Task")


def a_function_of_this_package(run, canary):
    Path("beside.py").write_text(payload(canary))
    environment(run, "jetbot_mjx.envs:import_class", {"key": "x", "name": "beside:x"})


def a_changed_example(run, canary):
    source = Path(jetbot_mjx.__file__).parents[1] / "examples" / "hopper.py"
    store(run, {"hopper.py": source.read_bytes() + payload(canary).encode()})
    environment(run, "hopper:Hopper")


def a_drive(run, canary):
    (run / "robot").mkdir(exist_ok=True)
    (run / "robot" / "m.xml").write_text(MODEL)
    (run / "robot" / "evil.py").write_text(payload(canary) + "def controls(action): return action")
    robot = {"file": str(run / "robot" / "m.xml"), "drive": "evil.py:controls"}
    change(run, robot=parse_config({"robot": robot}).robot.model_dump(mode="json"))


def code_that_was_trained_with_other_options(run, canary):
    code = store(run, {"own.py": f"def make(path): {payload(canary)!r} and exec(path)\n".encode()})
    environment(run, "own:make", {"path": "pass"})
    record_code(run, load_checkpoint(run).config, code)
    environment(run, "own:make", {"path": payload(canary)})


ATTACKS = (
    a_stored_task,
    a_stored_environment,
    a_program,
    a_shell,
    a_script,
    a_pickle_by_numpy,
    a_file_in_the_current_folder,
    a_file_in_the_run,
    a_function_of_this_package,
    a_changed_example,
    a_drive,
    code_that_was_trained_with_other_options,
)

COMMANDS = {
    "evaluate": ("evaluate", "{run}"),
    "export": ("export", "{run}"),
    "page": ("export", "{run}", "--format", "web"),
    "render": ("render", "{run}"),
    "gallery": ("render", "{run}", "--gallery"),
    "play": ("play", "{run}"),
    "replay": ("replay", "{run}/nan_dumps/0.npz"),
    "resume": ("train", "--resume", "{run}"),
}


def type_(capfd, command, run, *more):
    """Types a command; returns its exit code and the lines on standard error."""
    name, *words = COMMANDS[command]
    module = importlib.import_module(f"jetbot_mjx.{name}")
    words = [*(word.format(run=run) for word in words), *more]
    with pytest.raises(SystemExit) as caught:
        cli.run_command(lambda _: module.main(words))
    # Work that ended before the error is told with its seconds.
    err = re.sub(r"^ *\d+\.\d s  .*\n", "", capfd.readouterr().err, flags=re.MULTILINE)
    return caught.value.code, err.splitlines()


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: attack.__name__)
def test_no_command_runs_code_of_a_strangers_run(attack, command, run, canary, capfd):
    attack(run, canary)
    before = sorted(run.rglob("*")), list(sys.path)
    code, lines = type_(capfd, command, run)
    assert not canary.exists()
    assert (code, len(lines)) == (2, 1), lines
    # What would run, where to read it, and the flag.
    named = "robot.drive = 'evil.py:controls'" if attack is a_drive else ":"
    assert named in lines[0]
    assert "would run, which no training of yours on this machine has run: read " in lines[0]
    assert lines[0].endswith(", then add --trust (in Python: trust=True)")
    assert (sorted(run.rglob("*")), list(sys.path)) == before


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: attack.__name__)
def test_each_attack_would_run_where_the_user_asks_for_it(attack, run, canary):
    attack(run, canary)
    with trusting(True), pytest.raises(Exception):  # noqa: B017
        load_checkpoint(run).make_env()
    assert canary.exists()
    canary.unlink()
    # Not a moment longer.
    with pytest.raises(UserError, match="add --trust"):
        load_checkpoint(run).make_env()
    assert not canary.exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_trust_is_an_option_of_each_command(command, run, canary, capfd):
    a_stored_task(run, canary)
    code, lines = type_(capfd, command, run, "--trust")
    assert canary.exists()
    assert code == 2
    assert "has no 'Task'" in lines[-1]


@pytest.fixture
def share(monkeypatch):
    """Makes a folder the content of a stranger's repository on the Hub, and deletes it here."""
    pytest.importorskip("huggingface_hub")
    with fake_hub.serving() as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)

        def share(run):
            files = {x.relative_to(run).as_posix(): x for x in run.rglob("*") if x.is_file()}
            server.commit("eve/run", {name: path.read_bytes() for name, path in files.items()})
            os.chdir(run.parent)
            shutil.rmtree(run)

        yield share


@pytest.mark.slow
@pytest.mark.parametrize(
    ("attack", "command"),
    [
        # Its file is none of those that are downloaded.
        *((attack, "evaluate") for attack in ATTACKS if attack is not a_file_in_the_run),
        *((a_stored_task, name) for name in COMMANDS if name not in ("evaluate", "replay")),
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_no_command_runs_code_of_a_run_on_the_hub(attack, command, run, share, canary, capfd):
    attack(run, canary)
    share(run)
    before = list(sys.path)
    code, (told, line) = type_(capfd, command, "hf:eve/run")
    assert not canary.exists()
    assert code == 2
    assert told.startswith("hf:eve/run: revision ")
    assert "would run, which no training of yours on this machine has run: read " in line
    assert line.endswith(", then add --trust (in Python: trust=True)")
    assert sys.path == before


def test_code_of_a_run_on_the_hub_runs_where_the_user_asks_for_it(run, share, canary, capfd):
    a_stored_task(run, canary)
    share(run)
    code, lines = type_(capfd, "evaluate", "hf:eve/run", "--trust")
    assert canary.exists()
    assert code == 2
    assert "has no 'Task'" in lines[-1]


@pytest.mark.parametrize(
    "call",
    [
        lambda run, **trust: jetbot_mjx.evaluate(run, **trust),
        lambda run, **trust: jetbot_mjx.evaluate([run], **trust),
        lambda run, **trust: jetbot_mjx.render(run, **trust),
        lambda run, **trust: jetbot_mjx.train(resume=run, **trust),
    ],
    ids=["evaluate", "compare", "render", "train"],
)
def test_trust_is_an_argument_of_each_function(call, run, canary):
    a_stored_task(run, canary)
    with pytest.raises(UserError, match="add --trust"):
        call(run)
    assert not canary.exists()
    with pytest.raises(UserError, match="has no 'Task'"):
        call(run, trust=True)
    assert canary.exists()


def test_what_needs_no_code_runs_none_and_needs_no_flag(run, canary, capfd):
    a_stored_task(run, canary)
    policy = jetbot_mjx.load_policy(run)
    assert policy(np.zeros(16)).shape == (2,)
    with pytest.raises(SystemExit, match="0"):
        cli.run_command(lambda _: importlib.import_module("jetbot_mjx.list_runs").main(["."]))
    assert "evil:Task" in capfd.readouterr().out
    assert find_run_config_of_another(run) == "evil:Task"
    assert not canary.exists()


def find_run_config_of_another(run):
    """What a training reads of the run that it begins with."""
    config = parse_config({"init_from": str(run), "ppo": SMALL})
    return load_checkpoint(config.init_from).config.task.name


def own(run):
    """Source that this user has trained in, stored in a run; returns its configuration."""
    text = "try:\n    import helper\nexcept ImportError:\n    helper = None\nclass Task: pass\n"
    code = store(run, {"own.py": text.encode()})
    task(run, "own:Task")
    config = load_checkpoint(run).config
    record_code(run, config, code)
    return config


def test_code_that_this_user_has_trained_in_runs(run, home):
    config = own(run)
    assert trusted_class(run, config).__name__ == "Task"
    (record,) = home.iterdir()
    assert record.read_bytes() == b""
    assert home.stat().st_mode & 0o777 == 0o700
    # Once more changes nothing.
    record_code(run, config, None)
    assert [*home.iterdir()] == [record]


def test_other_options_of_ones_own_class_are_another_run(run):
    own(run)
    config = load_checkpoint(run).config
    changed = config.model_copy(
        update={"task": config.task.model_copy(update={"options": {"bonus": 0.7}})}
    )
    with pytest.raises(ConfigError, match=r"holds another run: .*task.options.bonus"):
        find_code(changed, [run])
    # A stranger's code is refused as such.
    store(run, {"own.py": b"class Task: pass\n"})
    with pytest.raises(UserError, match="no training of yours"):
        find_code(config, [run])


def test_other_files_beside_trained_code_are_not_imported(run, canary):
    config = own(run)
    (run / "task" / "helper.py").write_text(payload(canary))
    (run / "task" / "helper").mkdir()
    (run / "task" / "helper" / "__init__.py").write_text(payload(canary))
    # Bytecode that Python would take for that of the source, unchecked.
    evil = run / "evil.py"
    evil.write_text(payload(canary))
    where = importlib.util.cache_from_source(str(run / "task" / "own.py"))
    unchecked = py_compile.PycInvalidationMode.UNCHECKED_HASH
    py_compile.compile(str(evil), where, invalidation_mode=unchecked)
    found = trusted_class(run, config)
    assert found.__name__ == "Task"
    assert not canary.exists()


def test_trained_code_is_not_taken_from_the_current_folder(run, canary, monkeypatch):
    config = own(run)
    # The same source, and what it would import from beside it.
    shutil.copy(run / "task" / "own.py", "own.py")
    Path("helper.py").write_text(payload(canary))
    before = list(sys.path)
    assert trusted_class(run, config).__name__ == "Task"
    assert sys.path == before
    assert not canary.exists()


def test_code_of_the_same_name_in_the_current_folder_is_not_that_of_a_package(
    run, canary, tmp_path, monkeypatch
):
    installed = tmp_path / "installed"
    installed.mkdir()
    (installed / "package.py").write_text("class Task: pass\n")
    monkeypatch.syspath_prepend(installed)
    task(run, "package:Task")
    config = load_checkpoint(run).config
    record_code(run, config, None)
    assert require_trust(run, config) is None
    Path("package.py").write_text(payload(canary))
    with pytest.raises(UserError, match=r"read package\.py, then"):
        load_checkpoint(run).make_env()
    assert not canary.exists()


def test_each_byte_of_the_code_counts(run):
    own(run)
    (run / "task" / "sources.json").unlink()
    store(run, {"own.py": b"class Task: pass\n# Another comment\n"})
    with pytest.raises(UserError, match=r"task\.name = 'own:Task' would run.*read run/task, then"):
        load_checkpoint(run).make_env()


def test_a_drive_that_this_user_has_trained_with_runs(run, canary):
    a_drive(run, canary)
    config = load_checkpoint(run).config
    record_code(run, config, None)
    assert require_trust(run, config) is None
    a_drive(run, canary.with_name("other"))
    with pytest.raises(UserError, match=r"read run/robot/evil\.py, then"):
        require_trust(run, load_checkpoint(run).config)


EXAMPLES = Path(jetbot_mjx.__file__).parents[1] / "examples"


@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        ("hopper:Hopper", True),
        ("hopper:fuse_mjx", False),
        ("hopper:jnp.load", False),
        ("hopper:Path", False),
        ("cartpole:CartPole", False),
    ],
)
def test_the_classes_of_the_examples_need_no_flag(run, name, allowed):
    store(run, {"hopper.py": (EXAMPLES / "hopper.py").read_bytes()})
    environment(run, name)
    config = load_checkpoint(run).config
    if allowed:
        assert require_trust(run, config) is not None
    else:
        shutil.copy(EXAMPLES / "cartpole.py", ".")
        with pytest.raises(UserError, match="add --trust"):
            require_trust(run, config)


@pytest.mark.parametrize("name", sorted(path.name for path in jetbot_mjx.PRETRAINED.iterdir()))
def test_policies_that_come_with_the_package_need_no_flag(name):
    checkpoint = load_checkpoint(f"pretrained:{name}")
    assert require_trust(checkpoint.run_dir, checkpoint.config) is None


def no_home(home, monkeypatch):
    def fail():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setattr(Path, "home", fail)
    return "there is no home folder"


def a_file_in_its_place(home, monkeypatch):
    home.parents[1].mkdir()
    home.parent.write_text("")
    return "(Not a directory|File exists)"


def a_folder_of_all(home, monkeypatch):
    home.mkdir(parents=True)
    home.chmod(0o777)
    return f"others may write to {home}"


@pytest.mark.parametrize("spoil", [no_home, a_file_in_its_place, a_folder_of_all])
def test_where_nothing_can_be_recorded_one_line_says_so(spoil, run, home, monkeypatch, capfd):
    reason = spoil(home, monkeypatch)
    config = own(run)
    (line,) = capfd.readouterr().err.splitlines()
    told = "for other commands on this run, add --trust (in Python: trust=True)"
    assert re.fullmatch(f"not recorded that this code is yours: {reason}: {re.escape(told)}", line)
    with pytest.raises(UserError, match="then add --trust"):
        require_trust(run, config)


def test_records_that_others_can_write_do_not_count(run, home):
    config = own(run)
    home.chmod(0o770)
    with pytest.raises(UserError, match="then add --trust"):
        require_trust(run, config)


def test_a_relative_state_folder_does_not_count(run, home, monkeypatch, tmp_path):
    config = own(run)
    # One that a stranger brings.
    shutil.copytree(home, "state/jetbot_mjx/own_code")
    monkeypatch.setenv("XDG_STATE_HOME", "state")
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(UserError, match="then add --trust"):
        require_trust(run, config)


def test_nothing_is_recorded_of_the_packages_own_task(run, home):
    record_code(run, load_checkpoint(run).config, None)
    assert not home.exists()


LINKED = (
    *(".lock", "train.log", "metrics.jsonl", "evaluations", "videos/000000000000"),
    *("evaluations/000000000000/report.html", "policy", "page.html", "tensorboard"),
    *("checkpoints/.000000000001.unfinished", "nan_dumps/new.npz"),
)


@pytest.mark.parametrize("name", LINKED)
@pytest.mark.parametrize("command", ["export", "evaluate", "resume"])
def test_no_command_writes_through_a_link_out_of_the_run(name, command, run, tmp_path, capfd):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("kept")
    (run / name).parent.mkdir(parents=True, exist_ok=True)
    is_file = "." in name.lstrip("./").rpartition("/")[2] or name == ".lock"
    (run / name).symlink_to(outside / "precious" if is_file else outside)
    code, lines = type_(capfd, command, run)
    assert (code, len(lines)) == (2, 1)
    assert f"run/{name} is a link that leads out of the run folder, to {outside}" in lines[0]
    assert [path.name for path in outside.iterdir()] == ["precious"]
    assert (outside / "precious").read_text() == "kept"


@pytest.mark.parametrize("name", ["evaluations", "seed-3/train.log"])
def test_links_of_all_seeds_are_looked_at(name, run, tmp_path):
    seed = run / "seed-3"
    seed.mkdir()
    check_links(seed)
    (run / name).symlink_to(tmp_path)
    for folder in (run, seed):
        with pytest.raises(UserError, match=f"run/{name} is a link that leads out of the run"):
            check_links(folder)


def test_a_training_into_a_strangers_empty_folder_follows_no_link(tmp_path, monkeypatch):
    precious = tmp_path / "precious"
    precious.write_text("kept")
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / ".lock").symlink_to(precious)
    with pytest.raises(UserError, match=r"\.lock is a link that leads out of the run folder"):
        jetbot_mjx.train("smoke", run_dir=tmp_path / "new")
    assert precious.read_text() == "kept"


def test_links_within_a_run_and_trusted_ones_are_followed(run, tmp_path):
    (run / "videos").mkdir()
    (run / "evaluations").symlink_to("videos")
    (run / "train.log").symlink_to("train.log")
    check_links(run)
    (run / "policy").symlink_to(tmp_path)
    with pytest.raises(UserError, match="policy is a link"):
        check_links(run)
    with trusting(True):
        check_links(run)


@pytest.mark.parametrize("file", ["/etc/m.xml", "../m.xml", "a/m.xml", "/etc/m.yaml"])
def test_a_run_names_no_robot_outside_of_it(run, file, capfd):
    robot = load_checkpoint(run).about["config"]["robot"] | {"file": file}
    damage_about(lambda about: about["config"].update(robot=robot))(
        next((run / "checkpoints").iterdir())
    )
    code, lines = type_(capfd, "evaluate", run)
    assert (code, len(lines)) == (2, 1)
    assert f"robot.file = {file!r}: a run stores no path, but a name" in lines[0]


def test_ranges_are_read_without_the_code_beside_them(run, canary, capfd):
    (run / "beside.py").write_text(payload(canary))
    task(run, "beside:Task")
    before = list(sys.path)
    with pytest.raises(UserError, match="it randomizes nothing"):
        jetbot_mjx.evaluate("pretrained:jetbot_egocentric", ranges=run / "config.yaml")
    assert sys.path == before
    assert not canary.exists()


def test_metadata_of_a_checkpoint_names_no_types_and_no_places(run, canary):
    """Orbax's own reader is not used: what its files say is not believed."""
    (checkpoint,) = (run / "checkpoints").iterdir()
    for name in ("_CHECKPOINT_METADATA", "policy/_METADATA", "policy/_sharding"):
        (checkpoint / name).write_text(
            json.dumps({"item_handlers": "os.system", "value_type": "gs://there", "path": "/"})
        )
    (checkpoint / "policy" / "checkpoint").write_bytes(pickle.dumps(Pickled(canary)))
    load_checkpoint(run)
    assert not canary.exists()


def test_a_dump_that_grows_when_it_is_read_is_refused(run):
    dump = run / "nan_dumps" / "0.npz"
    with np.load(dump) as arrays:
        np.savez_compressed(dump, about=arrays["about"], x=np.zeros(2**27, np.uint8))
    assert dump.stat().st_size < 2**20
    with pytest.raises(UserError, match="holds more than 100 MB"):
        load_nan_dump(dump)


def test_a_dump_with_pickles_is_refused(run, canary):
    dump = run / "nan_dumps" / "0.npz"
    with np.load(dump) as arrays:
        np.savez(dump, about=arrays["about"], x=np.array([Pickled(canary)], object))
    with pytest.raises(UserError, match="is not a NaN dump"):
        load_nan_dump(dump)
    assert not canary.exists()


EXECUTES = re.compile(
    r"\bpickle\.(loads?\(|Unpickler\b)|\bexec\(compile|[^_.\w]eval\(|allow_pickle=True|yaml\.load\("
)

MAY_EXECUTE = {
    # Between the processes of one training; and of files that only this user can have written.
    "jetbot_mjx/training/distributed.py",
    "onekernel/aot/program_cache.py",
    # The text of the package itself, with numbers; and the drive of a robot, checked before.
    "jetbot_mjx/deployment/exporters.py",
    "jetbot_mjx/envs/mjcf_wheels.py",
    # A safe loader.
    "jetbot_mjx/config/yaml_text.py",
}
"""All places in which what a file holds is executed, or could be."""


def test_nothing_else_executes_what_a_file_holds(root):
    found = {
        path.relative_to(root).as_posix()
        for package in ("jetbot_mjx", "onekernel")
        for path in (root / package).rglob("*.py")
        if EXECUTES.search(path.read_text("utf-8"))
    }
    assert found == MAY_EXECUTE


def test_every_array_of_a_file_is_read_without_pickles(root):
    for package in ("jetbot_mjx", "onekernel"):
        for path in (root / package).rglob("*.py"):
            for call in re.findall(r"np\.load\([^\n]*", path.read_text("utf-8")):
                assert "allow_pickle=False" in call, path
