"""Compiled programs that outlive their process: found without tracing, by their own key only."""

import functools
import os
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

import jetbot_mjx
import onekernel
from helpers import gliding
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.envs import program_key, robot_model
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.program_key import open_program_cache
from jetbot_mjx.envs.task import GoalTask, make_task
from jetbot_mjx.runs import Setup, task_code
from jetbot_mjx.runs.checkpoint import PRETRAINED
from jetbot_mjx.runs.task_code import TaskCode, read_task_code, stored_class, write_task_code
from jetbot_mjx.training.ppo_trainer import CompiledTrainer, build_ppo
from onekernel.aot import program_cache
from onekernel.aot.program_cache import ProgramCache

KEY = "all that it depends on"


def double():
    return jax.jit(lambda x: {"twice": 2 * x}).trace(jnp.ones(3))


def never():
    raise AssertionError("traced")


@pytest.fixture
def folder(tmp_path):
    """Where JAX keeps nothing: what it found in its own cache, a CPU could not write again."""
    before = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()  # or what an earlier test had asked for would hold
    yield tmp_path
    jax.config.update("jax_enable_compilation_cache", before)
    compilation_cache.reset_cache()


@pytest.fixture
def kept(folder):
    """The only file in the folder."""
    ProgramCache({}, folder, KEY).compile("double", double)
    (path,) = folder.glob("program-*")
    return path


def twice(program):
    return program(jnp.arange(3.0))["twice"].tolist()


def test_a_program_is_found_without_being_traced(kept):
    program = ProgramCache({}, kept.parent, KEY).compile("double", never)
    assert twice(program) == [0.0, 2.0, 4.0]
    assert program.out_info["twice"].shape == (3,)


def test_a_program_that_was_fetched_ahead_is_that_program(kept):
    ahead = ProgramCache({}, kept.parent, KEY)
    ahead.prefetch("double", "another")
    assert ahead.find("another") is None
    assert twice(ahead.compile("double", never)) == [0.0, 2.0, 4.0]


def test_what_fails_its_check_is_traced_again_and_only_that_is_kept(folder):
    factors = iter([3, 2])

    def trace():
        factor = next(factors)
        return jax.jit(lambda x: {"twice": factor * x}).trace(jnp.ones(3))

    cache = ProgramCache({}, folder, KEY)
    assert twice(cache.compile("double", trace, lambda: trace)) == [0.0, 2.0, 4.0]
    assert twice(ProgramCache({}, folder, KEY).compile("double", never)) == [0.0, 2.0, 4.0]


@pytest.mark.parametrize("usable", [True, False])
def test_what_does_not_compile_is_traced_again_if_it_fails_its_check(folder, monkeypatch, usable):
    cache = ProgramCache({}, folder, KEY)
    compile_, attempts = cache._compile, []

    def compile_at_second(*arguments, **options):
        attempts.append(0)
        if len(attempts) == 1:
            raise jax.errors.JaxRuntimeError("unknown target")
        return compile_(*arguments, **options)

    monkeypatch.setattr(cache, "_compile", compile_at_second)
    if usable:
        with pytest.raises(jax.errors.JaxRuntimeError, match="unknown target"):
            cache.compile("double", double)
    else:
        assert twice(cache.compile("double", double, lambda: double)) == [0.0, 2.0, 4.0]


def test_a_check_that_fails_with_an_error_keeps_nothing(folder):
    def check():
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        ProgramCache({}, folder, KEY).compile("double", double, check)
    assert not list(folder.glob("program-*"))


def test_a_program_compiles_while_the_next_one_is_traced(folder, monkeypatch):
    cache, traced = ProgramCache({}, folder, KEY), threading.Event()
    compile_ = cache._compile

    def compile_late(*arguments, **options):
        assert traced.wait(60)
        return compile_(*arguments, **options)

    monkeypatch.setattr(cache, "_compile", compile_late)
    program = cache.compile_later("double", double)
    double()
    traced.set()
    assert twice(program()) == [0.0, 2.0, 4.0]
    assert twice(ProgramCache({}, folder, KEY).compile_later("double", never)()) == [0.0, 2.0, 4.0]


