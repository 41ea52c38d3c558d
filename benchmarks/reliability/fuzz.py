"""Give every reader damaged files and messages: `python benchmarks/reliability/fuzz.py`.

Each input is a valid file or message with up to four random damages. A reader may accept it, or
refuse it by an error of one line that a terminal shows as it is. It may not raise another error,
print a warning, take more than two seconds of processor time or a gigabyte of memory, write outside
of its folder, or end the process. Every reader runs in a process of its own, with the same inputs
for the same seed; the exit code is 1 if one did what it may not.
"""

import argparse
import base64
import concurrent.futures
import contextlib
import ctypes
import multiprocessing
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.mutations import mutate
from benchmarks.harness.results import check_output, write
from benchmarks.reliability.readers import READERS
from jetbot_mjx import cli
from jetbot_mjx.errors import UserError, shown
from jetbot_mjx.runs.run_dir import versions

_MOST_SECONDS = 2.0
"""Longest processor time for one input [s]."""
_MOST_MEMORY = 1_000_000
"""Most memory that one input may take [KiB]."""
_SILENCE = 120.0
"""Time without a word from a process after which it counts as hanging [s]."""
_LEAST = 10_000
"""Inputs that every reader has in a long run."""


class _Slow(BaseException):
    """Raised in a reader that takes too long; no reader catches it."""


class _Output:
    """An `_Output` notes what libraries print by themselves.

    What this project prints is a line of its own, and is dropped.
    """

    def __init__(self, file: Path) -> None:
        self._file = file.open("w+b", buffering=0)
        self._flush = ctypes.CDLL(None).fflush
        for descriptor in (1, 2):
            os.dup2(self._file.fileno(), descriptor)
        sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115

    def take(self) -> str:
        """Return the first line that was printed since the last call; nothing if none was."""
        self._flush(None)
        if not os.fstat(self._file.fileno()).st_size:
            return ""
        self._file.seek(0)
        line = self._file.read(1000).strip().partition(b"\n")[0]
        self._file.seek(0)
        self._file.truncate()
        return f"printed: {line[:60].decode(errors='replace')}"


class Finding(NamedTuple):
    """A `Finding` holds an input with which a reader did what it may not."""

    what: str
    """Kind of the mistake, and where it was made: the same for all inputs that show it."""
    number: int
    """Number of the input."""
    content: str
    """The input, in base64."""


class Row(NamedTuple):
    """A `Row` holds what became of the inputs of one reader."""

    reader: str
    inputs: int
    read: int
    """Inputs that were read."""
    refused: int
    """Inputs that were refused in one line."""
    slowest: float
    """Longest processor time of an input [s]."""
    seconds: float
    findings: tuple[Finding, ...] = ()


class _Watch:
    """A `_Watch` notes what a process writes outside of a folder."""

    def __init__(self, folder: Path) -> None:
        cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", folder)
        self._inside = (f"{folder.resolve()}{os.sep}", str(cache), "/dev/null", "/proc/")
        self.active, self.found = False, ""
        sys.addaudithook(self._note)

    def _note(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.active:
            return
        writes = event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink")
        if event == "open":
            mode, flags = arguments[1], arguments[2] or 0
            writes = flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT) or set(mode or "") & set("wax+")
        if not writes and event not in ("os.system", "subprocess.Popen", "os.exec", "os.chmod"):
            return
        path = arguments[0] if arguments else ""
        path = os.fsdecode(path) if isinstance(path, str | bytes | os.PathLike) else ""
        if not os.path.abspath(path).startswith(self._inside):
            self.found = f"{event} outside of the folder"


def inputs(name: str, seed: int) -> Iterator[bytes]:
    """Yield the damaged contents for a reader, the same for the same seed."""
    samples = READERS[name].samples()
    number = zlib.crc32(name.encode())
    others = samples if len(samples) > 1 else ()
    for index in range(sys.maxsize):
        rng = random.Random(f"{seed} {number} {index}")
        yield mutate(rng.choice(samples), rng, others)


