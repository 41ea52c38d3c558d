"""Every reader reads damaged input or refuses it in one line; one that does not is found out."""

import os
import random
import subprocess
import sys

import pytest

from benchmarks.harness import mutations
from benchmarks.reliability import fuzz
from benchmarks.reliability.readers import Reader
from jetbot_mjx.errors import UserError


def test_a_few_inputs_of_every_reader(root, tmp_path):
    # In a process of its own: audit hooks stay, and readers replace what takes long.
    command = [sys.executable, str(root / "benchmarks" / "reliability" / "fuzz.py"), "--quick"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(done.stdout.splitlines()) >= len(fuzz.READERS) + 2
    assert os.listdir(tmp_path) == []


def refuse(content):
    raise UserError("no")


def raise_lines(content):
    error = UserError("no")
    error.args = ("one\ntwo",)
    raise error


def raise_long(content):
    error = UserError("no")
    error.args = ("x" * 3000,)
    raise error


def fail(content):
    return {}[len(content)]


def spin(content):
    while True:
        pass


def write_outside(content):
    with open("../elsewhere", "w") as file:
        file.write("x")


def warn(content):
    import warnings

    warnings.warn("odd", RuntimeWarning, stacklevel=1)


WRONG = {
    "raises another error": (fail, "KeyError: test_readers.py"),
    "writes two lines": (raise_lines, "more than a printable line: test_readers.py"),
    "writes a long line": (raise_long, "a line of 3000 characters"),
    "takes long": (spin, "slow: test_readers.py"),
    "writes elsewhere": (write_outside, "open outside of the folder"),
    "warns": (warn, "RuntimeWarning: test_readers.py"),
}


@pytest.fixture
def judged(monkeypatch, tmp_path):
    """What is found of a reader in three inputs."""
    monkeypatch.setattr(fuzz, "_MOST_SECONDS", 0.2)
    monkeypatch.chdir(tmp_path)

    def judge(read, printed=str):
        calls = []

        def after_the_sample(content):
            calls.append(content)
            return read(content) if len(calls) > 1 else None

        reader = Reader(lambda folder: after_the_sample, lambda: [b'{"a": 1}'], 3)
        monkeypatch.setitem(fuzz.READERS, "own", reader)
        return [*fuzz.fuzz("own", tmp_path, 0, 0, 3, printed=printed)][-1]

    return judge


@pytest.mark.parametrize("name", WRONG)
def test_a_reader_that_does_what_it_may_not_is_found_out(judged, name):
    read, what = WRONG[name]
    row = judged(read)
    assert row.inputs == 3
    assert [one.what[: len(what)] for one in row.findings] == [what]


def test_a_reader_that_reads_or_refuses_is_not(judged):
    assert judged(refuse)[:4] == ("own", 3, 0, 3)
    assert judged(len)[:4] == ("own", 3, 3, 0)
    assert judged(refuse).findings == ()
    assert judged(len, printed=lambda: "printed: x").findings[0].what == "printed: x"


def test_inputs_are_the_same_for_the_same_seed_and_odd(monkeypatch):
    monkeypatch.setitem(fuzz.READERS, "own", Reader(len, lambda: [b'{"a": [1, "b"]}'], 3))
    one = fuzz.inputs("own", 1)
    found = [next(one) for _ in range(400)]
    again = fuzz.inputs("own", 1)
    assert [next(again) for _ in range(400)] == found
    other = fuzz.inputs("own", 2)
    assert [next(other) for _ in range(400)] != found
    assert len(set(found)) > 300
    whole = b"".join(found)
    for odd in (b"\0", b"9" * 5000, b"1e999", b"../secret", b"[[[[[[[[", b"\xff", b"\xed\xa0\x80"):
        assert odd in whole, odd


def test_values_of_json_are_changed_left_out_and_nested():
    rng = random.Random(0)
    found = [mutations.dump(mutations.mutate_value({"a": 1, "b": [2]}, rng)) for _ in range(500)]
    assert {b'{"b": [2]}', b'{"a": 1}', b'{"a": nan, "b": [2]}'} & {*found}
    assert b'{"a": 1, "b": []}' in found


PROGRAM = """
import os, sys
from benchmarks.reliability import fuzz, readers

def make(folder):
    left = iter(range(8))
    def read(content):
        if next(left) == 5:
            {}
    return read

fuzz.READERS["own"] = readers.Reader(make, lambda: [b"abc"], 3)
if __name__ == "__main__":
    sys.exit(fuzz.main(["--readers", "own", "--least", "10", "--seconds", "0"]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "said"),
    [
        ("os._exit(7)", "the process ended with 7"),
        ("os.abort()", "the process ended with -6"),
        ("os.write(2, b'x\\n')", "printed: x"),
        ("b'x' * 1_300_000_000", "more than a gigabyte of memory"),
    ],
)
def test_a_reader_that_ends_its_process_or_prints_is_found_out(root, tmp_path, end, said):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(end))
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(
        [sys.executable, str(program)], env=environment, capture_output=True, text=True
    )
    assert (done.returncode, said in done.stdout) == (1, True), done.stdout + done.stderr