def test_two_threads_trace_one_after_the_other(folder):
    cache, inside, most = ProgramCache({}, folder, KEY), [], []

    def trace():
        inside.append(0)
        most.append(len(inside))
        time.sleep(0.05)
        inside.pop()
        return double()

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda name: cache.compile(name, trace), "abc"))
    assert most == [1, 1, 1]


@pytest.mark.parametrize(
    ("options", "key", "name"),
    [
        ({}, "something else", "double"),
        ({}, KEY, "another"),
        ({"xla_backend_optimization_level": 1}, KEY, "double"),
    ],
)
def test_another_program_is_not_taken_for_it(kept, options, key, name):
    assert ProgramCache(options, kept.parent, key).find(name) is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[: len(content) // 2],
        lambda content: b"",
        lambda content: content[:-1] + bytes([content[-1] ^ 1]),
        lambda content: b"\0" * len(content),
    ],
)
def test_a_damaged_file_is_compiled_again_and_replaced(kept, damage):
    whole = kept.read_bytes()
    kept.write_bytes(damage(whole))
    again = ProgramCache({}, kept.parent, KEY)
    assert again.find("double") is None
    assert twice(again.compile("double", double)) == [0.0, 2.0, 4.0]
    assert twice(again.compile("double", never)) == [0.0, 2.0, 4.0]


def test_a_program_that_the_device_cannot_load_is_compiled_again(kept, monkeypatch):
    def refuse(*kept, **devices):
        raise jax.errors.JaxRuntimeError("INVALID_ARGUMENT: another driver")

    monkeypatch.setattr(program_cache.serialize_executable, "deserialize_and_load", refuse)
    again = ProgramCache({}, kept.parent, KEY)
    assert again.find("double") is None
    assert twice(again.compile("double", double)) == [0.0, 2.0, 4.0]


def test_a_folder_that_cannot_be_written_costs_nothing_but_time(folder):
    nowhere = ProgramCache({}, folder / "missing", KEY)
    assert twice(nowhere.compile("double", double)) == [0.0, 2.0, 4.0]
    assert not list(folder.iterdir())


PAIR = """
from typing import NamedTuple, Any

class Pair(NamedTuple):
    one: Any
    other: Any
"""


def pair_of_a_module_that_cannot_be_imported():
    space: dict[str, Any] = {"__name__": "nowhere_to_be_found"}
    exec(PAIR, space)
    return space["Pair"]


def paired(pair):
    return lambda: jax.jit(lambda x: pair(x, 2 * x)).trace(jnp.ones(3))


def test_a_program_has_the_classes_of_the_process_that_loads_it(folder):
    first, second = (pair_of_a_module_that_cannot_be_imported() for _ in range(2))
    ProgramCache({}, folder, KEY, nodes=[first]).compile("paired", paired(first))
    program = ProgramCache({}, folder, KEY, nodes=[second]).compile("paired", never)
    result = program(jnp.ones(3))
    assert type(result) is second
    assert result.other.tolist() == [2, 2, 2]


def test_a_class_that_cannot_be_imported_costs_a_line_and_no_training(folder, monkeypatch):
    pair = pair_of_a_module_that_cannot_be_imported()
    cache = ProgramCache({}, folder, KEY)
    with pytest.warns(UserWarning, match="cannot be kept.*nowhere_to_be_found"):
        program = cache.compile("paired", paired(pair))
    assert program(jnp.ones(3)).other.tolist() == [2, 2, 2]
    assert not list(folder.glob("program-*"))
    # A file that another process wrote, which finds the module.
    module = ModuleType("nowhere_to_be_found")
    module.__dict__["Pair"] = pair
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, module.__name__, module)
        cache.compile("paired", paired(pair))
    again = ProgramCache({}, folder, KEY)
    for find in (again.find, lambda name: again.prefetch(name) or again.find(name)):
        with pytest.warns(UserWarning, match="cannot be read.*nowhere_to_be_found"):
            assert find("paired") is None


def test_without_a_folder_nothing_is_kept(folder):
    assert twice(ProgramCache({}).compile("double", double)) == [0.0, 2.0, 4.0]
    assert ProgramCache({}).find("double") is None


