"""The benchmarks: help texts, comparison with earlier files, kernel counts, tables and plots."""

import argparse
import importlib
import itertools
import json
import os
import re
import runpy
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from benchmarks import RESULTS, ROOT, steps_per_second
from benchmarks.harness import processes, readme_table, results, timing
from benchmarks.harness.measurements import Sizes
from benchmarks.harness.timing import make_row
from benchmarks.learning import randomization, search_floor, seeds, worst_goal
from benchmarks.reliability import regressions, robot_fidelity
from benchmarks.throughput import (
    adapters,
    baselines,
    compare,
    ensembles,
    environments,
    fuse,
    kernels,
    longest_chain,
    one_robot,
    programs,
    randomization_cost,
    rate_plots,
)
from helpers.further import slow_unless
from helpers.gliding import everywhere
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.errors import UserError
from onekernel import cpu, gpu

SMALL = Sizes(repeats=2, unroll=4, training_steps=1)

COMMANDS = sorted(
    path.relative_to(ROOT)
    for path in (ROOT / "benchmarks").rglob("*.py")
    if "def main(" in path.read_text("utf-8")
)


@pytest.mark.parametrize("path", COMMANDS, ids=str)
def test_help_is_complete_and_names_the_command(capsys, path):
    module = importlib.import_module(".".join(path.with_suffix("").parts))
    assert f"python {path.as_posix()}" in module.__doc__
    with pytest.raises(SystemExit) as caught:
        module.main(["--help"])
    out, err = capsys.readouterr()
    assert (caught.value.code, err) == (0, "")
    assert "option_strings" not in out  # a lone percent sign is expanded to this


@pytest.mark.parametrize("path", COMMANDS, ids=str)
def test_a_command_starts_from_any_folder(path, tmp_path, monkeypatch):
    # As Python does for a script: its own folder is first on the path, the repository is not on it.
    elsewhere = [entry for entry in sys.path if Path(entry or ".").resolve() != ROOT]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str((ROOT / path).parent), *elsewhere])
    for name in [name for name in sys.modules if name.partition(".")[0] == "benchmarks"]:
        monkeypatch.delitem(sys.modules, name)
    assert callable(runpy.run_path(str(ROOT / path), run_name="script")["main"])


def rate(name, num_envs, steps_per_second):
    return make_row(name, 2, num_envs, 1.0, [steps_per_second], 64)


@pytest.fixture
def measured(world_config):
    return results.conditions(world_config, SMALL)


@pytest.fixture
def old(measured, tmp_path):
    """An earlier file of the same conditions, to be changed by a test."""

    def save(**changed):
        rows = [rate("physics", 64, 1000.0)._asdict(), rate("env", 64, 800.0)._asdict()]
        path = tmp_path / "old.json"
        path.write_text(json.dumps({**measured, "results": rows, **changed}))
        return path

    return save


@pytest.mark.parametrize(("now", "slower"), [(951.0, False), (949.0, True), (2000.0, False)])
def test_a_rate_that_lost_more_than_five_percent_is_slower(old, measured, now, slower):
    baseline = regressions.read_baseline(old(), measured)
    (change,) = regressions.changes([rate("physics", 64, now), rate("physics", 8, 1.0)], baseline)
    assert (change.rate, change.num_envs, change.before, change.after) == ("physics", 64, 1e3, now)
    assert change.is_slower is slower


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"device": "another"}, f"device = another, this is {jax.devices()[0].device_kind}:"),
        ({"config": {}}, "seed = None, this is 0"),
        ({"conditions": {}}, "unroll = None, this is 4"),
        ({"results": [{"rate": "physics"}]}, "contains no rates"),
    ],
)
def test_an_incomparable_file_is_refused_in_one_line(old, measured, changed, said):
    with pytest.raises(UserError, match=re.escape(said)) as refused:
        regressions.read_baseline(old(**changed), measured)
    assert "\n" not in str(refused.value)


def test_a_configuration_that_differs_is_named(old, measured, world_config):
    config = parse_config({"physics": {"ls_iterations": 7}}).model_dump(mode="json")
    said = rf"physics\.ls_iterations = 7, this is {world_config.physics.ls_iterations}:"
    with pytest.raises(UserError, match=said):
        regressions.read_baseline(old(config=config), measured)


