"""Where the figures go: each sink says what it was told, and the clock counts compiling once."""

import io
import json
import math
import struct
import types

import jax
import jax.numpy as jnp
import pytest
from tensorboardX.proto.event_pb2 import Event

from jetbot_mjx import metrics
from jetbot_mjx.metrics import CompileClock, JsonlSink, ProgressSink, Sinks, TensorBoardSink


def test_jsonl_holds_one_object_a_line_readable_at_once(tmp_path):
    path = tmp_path / "metrics.jsonl"
    sink = JsonlSink(path)
    sink.write(0, {"eval/success_rate": 0.25})
    assert path.read_text() == '{"env_steps": 0, "eval/success_rate": 0.25}\n'
    sink.write(512, {"loss/total": -1.5, "eval/episodes": 4})
    lines = path.read_text().splitlines()
    assert [json.loads(line) for line in lines] == [
        {"env_steps": 0, "eval/success_rate": 0.25},
        {"env_steps": 512, "loss/total": -1.5, "eval/episodes": 4},
    ]
    sink.close()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, None])
def test_what_is_no_number_is_null_in_json(tmp_path, value):
    sink = JsonlSink(tmp_path / "metrics.jsonl")
    sink.write(1, {"before": 1.0, "it": value, "after": 2.0})
    sink.close()
    text = (tmp_path / "metrics.jsonl").read_text()
    assert text == '{"env_steps": 1, "before": 1.0, "it": null, "after": 2.0}\n'


def test_jsonl_appends_to_what_is_there(tmp_path):
    path = tmp_path / "metrics.jsonl"
    for env_steps in (1, 2):
        sink = JsonlSink(path)
        sink.write(env_steps, {})
        sink.close()
    assert path.read_text() == '{"env_steps": 1}\n{"env_steps": 2}\n'


def read_events(folder):
    """(step, name, value) of every scalar in the one event file of a folder.

    A record is its length (8 bytes), a checksum (4), the event, and a checksum (4).
    """
    (path,) = folder.iterdir()
    data = path.read_bytes()
    scalars = []
    while data:
        (length,) = struct.unpack("<Q", data[:8])
        event = Event.FromString(data[12 : 12 + length])
        data = data[12 + length + 4 :]
        scalars += [(event.step, value.tag, value.simple_value) for value in event.summary.value]
    return scalars


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


@pytest.fixture
def lines():
    """The lines that the progress of a training of 10,000 steps prints for some reports."""

    def lines(*reports):
        stream = io.StringIO()
        sink = ProgressSink(10_000, stream)
        for env_steps, figures in reports:
            sink.write(env_steps, figures)
        assert stream.getvalue().endswith("\n")
        return stream.getvalue().splitlines()

    return lines


def clocks(wall, compiled):
    return {"time/wall_seconds": wall, "time/compile_seconds": compiled}


def test_a_line_of_progress_says_how_far_how_good_and_how_fast(lines):
    figures = {
        "eval/success_rate": 0.875,
        "eval/time_to_goal_median": 1.25,
        "time/env_steps_per_second": 123_456.7,
        **clocks(wall=61.5, compiled=12.3),
    }
    (line,) = lines((4_096, figures))
    for part in ("4,096 steps", "success  87.5%", "to goal 1.25 s", "123,457 steps/s", "61.5 s"):
        assert part in line
    assert "(compiling 12.3 s)" in line


def test_a_line_leaves_out_what_there_is_not_yet(lines):
    figures = {"eval/success_rate": 0.0, "eval/time_to_goal_median": None, **clocks(1.0, 0.1)}
    (line,) = lines((0, figures))
    assert "success   0.0%" in line
    for part in ("to goal", "steps/s", "ETA", "compiling", "None"):
        assert part not in line


@pytest.mark.parametrize(
    ("compiled", "eta"),
    # From 0 to 2,000 steps in 20 s: 8,000 more take 80 s. Of the 20 s, compiling took some.
    [(0.0, 80), (12.0, 32)],
)
def test_the_time_left_is_that_of_the_last_pace_without_compiling(lines, compiled, eta):
    _, line = lines((0, clocks(30.0, 29.0)), (2_000, clocks(50.0, compiled)))
    assert f"ETA {eta:5d} s" in line


def test_the_time_left_follows_the_latest_interval(lines):
    # 2,000 to 4,000 steps in 5 s: 6,000 more take 15 s, however slowly it began.
    *_, line = lines((0, clocks(0.0, 0.0)), (2_000, clocks(50.0, 0.0)), (4_000, clocks(55.0, 0.0)))
    assert "ETA    15 s" in line


def test_no_time_is_left_at_the_end_and_beyond(lines):
    # Training steps are whole: the last may go beyond what was asked for.
    *_, line = lines((0, clocks(0.0, 0.0)), (10_240, clocks(5.0, 0.0)))
    assert "ETA     0 s" in line


def test_progress_goes_to_standard_output(capsys):
    ProgressSink(10).write(5, {})
    assert "5 steps" in capsys.readouterr().out


class Recorder:
    """A sink that remembers."""

    def __init__(self, log):
        self.log = log

    def write(self, env_steps, figures):
        self.log.append((self, env_steps, dict(figures)))

    def close(self):
        self.log.append((self, "closed"))


def test_joined_sinks_all_get_everything_and_are_all_closed():
    log = []
    first, second = Recorder(log), Recorder(log)
    with Sinks([first, second]) as sinks:
        sinks.write(3, {"a": 1.0})
    assert log == [
        (first, 3, {"a": 1.0}),
        (second, 3, {"a": 1.0}),
        (first, "closed"),
        (second, "closed"),
    ]


def test_joined_sinks_are_closed_where_training_fails():
    log = []
    sink = Recorder(log)
    with pytest.raises(ZeroDivisionError), Sinks([sink]):
        raise ZeroDivisionError
    assert log == [(sink, "closed")]


@pytest.fixture
def clock():
    clock = CompileClock()
    yield clock
    jax.monitoring.unregister_event_duration_listener(clock._listen)


def test_compiling_is_counted_and_running_is_not(clock):
    double = jax.jit(lambda x: 2 * x)
    one, two = jnp.float32(1), jnp.float32(2)
    clock.lap()
    double(one)
    assert clock.lap() > 0
    assert clock.lap() == 0  # a lap starts anew
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
def test_a_span_stands_for_those_within_it(clock, monkeypatch, events, expected):
    for end, duration in events:
        monkeypatch.setattr(metrics, "time", types.SimpleNamespace(perf_counter=lambda t=end: t))
        jax.monitoring.record_event_duration_secs(CompileClock._EVENTS[0], duration)
        jax.monitoring.record_event_duration_secs("/jax/some/other/event", 100.0)
    assert clock.lap() == pytest.approx(expected)