@pytest.fixture
def jax_cache(folder, tmp_path_factory):
    """JAX's own cache, which takes every program."""
    path = tmp_path_factory.mktemp("jax")
    settings = {
        "jax_compilation_cache_dir": str(path),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_enable_compilation_cache": True,
    }
    before = {name: jax.config.values[name] for name in settings}
    for name, value in settings.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    yield path
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.slow
def test_what_a_cpu_finds_in_jax_s_cache_is_compiled_once_more_and_written(jax_cache, folder):
    for name in ("one", "another", "third"):
        jax.clear_caches()
        ProgramCache({}, folder, name).compile("double", double)
    assert [path for path in jax_cache.iterdir() if "jit__lambda" in path.name]
    assert len(list(folder.glob("program-*"))) == 3
    for name in ("one", "another", "third"):
        found = ProgramCache({}, folder, name).find("double")
        assert found is not None
        assert twice(found) == [0, 2, 4]


@pytest.mark.slow
def test_what_this_process_has_found_there_before_is_compiled_once_more(jax_cache, folder):
    tripled = jax.jit(lambda x: 3 * jnp.sin(x).at[1].set(x.sum()))

    def trace():
        return tripled.trace(np.float32([0, 1, 2]))

    ProgramCache({}).compile("one", trace)
    jax.clear_caches()
    # JAX finds it in its cache, and then it is in memory.
    for kept in (None, folder):
        ProgramCache({}, kept, KEY).compile("one", trace)
    found = ProgramCache({}, folder, KEY).find("one")
    assert found is not None
    assert found(np.float32([0, 1, 2]))[1] == 9.0


@pytest.mark.slow
def test_what_a_cpu_still_finds_there_is_not_written(jax_cache, folder, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(program_cache, "unseen_options", dict)
    for name in ("one", "another"):
        jax.clear_caches()
        ProgramCache({}, folder, name).compile("double", double)
    assert len(list(folder.glob("program-*"))) == 1


def test_what_nobody_used_for_long_makes_room(kept):
    old = kept.parent / "program-of-last-year"
    old.touch()
    os.utime(old, (0, time.time() - 31 * 86_400))
    ProgramCache({}, kept.parent, KEY).compile("another", double)
    assert not old.exists()
    assert kept.exists()


# By configuration.


@pytest.fixture
def paths(tmp_path, own_tasks, monkeypatch):
    """Where a configuration's program would lie; None where it would not be kept."""
    monkeypatch.setattr(program_key, "BUILT_IN_TASKS", own_tasks)
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))

    def paths(settings):
        found = open_program_cache(parse_config(settings))
        return found._path("advance") if found._folder else None

    yield paths
    jax.config.update("jax_compilation_cache_dir", before)


def test_a_configuration_finds_its_own_programs_whatever_its_seed(paths):
    assert paths({}) == paths({}) == paths({"seed": 7})
    others = [{"seeds": 2}, {"ppo": {"unroll_length": 8}}, {"robot": {"preset": "real"}}]
    others += [{"ppo": {"num_timesteps": 9_000_000}}, {"task": {"episode_length": 9}}]
    others += [{"physics": {"iterations": 3}}, {"evaluation": {"episodes": 7}}]
    assert len({paths({}), *map(paths, others)}) == 8


@pytest.mark.parametrize(
    "setting",
    [
        {"stop_at_success": 0.5},
        {"checkpoint_interval": 65_536},
        {"checkpoints_to_keep": 7},
        {"preemption_notice": 99.0},
        {"tensorboard": False},
        {"init_from": "runs/one"},
        {"wandb": "mine"},
    ],
    ids=lambda setting: next(iter(setting)),
)
def test_what_a_training_reads_and_writes_and_when_it_ends_changes_no_program(paths, setting):
    assert parse_config(setting) != parse_config({})
    assert paths(setting) == paths({})


def test_other_flags_of_xla_are_another_program(paths, monkeypatch):
    before = paths({})
    monkeypatch.setenv("XLA_FLAGS", "--xla_something")
    assert paths({}) != before


def test_changed_source_is_another_program(paths, monkeypatch):
    before = paths({})
    monkeypatch.setattr(program_key, "_own_source", lambda *roots: "changed")
    assert paths({}) != before