def test_a_slower_rate_ends_in_one_and_a_figure_lies_beside_the_file(monkeypatch, tmp_path, capsys):
    def measure(now):
        def physics(config, num_envs, sizes):
            return rate("physics", num_envs, now * num_envs)

        monkeypatch.setitem(steps_per_second.MEASUREMENTS, "physics", physics)
        skipped = [f"--skip={name}" for name in steps_per_second.MEASUREMENTS if name != "physics"]
        output = tmp_path / f"{now}.json"
        compared = ["--compare", str(tmp_path / "1000.json")] if now != 1000 else []
        arguments = ["--num-envs", "8,64", "--output", str(output), *skipped, *compared]
        return steps_per_second.main(arguments)

    assert measure(1000) == 0
    assert measure(990) == 0
    assert measure(900) == 1
    assert capsys.readouterr().out.count("-10.0%, SLOWER") == 2
    image = tmp_path / "900.png"
    drawn = image.read_bytes()
    image.unlink()
    assert rate_plots.main([str(tmp_path / "900.json")]) == 0
    assert image.read_bytes() == drawn


def test_a_figure_shows_what_a_device_tells_of_its_memory():
    values = json.loads((RESULTS / "nvidia-h200-sweep.json").read_text())
    _, _, memory = rate_plots.plot_rates(values).axes
    (line,) = memory.lines
    largest = max(row["num_envs"] for row in values["results"])
    peak = max(row["peak_device_bytes"] for row in values["results"])
    assert (line.get_xdata()[-1], line.get_ydata()[-1] * 2**30) == (largest, peak)


def test_a_figure_has_a_line_for_every_rate():
    values = json.loads((RESULTS / "nvidia-h200.json").read_text())
    # A CPU does not tell of its memory.
    values["results"] = [{**row, "peak_device_bytes": None} for row in values["results"]]
    steps, times = rate_plots.plot_rates(values).axes
    found = list(dict.fromkeys(row["rate"] for row in values["results"]))
    assert [line.get_label() for line in steps.lines] == found
    assert len(times.lines) == len(found)
    assert {axes.get_xscale() for axes in (steps, times)} == {"log"}
    for line, name in zip(steps.lines, found, strict=True):
        rows = [row for row in values["results"] if row["rate"] == name]
        np.testing.assert_array_equal(
            line.get_ydata(),
            [row["env_steps_per_second"] for row in sorted(rows, key=lambda x: x["num_envs"])],
        )


def test_the_tables_in_the_documentation_are_up_to_date():
    measured = readme_table.read_results(RESULTS)
    for name in readme_table.BLOCKS:
        text = (ROOT / name).read_text(encoding="utf-8")
        assert readme_table.with_tables(text, name, measured) == text, (
            "run python benchmarks/harness/readme_table.py"
        )


def test_the_table_of_seeds_holds_the_median_and_the_worst():
    def one(success, gap, above_bound):
        return {
            "success_rate": success,
            "fresh_success_rate": success,
            "above_best_known": gap,
            "above_bound": above_bound,
        }

    other = {"training_seconds": 9.0, "best_in_mujoco": {"success_rate": 0.99}}
    known = {"seeds": [one(1.0, 0.01, 0.1), one(0.9, 0.03, 0.3), one(1.0, 0.02, 0.2)], **other}
    unknown = {"seeds": [one(1.0, "no search was made", "none")], **other}
    rows = seeds.table({"known": known, "unknown": unknown}).splitlines()[2:]
    assert rows == [
        "| known | 3 | 9 s | 100.00% (90.00%) | 100.000% (90.000%) | +2.00% (+3.00%)"
        " | +20.0% (+30.0%) | 99.00% |",
        "| unknown | 1 | 9 s | 100.00% (100.00%) | 100.000% (100.000%) | - | - | 99.00% |",
    ]


def test_the_variants_of_a_benchmark_are_valid_settings(tmp_path):
    variants = seeds.variants_of(ROOT / "benchmarks/learning/best_variants.yaml")
    for base, changed in itertools.product(("best", "best_egocentric"), variants.values()):
        load_config(base, changed)
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("name: 3\n")
    with pytest.raises(UserError, match="should hold a mapping of changed settings"):
        seeds.variants_of(wrong)


def test_a_search_costs_the_longer_turn_to_half_of_the_goals_out_of_view():
    # Ahead, and at 90° and 150° of which either side is one of the two.
    goals = np.array([[1.0, 0.0], [0.0, -1.0], [-np.sqrt(3.0), 1.0]])
    seconds = np.array([1.0, 1.0, 2.0])
    found = search_floor.search_floor(goals, seconds, np.pi / 4, np.pi)
    # The longer turns are 180° and 60° more, at 180°/s.
    np.testing.assert_allclose(found, (2 / 3, (1 + 1 / 3) / 2, 0.5 * (1 + 1 / 3) / 4), rtol=1e-6)
    assert search_floor.search_floor(goals[:1], seconds[:1], np.pi / 4, np.pi) == (0.0, 0.0, 0.0)