def fuzz(
    name: str,
    folder: Path,
    seed: int,
    first: int,
    end: int,
    until: float = 0.0,
    printed: Callable[[], str] = str,
) -> Iterator[Row]:
    """Give a reader its inputs, and yield what became of them, once a second and at the end.

    Args:
      name: the reader.
      folder: an empty folder.
      seed: seed of the inputs.
      first: number of the first input.
      end: number of inputs to have at least.
      until: time until which there are further ones, by `time.monotonic` [s].
      printed: a function that returns what was printed since its last call.
    """
    (folder / "files").mkdir(exist_ok=True)
    (folder / "secret").write_text("secret")
    os.chdir(folder / "files")
    read = READERS[name].make(folder / "files")
    for sample in READERS[name].samples():
        read(sample)  # It is valid, and what is made once is made.
    watch = _Watch(folder / "files")
    printed()
    count = accepted = refused = 0
    slowest, findings, began = 0.0, {}, time.monotonic()
    said, left = began, os.open(folder / "input", os.O_CREAT | os.O_RDWR)
    for number, content in enumerate(inputs(name, seed)):
        if number < first:
            continue
        # A process that ends leaves the input that ended it.
        os.pwrite(left, number.to_bytes(8, "little") + len(content).to_bytes(8, "little"), 0)
        os.pwrite(left, content, 16)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        start = time.process_time()
        what = _try(read, content, watch)
        took = time.process_time() - start
        if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before > _MOST_MEMORY:
            what = "more than a gigabyte of memory"
        what = printed() or what
        slowest, count = max(slowest, took), count + 1
        accepted, refused = accepted + (what is None), refused + (what == "")
        if what and what not in findings:
            findings[what] = Finding(what, number, base64.b64encode(content).decode())
        now = time.monotonic()
        is_last = number + 1 >= end and now >= until
        if is_last or now > said + 1:
            said = now
            found = tuple(findings.values())
            yield Row(name, count, accepted, refused, slowest, now - began, found)
        if is_last:
            return


def _stop(*_: object) -> None:
    raise _Slow