def test_another_model_is_another_program(paths, monkeypatch):
    before = paths({})
    make = robot_model.make_mj_model

    def with_another_solver(*arguments, **options):
        made = make(*arguments, **options)
        made.opt.iterations += 1
        return made

    monkeypatch.setattr(robot_model, "make_mj_model", with_another_solver)
    assert paths({}) != before


@pytest.mark.parametrize(
    "name",
    ["someone.module:Task", "jetbot_mjx_tasks:GoalTask", "jetbot_mjx.mine:Task", "jetbot_mjx:Mine"],
)
def test_a_task_of_someone_else_is_always_traced(paths, name):
    assert paths({"task": {"name": name}}) is None


CHASE = """
from dataclasses import dataclass, field
from typing import Any
from jax.tree_util import register_dataclass
from jetbot_mjx.envs.task import GoalTask

@register_dataclass
@dataclass
class Chased:
    goal_w: Any
    animal: str = field(default="hare", metadata={"static": True})

class Chase(GoalTask):
    def sample(self, key):
        return Chased(super().sample(key))

    def goal_position(self, goal):
        return goal.goal_w
"""


@pytest.fixture
def chasing(tmp_path, monkeypatch):
    """The environment of a task whose source a run has stored, under one name."""

    def chasing(source, name):
        run = tmp_path / name
        run.mkdir()
        write_task_code(run, TaskCode("chase", (("chase.py", source.encode()),)))
        monkeypatch.setattr(task_code, "_modules", {})  # as in another process
        config = parse_config({"task": {"name": "chase:Chase"}})
        code = read_task_code(run)
        assert code is not None
        own_class = stored_class(run, config.code, code, silent=True)
        return make_env(config, own_class=own_class)

    return chasing


def test_a_stored_task_finds_its_programs_and_no_other_task_of_its_name_does(
    paths, chasing, folder
):
    farther = CHASE.replace("super().sample(key)", "2 * super().sample(key)")
    # Nothing computes with these: only the structure of the goal tells of them.
    others = CHASE.replace("hare", "fox"), CHASE.replace("Chased", "Hunted")
    sources = [CHASE, CHASE, farther, *others]
    envs = [chasing(source, f"run-{number}") for number, source in enumerate(sources)]
    caches = [open_program_cache(env.config, own=env) for env in envs]
    key = jax.random.PRNGKey(0)
    for env, cache in zip(envs, caches, strict=True):
        found = cache.find("sample")
        assert (found is not None) == (env is envs[1])
        program = cache.compile("sample", functools.partial(jax.jit(env.task.sample).trace, key))
        assert jax.tree.structure(program(key)) == jax.tree.structure(env.task.sample(key))
        assert type(program(key)).__module__ == "chase"
    assert len({cache._path("sample") for cache in caches}) == 4
    assert "chase" not in sys.modules


def test_the_packages_own_tasks_are_named_by_the_package_alone(paths, own_tasks):
    """So that no module's name is in a configuration or in a run."""
    assert {parse_config({}).task.name} == own_tasks
    for name in own_tasks:
        config = parse_config({"task": {"name": name}})
        assert isinstance(make_task(config.task), GoalTask)
        assert paths({"task": {"name": name}}) is not None


def test_programs_are_cached_only_where_there_is_a_folder(paths):
    jax.config.update("jax_compilation_cache_dir", None)
    assert paths({}) is None


def test_the_source_is_all_python_and_all_models():
    """A file that is left out would let an old program be taken for a new one."""
    roots = tuple(Path(package.__file__).parent for package in (jetbot_mjx, onekernel))
    assert roots == program_key._ROOTS
    files = [path for root in roots for path in root.rglob("*") if path.is_file()]
    # Finished runs, and what reports tell beside them, decide nothing.
    suffixes = {path.suffix for path in files if PRETRAINED not in path.parents}
    others = {".gz", ".html", ".js", ".json", ".md", ".mplstyle", ".pyc", ".typed", ".yaml", ""}
    assert suffixes - others <= program_key.SOURCES