def test_the_view_to_each_side_follows_from_the_shape_of_the_image():
    camera = parse_config({"camera": {"fovy": 90.0, "width": 64, "height": 32}}).camera
    assert search_floor.half_view(camera) == pytest.approx(np.arctan(2.0))
    lens = parse_config({"camera": {"lens": "fisheye"}}).camera
    with pytest.raises(UserError, match="lens = fisheye: the estimate is for a pinhole"):
        search_floor.half_view(lens)


def test_the_search_from_the_shipped_camera_costs_what_the_page_says(capsys):
    assert search_floor.main([]) == 0
    printed = capsys.readouterr().out
    page = (ROOT / "docs/best.md").read_text()
    for figure in re.findall(r"[+]?[\d.]+ ?[%s]", printed):
        assert figure.lstrip("+").replace("%", " %") in page
    with pytest.raises(UserError, match="no best-known times for these settings"):
        search_floor.main(["--config", "camera_real"])


def test_the_worst_goal_is_the_nearest_one_missed_or_else_the_slowest():
    places = np.array([[1.0, 0.0], [0.0, -0.5], [0.3, 0.3], [-0.4, 0.0]])
    steps, least = np.array([80.0, 60.0, 256.0, 90.0]), np.array([70.0, 40.0, 30.0, 50.0])
    reached = np.array([True, True, False, False])
    missed = worst_goal.Goals(places, reached, steps, least)
    assert missed.worst == 3
    found = worst_goal.as_json(missed, 0.01)
    assert found["missed"] == 2
    assert found["missed_goals"] == [[0.3, 0.3], [-0.4, 0.0]]
    assert "2 of 4 goals missed; the worst lies 0.40 m away at 180°, and is missed" in (
        worst_goal.describe(found)
    )
    slow = worst_goal.Goals(places, np.ones(4, bool), steps, least)
    assert slow.worst == 2
    assert worst_goal.as_json(slow, 0.01)["worst"] == {
        "goal": [0.3, 0.3],
        "distance": 0.424,
        "bearing": 45.0,
        "reached": True,
        "seconds": 2.56,
        "bound": 0.3,
    }
    ways = [np.zeros((3, 2))] * 2
    figure = worst_goal.plot(["one", "other"], [missed, slow], ways)
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels == ["2 missed", "drive to the worst"]


def test_the_table_holds_the_median_time_and_the_worst_success_of_all_seeds():
    values = json.loads((RESULTS / "gpu-egocentric-brax.json").read_text())
    runs = [{**values["runs"][0], "start": "warm"} for _ in range(3)]
    for run, seconds, success in zip(runs, (50.0, 70.0, 300.0), (0.5, 1.0, 0.9), strict=True):
        run |= {"process_seconds": seconds, "policy": {"success_rate": success}}
    runs[2]["target_reached_seconds"] = None
    row = readme_table.success_table({"one.json": {**values, "runs": runs}}).splitlines()[-1]
    assert row == (
        "| 1 NVIDIA H200, warm cache | `egocentric` | `gpu.yaml` | brax | 3 | 50.00% | 70 s | - |"
        " not by all |"
    )


def test_the_summary_has_a_range_over_hosts():
    values = json.loads((RESULTS / "gpu-egocentric.json").read_text())
    slower = [{**run, "target_reached_seconds": 4.8} for run in values["runs"]]
    hosts = {"a.json": values, "b.json": {**values, "runs": slower}}
    (row,) = readme_table.summary_table(hosts).splitlines()[2:]
    assert row == "| 1 NVIDIA H100 80GB HBM3 | `egocentric` | 100.00% | 8 | 2 | 2.5 s to 4.8 s |"
    slower[1]["target_reached_seconds"] = None
    (row,) = readme_table.summary_table(hosts).splitlines()[2:]
    assert row.endswith("| 2 | not by all |")


HLO = """\
HloModule jit_f

%fused (p: f32[4]) -> f32[4] {
  %p = f32[4]{0} parameter(0)
  ROOT %a = f32[4]{0} add(%p, %p)
}

%turn (t: (s32[], f32[4])) -> (s32[], f32[4]) {
  %t = (s32[], /*index=1*/f32[4]{0}) parameter(0)
  %x = f32[4]{0} get-tuple-element(%t), index=1
  %once = f32[4]{0} fusion(%x), kind=kLoop, calls=%fused
  %twice = f32[4]{0} fusion(%once), kind=kLoop, calls=%fused
  ROOT %r = (s32[], f32[4]{0}) tuple(%twice)
}

%going (t: (s32[], f32[4])) -> pred[] {
  %t = (s32[], f32[4]{0}) parameter(0)
  ROOT %less = pred[] compare(%t, %t), direction=LT
}

ENTRY %main (x: f32[4]) -> f32[4] {
  %x = f32[4]{0} parameter(0)
  %c = f32[4]{0} copy(%x)
  %w = (s32[], /*index=1*/f32[4]{0}) while(%c), condition=%going, body=%turn, LOOP
  ROOT %out = f32[4]{0} custom-call(%w), custom_call_target="ptx"
}
"""


