"""The sinks of metrics, and the clock that counts compilation once."""

import errno
import json
import math
import os
import re
import shutil
import threading
import time
import types

import jax
import jax.numpy as jnp
import pytest
from PIL import Image
from tensorboardX.proto.layout_pb2 import Layout
from tensorboardX.proto.plugin_hparams_pb2 import HParamsPluginData

from helpers.tensorboard_files import events, read_events
from jetbot_mjx.config import Config, parse_config
from jetbot_mjx.runs import metrics
from jetbot_mjx.runs.metrics import (
    CompileClock,
    History,
    JsonlSink,
    TensorBoardSink,
    mean_of,
    read_history,
)


def lines_of(path):
    """The objects of a file of lines, each checked to tell when it was written."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert all(abs(line.pop("timestamp") - time.time()) < 60 for line in lines)
    return lines


def test_jsonl_holds_one_object_a_line_readable_at_once(tmp_path):
    path = tmp_path / "metrics.jsonl"
    sink = JsonlSink(path)
    sink.write(0, {"eval/success_rate": 0.25})
    assert lines_of(path) == [{"env_steps": 0, "eval/success_rate": 0.25}]
    sink.write(512, {"loss/total": -1.5, "eval/episodes": 4})
    assert path.read_text().endswith("}\n")
    assert lines_of(path) == [
        {"env_steps": 0, "eval/success_rate": 0.25},
        {"env_steps": 512, "loss/total": -1.5, "eval/episodes": 4},
    ]
    sink.close()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, None])
def test_a_non_finite_metric_is_null_in_json(tmp_path, value):
    sink = JsonlSink(tmp_path / "metrics.jsonl")
    sink.write(1, {"before": 1.0, "it": value, "after": 2.0})
    sink.close()
    text = (tmp_path / "metrics.jsonl").read_text()
    assert re.fullmatch(
        r'\{"env_steps": 1, "timestamp": [\d.]+, "before": 1.0, "it": null, "after": 2.0\}\n', text
    )


def test_a_line_is_on_the_disk_when_it_is_written(tmp_path, monkeypatch):
    synced = []
    fake = types.SimpleNamespace(fsync=lambda file: synced.append(path.read_text()))
    monkeypatch.setattr(metrics, "os", fake)
    path = tmp_path / "metrics.jsonl"
    sink = JsonlSink(path)
    sink.write(1, {})
    sink.write(2, {})
    sink.close()
    assert [text.count("\n") for text in synced] == [1, 2]


def test_jsonl_without_a_history_starts_an_empty_file(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"env_steps": 5, "timestamp": 1.0}\n')
    sink = JsonlSink(path)
    assert path.read_text() == ""
    sink.write(1, {})
    sink.close()
    assert lines_of(path) == [{"env_steps": 1}]


HISTORY = [
    History(0, 1.5, {"eval/success_rate": 0.25, "eval/time_to_goal_median": None}),
    History(512, 2.5, {"eval/success_rate": 0.5, "eval/episodes": 4}),
    History(1024, 3.5, {}),
]


@pytest.fixture
def logged(tmp_path):
    """The file of a training that made the reports of `HISTORY`."""
    path = tmp_path / "metrics.jsonl"
    JsonlSink(path, HISTORY).close()
    return path


def test_a_history_is_read_back_unchanged(logged, tmp_path):
    assert read_history(logged, 1024) == HISTORY
    assert read_history(logged, 1023) == HISTORY[:2]
    assert read_history(logged, 512) == HISTORY[:2]
    assert read_history(tmp_path / "nothing", 512) == []


@pytest.mark.parametrize(
    "rest",
    [
        '{"env_steps": 1500, "timestamp": 4.5, "eval/succ',
        '{"env_steps": 1024, "timestamp": 4.',
        "{",
        "\0\0\0\0",
        "3\n",
        "[]\n",
        '{"timestamp": 4.5}\n',
        '{"env_steps": "many", "timestamp": 4.5}\n',
        '{"env_steps": null, "timestamp": 4.5}\n',
        '{"env_steps": true, "timestamp": 4.5}\n',
        "\udcff\udcfe\n",
    ],
)
def test_a_line_cut_short_is_left_out_of_the_history(logged, rest):
    with logged.open("a", errors="surrogateescape") as file:
        file.write(rest)
    assert read_history(logged, 2000) == HISTORY


@pytest.mark.parametrize("last", [1024, 512, 0, -1])
def test_jsonl_goes_on_after_its_history_and_drops_the_rest(logged, last):
    before = logged.read_text()
    with logged.open("a") as file:
        file.write('{"env_steps": 2000, "timestamp": 4.')
    history = read_history(logged, last)
    sink = JsonlSink(logged, history)
    assert before.startswith(logged.read_text())
    assert logged.read_text().count("\n") == len(history)
    sink.write(3000, {"loss/total": 1.0})
    sink.close()
    again = read_history(logged, 3000)
    assert again[:-1] == history
    assert again[-1].metrics == {"loss/total": 1.0}


def test_a_file_that_equals_its_history_is_not_written_again(logged):
    inode = logged.stat().st_ino
    JsonlSink(logged, read_history(logged, 1024)).close()
    assert logged.stat().st_ino == inode
    JsonlSink(logged, read_history(logged, 512)).close()
    assert logged.stat().st_ino != inode


def test_a_full_disk_is_not_hidden(tmp_path, monkeypatch):
    def fail(file):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    sink = JsonlSink(tmp_path / "metrics.jsonl")
    monkeypatch.setattr(metrics, "os", types.SimpleNamespace(fsync=fail))
    with pytest.raises(OSError, match="No space left"):
        sink.write(1, {})
    sink.close()


def test_tensorboard_events_can_be_read_again(tmp_path):
    sink = TensorBoardSink(tmp_path / "tensorboard")
    sink.write(0, {"eval/success_rate": 0.25, "eval/time_to_goal_median": None})
    sink.write(3_000_000_000, {"eval/success_rate": 0.5, "loss/total": -1.5})
    sink.close()
    assert read_events(tmp_path / "tensorboard") == [
        (0, "eval/success_rate", 0.25),
        (3_000_000_000, "eval/success_rate", 0.5),
        (3_000_000_000, "loss/total", -1.5),
    ]


def test_tensorboard_holds_the_history_once_and_goes_on(tmp_path):
    folder = tmp_path / "tensorboard"
    for last in (1024, 512, 0):
        sink = TensorBoardSink(folder, [entry for entry in HISTORY if entry.env_steps <= last])
        sink.write(last + 100, {"eval/success_rate": 0.75})
        sink.close()
        known = [(0, "eval/success_rate", 0.25)]
        if last >= 512:
            known += [(512, "eval/success_rate", 0.5), (512, "eval/episodes", 4.0)]
        assert read_events(folder) == [*known, (last + 100, "eval/success_rate", 0.75)]
        # Its name tells the second: that of the next one is another.
        (file,) = folder.iterdir()
        file.rename(folder / "events.out.tfevents.1.elsewhere")


def test_tensorboard_keeps_the_time_at_which_something_was_reported(tmp_path):
    TensorBoardSink(tmp_path / "tensorboard", HISTORY).close()
    assert [event.wall_time for event in events(tmp_path / "tensorboard")][-3:] == [1.5, 2.5, 3.5]


def test_tensorboard_tells_the_configuration_and_shows_success_first(tmp_path):
    config = parse_config({"seed": 7, "ppo": {"learning_rate": 0.5}})
    folder = tmp_path / "tensorboard"
    sink = TensorBoardSink(folder, HISTORY, config)
    sink.write(2_048, {"eval/success_rate": 0.75})
    sink.close()
    values = {value.tag: value for event in events(folder) for value in event.summary.value}
    # The configuration as it is in the run folder.
    text = values["config/text_summary"].tensor.string_val[0].decode()
    assert [line[4:] for line in text.splitlines()] == config.to_yaml().splitlines()
    # Charts that name metrics there are, success first.
    layout = Layout.FromString(values["custom_scalars__config__"].tensor.string_val[0])
    charts = [chart for category in layout.category for chart in category.chart]
    assert charts[0].margin.series[0].value == "eval/success_rate"
    shown = {tag for chart in charts for tag in chart.multiline.tag}
    assert shown <= set(re.findall(r"  (\w+/\w+) ", metrics.__doc__)) | {"eval/time_to_goal_p95"}
    # Every setting, beside the success rate.
    content = {
        name: HParamsPluginData.FromString(values[f"_hparams_/{name}"].metadata.plugin_data.content)
        for name in ("experiment", "session_start_info", "session_end_info")
    }
    settings = content["session_start_info"].session_start_info.hparams
    assert settings.keys() == config.flat().keys()
    assert settings["ppo.learning_rate"].number_value == 0.5
    assert settings["seed"].number_value == 7
    assert settings["ppo.network.policy_hidden_layer_sizes"].string_value.startswith("[")
    (metric,) = content["experiment"].experiment.metric_infos
    assert metric.name.tag == "eval/success_rate"
    # The scalars are each there once.
    scalars = [
        (event.step, value.tag)
        for event in events(folder)
        for value in event.summary.value
        if value.WhichOneof("value") == "simple_value"
    ]
    assert (2_048, "eval/success_rate") in scalars
    assert len(scalars) == len(set(scalars))


def test_tensorboard_shows_the_return_of_an_environment(tmp_path):
    config = parse_config({"environment": "hopper:Hopper"})
    folder = tmp_path / "tensorboard"
    TensorBoardSink(folder, [], config).close()
    values = {value.tag: value for event in events(folder) for value in event.summary.value}
    layout = Layout.FromString(values["custom_scalars__config__"].tensor.string_val[0])
    assert [category.title for category in layout.category] == ["return", "success"]
    margin = layout.category[0].chart[0].margin.series[0]
    assert (margin.value, margin.lower) == ("eval/episode_return", "eval/return_low")
    experiment = HParamsPluginData.FromString(
        values["_hparams_/experiment"].metadata.plugin_data.content
    )
    (metric,) = experiment.experiment.metric_infos
    assert metric.name.tag == "eval/episode_return"


def film(run_dir, steps):
    path = run_dir / "videos" / f"{steps:012}" / metrics.EVALUATION_VIDEO
    path.parent.mkdir(parents=True)
    frames = [Image.new("RGB", (8, 4), (shade, 0, steps % 256)) for shade in (0, 200)]
    frames[0].save(path.with_suffix(".gif"), save_all=True, append_images=frames[1:])
    return path


def videos(folder):
    """(step, bytes, size) of every picture in the one event file of a folder."""
    return [
        (event.step, value.image.encoded_image_string, (value.image.width, value.image.height))
        for event in events(folder)
        for value in event.summary.value
        if value.tag == "eval/video"
    ]


def test_tensorboard_plays_the_videos_of_evaluations_and_keeps_them_on_resume(tmp_path):
    folder = tmp_path / "tensorboard"
    sink = TensorBoardSink(folder)
    paths = {steps: film(tmp_path, steps) for steps in (0, 512, 2048)}
    for steps, path in paths.items():
        sink.write_video(steps, path)
    sink.close()
    gifs = {steps: path.with_suffix(".gif").read_bytes() for steps, path in paths.items()}
    assert videos(folder) == [(steps, gif, (8, 4)) for steps, gif in gifs.items()]
    assert gifs[0].startswith(b"GIF")
    # A training that resumes before the last evaluation makes that evaluation again.
    TensorBoardSink(folder, HISTORY).close()
    assert videos(folder) == [(steps, gifs[steps], (8, 4)) for steps in (0, 512)]


def test_a_video_that_was_cut_is_left_out_on_resume(tmp_path):
    gifs = {steps: film(tmp_path, steps).with_suffix(".gif") for steps in (0, 512)}
    gifs[0].write_bytes(gifs[0].read_bytes()[:7])
    (tmp_path / "videos" / "notes").mkdir()
    shutil.copy(gifs[512], tmp_path / "videos" / "notes")
    folder = tmp_path / "tensorboard"
    TensorBoardSink(folder, HISTORY).close()
    assert [step for step, *_ in videos(folder)] == [512]


def test_tensorboard_leaves_alone_what_is_not_its_own(tmp_path):
    folder = tmp_path / "tensorboard"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    TensorBoardSink(folder, HISTORY).close()
    assert (folder / "notes.txt").read_text() == "mine"


def test_tensorboard_is_written_again_with_the_same_other_names(tmp_path):
    metrics = {"loss/value": 1 / 3, "policy/entropy": 0.1, "time/wall_seconds": 7.7}
    for name in ("once", "again"):
        history = read_history(tmp_path / "metrics.jsonl", 120)
        folder = tmp_path / name
        sinks = [JsonlSink(tmp_path / "metrics.jsonl", history)]
        sinks.append(TensorBoardSink(folder, history, Config()))
        if not history:
            for sink in sinks:
                sink.write(120, metrics)
        for sink in sinks:
            sink.close()
    once, again = (read_events(tmp_path / name) for name in ("once", "again"))
    assert once == again
    assert "train/value_loss" in {name for _, name, _ in once}


def test_the_mean_of_seeds_leaves_out_who_has_none():
    assert mean_of([{"a": 1.0, "b": None}, {"a": None, "b": None}, {"a": 2.0, "b": None}]) == {
        "a": 1.5,
        "b": None,
    }


@pytest.fixture
def clock():
    with CompileClock() as clock:
        yield clock


def test_compiling_is_counted_and_running_is_not(clock):
    double = jax.jit(lambda x: 2 * x)
    one, two = jnp.float32(1), jnp.float32(2)
    clock.lap()
    double(one)
    assert clock.lap() > 0
    assert clock.lap() == 0  # a lap starts at zero
    double(two)
    assert clock.lap() == 0


def test_another_shape_is_another_compilation(clock):
    double = jax.jit(lambda x: 2 * x)
    one, many = jnp.ones(1), jnp.ones(3)
    double(one)
    clock.lap()
    double(many)
    assert clock.lap() > 0


def test_compiling_within_tracing_is_not_counted_twice(clock):
    spans = []

    def listen(event, seconds, **details):
        if event in CompileClock._EVENTS:
            spans.append((details["fun_name"], seconds))

    @jax.jit
    def inner(x):
        return jnp.sin(x)

    @jax.jit
    def outer(x):
        with jax.ensure_compile_time_eval():  # compiles while `outer` is being traced
            constant = inner(3.0)
        return x + constant

    one = jnp.float32(1)
    clock.lap()
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        outer(one)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    once = sum(seconds for name, seconds in spans if "outer" in name)
    assert sum(seconds for _, seconds in spans) > once
    assert clock.lap() == pytest.approx(once, rel=1e-6)


@pytest.mark.parametrize(
    ("events", "expected"),
    [
        # (end, duration): one after the other, 1 + 2 s
        ([(1.0, 1.0), (3.0, 2.0)], 3.0),
        # one within the other
        ([(2.0, 1.0), (3.0, 3.0)], 3.0),
        # two within a third, and a fourth before them
        ([(1.0, 1.0), (3.0, 1.0), (5.0, 1.0), (6.0, 4.5)], 5.5),
    ],
)
def test_a_compilation_counts_once_with_those_inside_it(clock, monkeypatch, events, expected):
    for end, duration in events:
        monkeypatch.setattr(metrics, "time", types.SimpleNamespace(perf_counter=lambda t=end: t))
        jax.monitoring.record_event_duration_secs(CompileClock._EVENTS[0], duration)
        jax.monitoring.record_event_duration_secs("/jax/some/other/event", 100.0)
    assert clock.lap() == pytest.approx(expected)


def test_compilations_in_parallel_threads_count_once(clock):
    barrier = threading.Barrier(2)

    def compile():
        barrier.wait()
        jax.monitoring.record_event_duration_secs(CompileClock._EVENTS[2], 5.0)

    threads = [threading.Thread(target=compile) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert 5.0 <= clock.lap() < 9.0
    assert clock.programs == 2


def test_the_clock_counts_programs_and_those_from_the_cache(clock):
    jax.monitoring.record_event_duration_secs(CompileClock._EVENTS[0], 1.0)
    for _ in range(3):
        jax.monitoring.record_event_duration_secs(CompileClock._EVENTS[2], 1.0)
    jax.monitoring.record_event(CompileClock._CACHE_HIT)
    jax.monitoring.record_event_duration_secs(CompileClock._SAVED, 7.5)
    assert (clock.programs, clock.cached, clock.saved_seconds) == (3, 1, 7.5)


def test_a_clock_that_was_left_no_longer_listens():
    with CompileClock() as clock:
        pass
    jax.monitoring.record_event_duration_secs(CompileClock._EVENTS[2], 5.0)
    jax.monitoring.record_event(CompileClock._CACHE_HIT)
    assert clock.lap() == 0
    assert (clock.programs, clock.cached) == (0, 0)


def test_a_compilation_across_two_intervals_counts_once():
    event = "/jax/core/compile/backend_compile_duration"
    with CompileClock() as clock:
        began = time.perf_counter()
        jax.monitoring.record_event_duration_secs(event, 0.2)
        first = clock.lap()
        # Another thread's, that was under way all the time.
        jax.monitoring.record_event_duration_secs(event, 0.2 + time.perf_counter() - began)
        second = clock.lap()
        elapsed = 0.2 + time.perf_counter() - began
    assert first == pytest.approx(0.2, abs=0.01)
    assert second < elapsed - 0.19