def _try(read: Any, content: bytes, watch: _Watch) -> str | None:
    """Return what a reader did wrong; nothing if it refused the input, None if it read it."""
    watch.found, watch.active = "", True
    before = signal.signal(signal.SIGPROF, _stop)
    signal.setitimer(signal.ITIMER_PROF, _MOST_SECONDS)
    found = None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # JAX makes a list of its devices once; files that are closed late are no reader's.
            warnings.simplefilter("ignore", ResourceWarning)
            warnings.simplefilter("ignore", DeprecationWarning)
            read(content)
    except _Slow as error:
        found = f"slow: {_place(error)}"
    except (SystemExit, Exception) as error:
        found = _judge(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        watch.active = False
    return watch.found or found


def _judge(error: BaseException) -> str:
    """Return what is wrong with a refusal; nothing if it is one line of this project."""
    if not {"UserError", "DriveError"} & {one.__name__ for one in type(error).__mro__}:
        return f"{type(error).__name__}: {_place(error)}"
    text = str(error)
    if len(text.splitlines()) != 1 or not text.isprintable():
        return f"more than a printable line: {_place(error)}"
    return f"a line of {len(text)} characters" if len(text) > 2100 else ""


def _place(error: BaseException) -> str:
    """Return where an error was raised: the last line of this project, and the last of all."""
    # The last of what takes long is the handler of the signal that ended it.
    frames = [x for x in traceback.extract_tb(error.__traceback__) if x.name != _stop.__name__]
    own = [x for x in frames if {"jetbot_mjx", "onekernel", "deploy"} & {*Path(x.filename).parts}]
    own = [x for x in own if "site-packages" not in x.filename] or frames
    places = dict.fromkeys(f"{Path(x.filename).name}:{x.lineno}" for x in (own[-1], frames[-1]))
    return " … ".join(places)


def _run(sender: Connection, *arguments: Any) -> None:
    output = _Output(arguments[1].parent / f"{arguments[1].name}.printed")
    for row in fuzz(*arguments, printed=output.take):
        sender.send(row)


def fuzz_apart(name: str, seed: int, least: int, seconds: float) -> Row:
    """Fuzz a reader in processes of its own, a new one after each that ends too early.

    Args:
      name: the reader.
      seed: seed of the inputs.
      least: number of inputs to have at least.
      seconds: how long there are further ones [s].
    """
    context, until = multiprocessing.get_context("spawn"), time.monotonic() + seconds
    total, first = Row(name, 0, 0, 0, 0.0, 0.0), 0
    while True:
        with tempfile.TemporaryDirectory(dir=_fast_folder()) as place:
            receiver, sender = context.Pipe(duplex=False)
            folder = Path(place) / "reader"
            folder.mkdir()
            arguments = (sender, name, folder, seed, first, least, until)
            process = context.Process(target=_run, args=arguments, daemon=True)
            process.start()
            sender.close()
            row, end = _last(receiver, Row(name, 0, 0, 0, 0.0, 0.0))
            process.kill() if end == "hang" else None
            process.join()
            total = _sum(total, row)
            if process.exitcode == 0:
                return total
            file = folder / "input"
            if not file.exists() or not file.stat().st_size:
                raise UserError(f"the reader {name} could not be made")
            whole = file.read_bytes()
        # Between two words of the process there were more inputs than it told.
        first = int.from_bytes(whole[:8], "little") + 1
        content = whole[16 : 16 + int.from_bytes(whole[8:16], "little")]
        what = end or f"the process ended with {process.exitcode}"
        lost = Finding(what, first - 1, base64.b64encode(content).decode())
        total = total._replace(inputs=first, findings=(*total.findings, lost))
        if len(total.findings) > 20:
            return total


def _fuzz_here(name: str, seed: int) -> Row:
    """Fuzz a reader in this process, by the inputs of a short run."""
    with tempfile.TemporaryDirectory(dir=_fast_folder()) as place, contextlib.chdir(place):
        return [*fuzz(name, Path(place), seed, 0, READERS[name].quick)][-1]


def _fast_folder() -> Path | None:
    """Return a folder in memory, if there is one."""
    memory = Path("/dev/shm")
    return memory if os.access(memory, os.W_OK) else None


def _last(receiver: Connection, row: Row) -> tuple[Row, str]:
    """Return the last row that a process sends, and `hang` if it sends none for long."""
    with contextlib.suppress(EOFError):
        while receiver.poll(_SILENCE):
            row = receiver.recv()
        return row, "hang"
    return row, ""


def _sum(one: Row, other: Row) -> Row:
    known = {finding.what for finding in one.findings}
    return Row(
        one.reader,
        one.inputs + other.inputs,
        one.read + other.read,
        one.refused + other.refused,
        max(one.slowest, other.slowest),
        one.seconds + other.seconds,
        (*one.findings, *(x for x in other.findings if x.what not in known)),
    )


def _rows(options: argparse.Namespace) -> Iterator[Row]:
    """Yield the rows of all readers."""
    if options.quick:
        yield from (_fuzz_here(name, options.seed) for name in options.readers)
        return
    shares = sum(READERS[name].share for name in options.readers)
    seconds = options.seconds * options.jobs / shares

    def one(name: str) -> Row:
        share = READERS[name].share
        return fuzz_apart(name, options.seed, options.least, seconds * share)

    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        yield from pool.map(one, options.readers)


def main(arguments: Sequence[str] | None = None) -> int:
    """Fuzz all readers, print a table and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if a reader did what it may not.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600, help="time of all (default: 600)")
    parser.add_argument("--readers", nargs="+", choices=READERS, default=list(READERS))
    parser.add_argument(
        "--least", type=cli.positive_int, default=_LEAST, help="least inputs of each reader"
    )
    parser.add_argument(
        "--jobs", type=cli.positive_int, default=1, help="readers at a time (default: 1)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="a few inputs of each, all in this process"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the inputs")
    parser.add_argument("--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    if options.output:
        check_output(options.output)
    os.environ["JAX_PLATFORMS"] = "cpu"
    print(f"{'reader':26}{'inputs':>10}{'read':>10}{'refused':>10}{'slowest [s]':>13}{'[s]':>7}")
    rows = []
    for row in _rows(options):
        rows.append(row)
        numbers = f"{row.inputs:10,}{row.read:10,}{row.refused:10,}{row.slowest:13.2f}"
        print(f"{row.reader:26}{numbers}{row.seconds:7.0f}", flush=True)
        for one in row.findings:
            content = shown(base64.b64decode(one.content))
            print(f"    {one.what}, input {one.number}: {content}", flush=True)
    print(f"{'all':26}{sum(row.inputs for row in rows):10,}")
    if options.output:
        results = [{**row._asdict(), "findings": [*map(list, row.findings)]} for row in rows]
        write(options.output, {"seed": options.seed, "versions": versions(), "rows": results})
    return int(any(row.findings for row in rows))


if __name__ == "__main__":
    cli.run_command(main)