@pytest.mark.parametrize(
    ("loop", "launches", "unknown"),
    [('backend_config={"known_trip_count":{"n":"5"}}', 2 + 3 * 5, 0), ("", 2 + 3, 1)],
)
def test_what_loops_do_is_counted_once_as_kernels_and_every_turn_as_launches(
    loop, launches, unknown
):
    count = kernels.count_kernels(HLO.replace("LOOP", loop))
    assert count.kernels == {"fusion": 2, "copy": 1, "custom-call": 1, "compare": 1}
    assert (count.launches, count.unknown_loops) == (launches, unknown)


@pytest.mark.slow
def test_physics_stays_within_its_number_of_kernels():
    config = parse_config({"ppo": {"num_envs": 64}, "physics": {"impl": "xla"}})
    count = kernels.count_kernels(kernels.compiled_text(config, "physics"))
    found = sum(count.kernels.values())
    print(f"\n{found} kernels, {count.launches} launches")
    # Some 490 and 1,570 on a CPU, fewer on a GPU; the bounds leave room for another XLA, not for
    # another loop.
    assert 100 < found < 560
    assert count.launches < 1_750


def test_physics_stays_within_its_number_of_operations(world_config):
    # Some 5,800, and 2,800 products.
    scalars = kernels.count_scalars(world_config)
    assert 4_000 < sum(scalars.values()) < 7_000
    assert scalars["mul"] < 3_400


@pytest.mark.skipif(
    (gpu if jax.default_backend() == "gpu" else cpu).obstacle() is not None,
    reason="XLA takes no kernels here",
)
def test_physics_as_a_kernel_is_one_call():
    config = parse_config({"ppo": {"num_envs": 64}})
    count = kernels.count_kernels(kernels.compiled_text(config, "physics"))
    assert count.kernels["custom-call"] == 1
    assert sum(count.kernels.values()) < 10


def test_one_robot_in_c_mujoco_has_the_same_task(world_config, world_env):
    robot, rng, task = one_robot.OneRobot(world_config), np.random.default_rng(0), world_env.task

    def seen():
        physics = world_env.reset(jax.random.PRNGKey(0)).pipeline_state
        qpos, qvel = (jnp.asarray(x, jnp.float32) for x in (robot.data.qpos, robot.data.qvel))
        return robot_state(physics.replace(qpos=qpos, qvel=qvel))

    obs = robot.reset(rng)
    goal = jnp.asarray(robot.goal, jnp.float32)
    state = seen()
    np.testing.assert_allclose(obs, task.observe(state, goal), atol=1e-6)
    for _ in range(10):
        action = rng.uniform(-1.2, 1.2, 2).astype(np.float32)
        obs, reward, terminated, truncated, _ = robot.step(action)
        targets = world_env.wheel_targets(jnp.asarray(action))
        np.testing.assert_allclose(robot.data.ctrl, targets, rtol=1e-5)
        before, state = state, seen()
        np.testing.assert_allclose(obs, task.observe(state, goal), atol=1e-5)
        wanted = float(task.reward(before, state, goal, jnp.asarray(action))[0])
        assert reward == pytest.approx(wanted, abs=1e-6)
        assert (terminated, truncated) == (bool(task.terminated(state, goal)), False)
    assert robot.data.time == pytest.approx(10 * world_env.dt)


def test_one_robots_episode_ends_at_the_goal_or_at_the_time_limit(world_config):
    robot = one_robot.OneRobot(world_config)
    robot.reset(np.random.default_rng(0))
    robot.goal[:] = 0.3, 0.0, 0.05
    ahead = np.array([0.0, 0.0])
    ends = [robot.step(ahead)[2:4] for _ in range(100)]
    assert (True, False) in ends
    robot.reset(np.random.default_rng(0))
    robot.goal[:] = -3.0, 0.0, 0.05
    ends = [robot.step(np.array([-1.0, 0.0]))[2:4] for _ in range(256)]
    assert ends == [(False, False)] * 255 + [(False, True)]