@pytest.mark.parametrize(
    "changed",
    [
        *(
            "jetbot_mjx/envs/task.py",
            "jetbot_mjx/envs/__init__.pyi",
            "jetbot_mjx/assets/jetbot.xml",
        ),
        *("onekernel/errors.py", "onekernel/lower/jaxpr.py", "onekernel/lower/__init__.pyi"),
        "onekernel/cpu/xla_call.ll",
    ],
)
def test_a_change_of_either_package_is_another_source(changed, tmp_path):
    copies = []
    for copy in ("before", "after"):
        for root in program_key._ROOTS:
            ignore = shutil.ignore_patterns("__pycache__", "pretrained")
            shutil.copytree(root, tmp_path / copy / root.name, ignore=ignore)
        copies.append([tmp_path / copy / root.name for root in program_key._ROOTS])
    hashed = program_key._own_source.__wrapped__
    assert hashed(*copies[0]) == hashed(*copies[1])
    with (tmp_path / "after" / changed).open("a") as file:
        file.write("\n")
    assert hashed(*copies[0]) != hashed(*copies[1])


def test_the_source_of_both_packages_is_in_the_key(paths, monkeypatch):
    before = paths({})
    for roots in ([program_key._ROOTS[0]], [program_key._ROOTS[1]]):
        monkeypatch.setattr(program_key, "_ROOTS", roots)
        assert paths({}) != before


# A training.

TINY = {
    "seed": 3,
    "task": {"observation": "egocentric", "episode_length": 16},
    "ppo": {"num_envs": 4, "unroll_length": 4, "batch_size": 4, "num_minibatches": 1},
}


def test_a_training_from_kept_programs_is_the_same_to_the_bit(root, folder, monkeypatch):
    config = load_config(root / "configs" / "smoke.yaml")
    config = parse_config({**config.model_dump(mode="json"), **TINY})
    with gliding.everywhere():
        env = gliding.Gliding(config)

        def trained():
            program = CompiledTrainer(
                build_ppo(Setup(config, env=env)), [0], ProgramCache({}, folder, KEY)
            )
            state, _ = program.compile()(program.init(), 2, False)
            return program.template(), program.get(state)[0]

        shapes, first = trained()
        monkeypatch.setattr(CompiledTrainer, "trace", never)
        monkeypatch.setattr(CompiledTrainer, "_init", never)
        again, second = trained()
    assert jax.tree.structure(shapes) == jax.tree.structure(again)
    assert jax.tree.leaves(shapes) == jax.tree.leaves(again)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_a_second_process_traces_nothing_and_trains_to_the_same_bits(root, tmp_path):
    cache = tmp_path / "cache"
    cache.mkdir()
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_LOG_COMPILES": "1"}

    def trained(seed):
        arguments = ["--config", "configs/smoke.yaml", "--seed", str(seed)]
        for setting in (
            "ppo.num_timesteps=64",
            "ppo.num_envs=4",
            "ppo.unroll_length=4",
            "ppo.batch_size=4",
            "ppo.num_minibatches=1",
            "evaluation.episodes=2",
            "task.episode_length=8",
            "checkpoint_interval=64",
        ):
            arguments += ["--set", setting]
        arguments += ["--run-dir", str(tmp_path / f"run-{time.monotonic_ns()}")]
        done = subprocess.run(
            [sys.executable, "-m", "jetbot_mjx.train", *arguments],
            cwd=root,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        (said,) = [line for line in done.stdout.splitlines() if "sha256" in line]
        return said.partition("sha256 ")[2], "Finished tracing advance" in done.stderr

    first, traced = trained(0)
    assert traced
    again, traced = trained(0)
    assert not traced
    assert again == first
    other, traced = trained(1)
    assert not traced
    assert other != first


def test_a_program_for_one_of_several_devices_is_kept_for_that_one(tmp_path):
    code = f"""
import sys
import jax, jax.numpy as jnp
from pathlib import Path
from onekernel.aot.program_cache import ProgramCache
step = jax.jit(lambda x: 3 * x + 1)
found = ProgramCache({{}}, Path({str(tmp_path)!r}), "key")
kept = found.find("it") is not None
program = found.compile("it", lambda: step.trace(jnp.ones(4)))
print(jax.device_count(), kept, float(program(jnp.ones(4)).sum()))
"""
    flags = "--xla_force_host_platform_device_count=2"
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": flags,
        "JAX_ENABLE_COMPILATION_CACHE": "false",
    }
    for kept in (False, True):
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert done.stdout.split() == ["2", str(kept), "16.0"]
