"""A command whose output cannot be written does its work and reports it by its exit code."""

import os
import subprocess
import sys
import textwrap

import pytest

pytestmark = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="only Linux has /dev/full")

LOST = "{}: standard output cannot be written: {}\n"

LEAVES = """
import sys
from pathlib import Path
from jetbot_mjx import cli

def command(_):
    print("to stderr", file=sys.stderr, flush=True)
    for _ in range(3):
        print("x" * 50_000, flush=True)
    Path("result").write_text("written")
    return {code}

cli.run_command(command, at_once={at_once}, writes_files={writes_files})
"""


def python(folder, source, redirection):
    """Runs a program under a shell; returns its exit code and what is left of stderr."""
    program = folder / "program.py"
    program.write_text(textwrap.dedent(source))
    line = f"{sys.executable} program.py {redirection}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", line], cwd=folder, capture_output=True, text=True, timeout=60
    )
    return done.returncode, done.stderr


@pytest.mark.parametrize("at_once", [False, True])
@pytest.mark.parametrize(
    ("redirection", "said"),
    [
        ("| head -c 1 >/dev/null", "to stderr\n"),
        ("| true", "to stderr\n"),
        (">/dev/full", "to stderr\n" + LOST.format("warning", "No space left on device")),
        (">&-", "to stderr\n" + LOST.format("warning", "Bad file descriptor")),
        (">/dev/null 2>/dev/full", ""),
        (">/dev/full 2>/dev/full", ""),
        (">&- 2>&-", ""),
    ],
)
def test_a_command_whose_output_is_lost_writes_its_files(tmp_path, redirection, said, at_once):
    source = LEAVES.format(code=0, at_once=at_once, writes_files=True)
    assert python(tmp_path, source, redirection) == (0, said)
    assert (tmp_path / "result").read_text() == "written"


@pytest.mark.parametrize(
    ("redirection", "code", "expected"),
    [
        # A reader that leaves has read what it wanted.
        ("| true", 0, 0),
        ("2>&1 | true", 1, 1),
        # The output was all that the command should produce.
        (">/dev/full", 0, 2),
        (">&-", 0, 2),
        (">/dev/full", 1, 1),
        ("2>/dev/full", 0, 0),
    ],
)
def test_a_command_that_only_prints_has_failed_where_that_is_lost(
    tmp_path, redirection, code, expected
):
    source = LEAVES.format(code=code, at_once=False, writes_files=False)
    assert python(tmp_path, source, redirection)[0] == expected


@pytest.mark.parametrize("arguments", [[], ["--help"], ["runs"], ["train", "--help"]])
def test_help_and_lists_that_cannot_be_written_have_failed(tmp_path, arguments):
    command = [sys.executable, "-m", "jetbot_mjx", *arguments]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (2, LOST.format("error", "No space left on device"))


def test_no_file_takes_the_place_of_a_closed_stream(tmp_path):
    source = """
        import contextlib, os
        from jetbot_mjx import cli

        def command(_):
            with open("result", "w"), contextlib.suppress(OSError):
                os.write(2, b"from a library")
            return 0

        cli.run_command(command)
        """
    assert python(tmp_path, source, ">/dev/null 2>&-")[0] == 0
    assert (tmp_path / "result").read_text() == ""


def test_a_slow_reader_of_a_pipe_that_does_not_block_gets_all(tmp_path):
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    source = LEAVES.format(code=0, at_once=True, writes_files=False)
    process = subprocess.Popen(
        [sys.executable, "-c", source], cwd=tmp_path, stdout=writer, stderr=subprocess.PIPE
    )
    os.close(writer)
    with process, os.fdopen(reader) as stream:
        assert len(stream.read()) == 3 * 50_001
    assert process.returncode == 0


def test_a_drive_that_does_not_answer_costs_one_line(tmp_path):
    source = """
        import errno, os
        from jetbot_mjx import cli

        def command(_):
            raise OSError(errno.EIO, os.strerror(errno.EIO), "run/page.html")

        cli.run_command(command, at_once=True)
        """
    said = "run/page.html: Input/output error: the drive does not answer"
    line = f"error: {said}: give the same command again when it does\n"
    assert python(tmp_path, source, "") == (2, line)