def test_goals_of_one_robot_are_the_tasks(world_config, world_env):
    rng = np.random.default_rng(0)
    robot = one_robot.OneRobot(world_config)
    drawn = []
    for _ in range(2000):
        robot.reset(rng)
        drawn.append(robot.goal.copy())
    keys = jax.random.split(jax.random.PRNGKey(0), 2000)
    wanted = np.asarray(jax.vmap(world_env.task.sample)(keys))
    drawn = np.array(drawn)
    for of in (lambda x: np.arctan2(x[:, 1], x[:, 0]), lambda x: np.linalg.norm(x, axis=1)):
        assert scipy.stats.ks_2samp(of(drawn), of(wanted)).pvalue > 1e-3


def test_robots_of_mujocos_rollout_hold_their_actions_and_drive(world_config):
    benchmark = baselines.MujocoRollout(world_config, 4, SMALL)
    controls = benchmark._controls
    np.testing.assert_array_equal(controls[:, ::2], controls[:, 1::2])
    assert controls.shape == (4, SMALL.unroll * 2, 2)
    rates = [benchmark.repeat(), benchmark.repeat()]
    row = benchmark.row(rates)
    assert row.rate == "mujoco"
    assert row.physics_steps_per_second == 2 * row.env_steps_per_second
    start = benchmark._states[:, 1:3].copy()
    benchmark.repeat()
    assert (np.abs(benchmark._states[:, 1:3] - start).max(axis=1) > 1e-3).all()
    benchmark._states[0, 3] = 1.0
    with pytest.raises(UserError, match="no longer on the floor"):
        benchmark.row(rates)


class Fake:
    """A benchmark with given rates."""

    def __init__(self, rate, num_envs, rates, order):
        self.rate, self.num_envs = rate, num_envs
        self._rates, self._order = iter(rates), order

    def repeat(self):
        self._order.append((self.rate, self.num_envs))
        return next(self._rates)

    def row(self, repeats):
        return make_row(self.rate, 2, self.num_envs, 0.0, repeats, 1)


def test_physics_and_mujoco_take_turns_and_are_compared_at_their_best(world_config, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    order = []
    ours = {64: [1.0, 1.0, 1.0], 128: [30.0, 60.0, 20.0]}
    monkeypatch.setattr(
        compare,
        "prepare_physics",
        lambda _, count, sizes: Fake("physics", count, ours[count], order),
    )
    monkeypatch.setattr(
        compare,
        "MujocoRollout",
        lambda _, count, sizes: Fake("mujoco", count, [20.0, 10.0, 10.0], order),
    )
    found = []
    compare.run(
        world_config,
        [64, 128],
        SMALL._replace(repeats=3),
        names=["physics", "mujoco"],
        report=found.extend,
    )
    assert order[: len(order) // 3] * 3 == order
    assert compare.ratios(found, "mujoco") == [1.5, 6.0, 2.0]
    assert "per second: 2.00 (1.50 .. 6.00 over 3 rounds)" in compare.ratio_lines(found)[0]
    # As if physics had had two cores and mujoco one.
    busy = [(row, [2.0 if row.rate == "physics" else 1.0] * 3) for row, _ in found]
    assert compare.ratios(busy, "mujoco", per_core=True) == [0.75, 3.0, 1.0]
    assert [line.split(":")[0] for line in compare.ratio_lines(found)] == [
        "physics over mujoco, steps per second",
        "physics over mujoco, steps per second of processor time",
    ]
    # A GPU's steps take next to no processor time.
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert len(compare.ratio_lines(found)) == 1
    assert compare.ratios(found[:2], "mujoco") == compare.ratios(found, "warp") == []


def test_a_benchmark_without_its_package_is_skipped_in_one_line(monkeypatch):
    monkeypatch.setattr(compare.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(compare.jax, "default_backend", lambda: "gpu")
    for name in ("sb3", "playground", "warp"):
        line = compare.missing(name)
        assert "pip install" in line
        assert "\n" not in line
    assert compare.missing("physics") is None
    monkeypatch.setattr(compare.jax, "default_backend", lambda: "cpu")
    assert compare.missing("warp") == "warp skipped: MJX-Warp needs an NVIDIA GPU"


def test_every_adapter_is_timed_in_turn(world_config, monkeypatch, tmp_path, capsys):
    for name in ("torch", "stable_baselines3", "gymnasium"):
        pytest.importorskip(name)
    monkeypatch.setattr(timing, "REPEAT_SECONDS", 0.01)
    monkeypatch.setattr(timing, "WARM_UP_CALLS", 1)
    monkeypatch.setattr(baselines, "_SB3_STEPS", 64)
    output = tmp_path / "a.json"
    with everywhere():
        arguments = ["--num-envs", "2", "--repeats", "2", "--output", str(output)]
        assert adapters.main(arguments) == 0
    rows = json.loads(output.read_text())["adapters"]
    assert [(row["rate"], row["num_envs"]) for row in rows] == [
        ("numpy", 1),
        ("gym", 1),
        ("vector", 2),
        ("vecenv", 2),
        ("sb3", 1),
        ("sb3-gym", 1),
        ("sb3-vec", 2),
    ]
    assert all(row["env_steps_per_second"] > 0 and len(row["repeats"]) == 2 for row in rows)
    assert capsys.readouterr().out.count("| sb3") == 3


def test_the_cost_of_randomization_is_the_median_over_the_rounds():
    rates = {"off": [100.0, 50.0, 90.0], "on": [80.0, 40.0, 90.0]}
    assert randomization_cost.cost(rates) == pytest.approx(0.25)


def evaluated(setting, seed, rates):
    one = {"unit": "1", "values": [0.4, 1.0], "nominal": 1.0, "scripted": [1.0, 1.0]}
    sweep = [
        {**one, "label": "mass", "policy": [0.99, 1.0]},
        {**one, "label": "friction", "policy": list(rates)},
    ]
    one = {"success_rate": rates[-1]}
    return {"setting": setting, "seed": seed, "preset": one, "ranges": one, "sweep": sweep}


def test_both_settings_are_tabulated_with_mean_and_worst_seed():
    rows = [evaluated("nominal", "0", (0.5, 1.0)), evaluated("nominal", "1", (0.7, 1.0))]
    table = randomization.table(rows)
    assert "| the full ranges | 100.00% (100.00%) | - |" in table
    assert "| friction, its hardest value | 60.00% (50.00%) at 0.4 | - |" in table
    rows.append(evaluated("randomised", "0", (0.9, 1.0)))
    assert "| 90.00% (90.00%) at 0.4 |" in randomization.table(rows)
    assert table.endswith("Every policy has 99% or more at every value of: mass.")
    (axes,) = randomization.plot(rows).axes
    lines = {line.get_label(): list(line.get_ydata()) for line in axes.lines}
    assert lines["nominal"] == pytest.approx([0.6, 1.0])
    assert lines["randomised"] == pytest.approx([0.9, 1.0])


def test_a_model_is_stepped_alike_by_all_contenders(tmp_path, monkeypatch):
    monkeypatch.setattr(timing, "REPEAT_SECONDS", 0.01)
    output = tmp_path / "rates.json"
    # XLA takes too long to compile for a test, as the row then says.
    options = "chain:2 --num-envs 64 --unroll 2 --rounds 1 --xla-limit 0 --tolerance 1e-6"
    assert fuse.main([*options.split(), "--output", str(output)]) == 0
    stored = json.loads(output.read_text())
    rows = {row["contender"]: row for row in stored["rows"]}
    assert stored["solver"] == {"tolerance": 1e-6}
    assert list(rows) == ["kernel", "mjx", "warp", "rollout", "batch"]
    assert rows["kernel"]["from_mujoco"] < 1e-5
    assert rows["mjx"]["note"] == rows["warp"]["note"] == "left out"
    assert output.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    for name in ("kernel", "rollout", "batch"):
        assert rows[name]["env_steps_per_second"] > 0
        # No more cores than there are can have been busy, but for what the clocks are coarse.
        busy = rows[name]["env_steps_per_second"] * rows[name]["cpu_seconds"]
        assert 0 < busy < 1.5 * os.cpu_count()


def test_the_first_instances_do_not_depend_on_how_many_there_are():
    few, many = (fuse.Problem(fuse.Settings("hopper", "own", (), n, 1, 3)) for n in (2, 5))
    np.testing.assert_array_equal(few.controls, many.controls[:2])
    np.testing.assert_array_equal(few.states, many.states[:2])


def test_mujocos_batch_and_rollout_start_from_the_same_states():
    settings = fuse.Settings("chain:2", "own", (), 4, 1, 3)
    problem = fuse.Problem(settings)
    ends = []
    for is_batch in (False, True):
        done = fuse.Mujoco(problem, is_batch=is_batch)._roll()
        ends.append(done["qpos"][:, -1] if is_batch else done[0][:, -1, 1:3])
    np.testing.assert_allclose(*ends, rtol=1e-12)
    assert np.ptp(ends[0][:, 0]) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["small_solves", pytest.param("search", marks=pytest.mark.slow)])
def test_a_program_is_the_same_as_one_kernel_and_by_xla(name, capsys, monkeypatch):
    monkeypatch.setattr(timing, "REPEAT_SECONDS", 0.01)
    assert programs.main([name, "--num-instances", "3,1", "--rounds", "1"]) == 0
    assert capsys.readouterr().out.count(name) == 2
    early, row = programs.measure(name, 1, 1)
    assert early.xla_seconds is None
    assert early.kernel_seconds > 0
    assert row.difference < 1e-6
    with pytest.raises(UserError, match="there is no program nothing: choose of"):
        programs.main(["nothing"])


@pytest.mark.parametrize(
    "name", slow_unless("search".__eq__, ["quasiseparable_cholesky", "search", "orbits"])
)
def test_no_program_is_faster_than_its_bound(name, monkeypatch):
    monkeypatch.setattr(timing, "REPEAT_SECONDS", 0.05)
    *_, row = programs.measure(name, 1, 1)
    assert 1e-6 < row.bound_seconds < min(row.kernel_seconds, row.xla_seconds)


def halve_until_below_one(x):
    return jax.lax.while_loop(lambda x: x >= 1, lambda x: x / 2, x)


BOUNDS = {
    "a product and a sum are one instruction": (lambda x: x * x + 1, 5),
    "a sum of two sums": (lambda x: (x + 1) + (x + 2), 2),
    "apart, where that is earlier": (lambda x: (x + 1) * (x + 2) + jnp.sqrt(jnp.sqrt(x)), 201),
    "iterations wait for the carry": (
        lambda x: jax.lax.fori_loop(0, 500, lambda i, y: 1.0 / (y + x), x),
        500 * 21,
    ),
    "but not for what follows from the counter": (
        lambda x: jax.lax.scan(lambda y, i: (y + 1.0 / (2 + i), y), x, jnp.arange(500.0))[0],
        500 + 21,
    ),
    "a stored number is there when it was computed": (
        lambda x: jax.lax.scan(lambda y, _: (y + x, y), x, length=500)[1][20],
        20,
    ),
    "the iterations that are made": (halve_until_below_one, 4 * 10),
    "the selected number": (lambda x: jnp.where(x > 0, x + 1, jnp.sqrt(x)), 1),
    "the side that is taken": (
        lambda x: jax.lax.cond(x > 0, lambda x: x + 1, halve_until_below_one, x),
        1,
    ),
    "the larger number": (lambda x: jnp.maximum(x + 20, jnp.sqrt(x)), 1),
    "whole numbers": (lambda x: x.astype(jnp.int32) + 1, 3),
}


@pytest.mark.parametrize("what", BOUNDS)
def test_a_bound_is_the_longest_chain(what):
    function, seconds = BOUNDS[what]
    times = {"add": 1, "mul": 10, "fma": 5, "div": 20, "sqrt": 100, "round": 40, "count": 6}
    found = longest_chain.lower_bound(function, jnp.float32(9.0), {**times, "call": 10_000})
    assert found == 10_000 + seconds


def test_a_process_is_ended_after_its_time():
    assert processes.last_within(60, range, 3) == (2, True)
    assert processes.last_within(0.1, map, time.sleep, [1000]) == (None, False)
    with pytest.raises(UserError, match=r"the process of int\(seven\) failed"):
        processes.last_within(60, int, "seven")


@pytest.mark.slow
def test_what_a_process_yields_before_its_time_is_kept():
    # It passes on a number after so many seconds.
    given = itertools.filterfalse, time.sleep, [0.001, 1000]
    assert processes.last_within(30, *given) == (0.001, False)


def test_a_row_says_what_took_too_long(monkeypatch):
    row = programs.Row("search", "https://github.com/jax-ml/jax/issues/25190", 1)
    found = iter([(None, False), (row._replace(kernel_seconds=1e-6), False)])
    monkeypatch.setattr(programs, "last_within", lambda *_: next(found))
    assert programs.measure_within(9, "search", 1, 1).note == "the kernel: not within 9 s"
    late = programs.measure_within(9, "search", 1, 1)
    assert late.note == "XLA: not within 9 s"
    assert programs.table_line(late).split()[:4] == ["search", "1", "1.0", "us"]


def test_an_environment_is_measured_by_kernels_and_by_xla(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(timing, "REPEAT_SECONDS", 0.01)
    mine, output = tmp_path / "mine.yaml", tmp_path / "rates.json"
    mine.write_text("environment: helpers.own_environments:Point\n")
    given = ["--num-envs", "64", "--repeats", "1", "--output", str(output)]
    assert environments.main([str(mine), *given]) == 0
    (row,) = json.loads(output.read_text())["rows"]
    assert (row["environment"], row["num_envs"]) == ("mine", 64)
    assert row["ratio"] == pytest.approx(row["kernels"] / row["xla"])
    assert "| mine | 64 |" in capsys.readouterr().out
    # Without `--output`, the file of the libraries stays as it is.
    monkeypatch.setattr(environments, "default_output", lambda _: tmp_path / "stored.json")
    assert environments.main([str(mine), *given[:-2]]) == 0
    assert not (tmp_path / "stored.json").exists()
    # A library that is not installed is skipped, and an environment that gets lost is told.
    absent = {"absent": {"environment": "not_installed_anywhere:make"}}
    monkeypatch.setattr(environments, "LIBRARIES", absent)
    assert environments.main(given) == 0
    assert json.loads(output.read_text())["rows"] == []
    assert "absent is skipped: environment = 'not_installed" in capsys.readouterr().err
    mine.write_text("environment: helpers.broken_environments:DividesByZero\n")
    with pytest.raises(UserError, match="states were not finite"):
        environments.main([str(mine), *given])


def test_an_ensemble_is_solved_alike_as_one_kernel_and_by_xla(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(timing, "REPEAT_SECONDS", 0.01)
    monkeypatch.setattr(ensembles, "END", 0.5)
    output = tmp_path / "rates.json"
    given = ["--num-instances", "64", "--rounds", "1", "--output", str(output)]
    assert ensembles.main(given) == 0
    kernel, xla = json.loads(output.read_text())["rows"][:2]
    assert (kernel["contender"], xla["contender"]) == ("kernel", "xla")
    # Round-off decides here and there whether a step is repeated.
    assert kernel["mean_steps"] == pytest.approx(xla["mean_steps"], rel=0.02)
    assert kernel["mean_steps"] > 10
    assert max(kernel["median_error"], xla["median_error"]) < 1e-3
    with pytest.raises(UserError, match=r"--tolerance 0\.0: name a number from 1e-7 to 1"):
        ensembles.main(["--tolerance", "0"])


@pytest.mark.slow
@pytest.mark.parametrize("friction", [pytest.param(None, marks=pytest.mark.slow), 0.2])
def test_robots_are_compared_with_c_mujoco_under_the_same_commands(friction, monkeypatch):
    env = robot_fidelity.make_jetbot_env(load_config("turtlebot")).blind()
    options = argparse.Namespace(robots=4, seconds=0.5, seed=0)
    row = robot_fidelity.measure("turtlebot", env, friction, options)
    assert row.is_right
    assert row.worst < 1e-2
    assert row.driven > 10.0  # mm
    # It does not hold by itself: MJX on ice, and C MuJoCo on the floor of the model.
    ours, model = robot_fidelity.make_slippery(env, 0.01)
    monkeypatch.setattr(robot_fidelity, "make_slippery", lambda *_: (ours, env.physics.mj_model))
    assert not robot_fidelity.measure("turtlebot", env, friction, options).is_right
    assert model.geom_friction[:, 0].max() == 0.01


@pytest.mark.parametrize(
    ("changed", "right"),
    [
        ({}, True),
        ({"median": 0.06}, False),
        ({"p99": 2.1}, False),
        ({"far": ((5.0, 4.0),)}, True),
        ({"far": ((5.0, 4.0), (5.0, 2.0))}, False),
    ],
)
def test_robots_that_end_far_away_have_to_be_explained(changed, right):
    row = robot_fidelity.Row("one", None, 0.01, 0.1, 1.0, 500.0, ())
    assert row._replace(**changed).is_right is right


def test_what_is_measured_of_other_robots_is_stored_where_one_says(tmp_path, monkeypatch):
    row = robot_fidelity.Row("one", None, 0.01, 0.1, 1.0, 500.0, ())
    monkeypatch.setattr(robot_fidelity, "RESULTS", tmp_path)
    monkeypatch.setattr(
        robot_fidelity, "make_jetbot_env", lambda config: argparse.Namespace(blind=list)
    )
    monkeypatch.setattr(robot_fidelity, "measure", lambda *_: row)
    stored, mine = tmp_path / "robot-fidelity-cpu.json", tmp_path / "mine.json"
    assert robot_fidelity.main(["rover"]) == 0
    assert robot_fidelity.main(["rover", "--output", str(mine)]) == 0
    assert [*tmp_path.iterdir()] == [mine]
    assert robot_fidelity.main([]) == 0
    assert len(json.loads(stored.read_text())["fidelity"]) == 10
