"""Record what a program asks of the disk, and make the states that a loss of power may leave.

`record` runs a program under `strace`. A sync makes the disk hold a file's content, or the names in
a folder; between two syncs a disk may write in any order. So after a loss of power it holds all
operations that a sync covers, and any of the others. This is more than file systems leave in fact:
most of them write names in order.
"""

import hashlib
import itertools
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jetbot_mjx.errors import UserError

CONFIRMED = Path("/confirmed")
"""Asking for a file below this folder, which does not exist, confirms what its name says."""

_CALLS = (
    "open,openat,creat,close,write,pwrite64,writev,pwritev,pwritev2,ftruncate,truncate,fallocate,"
    "lseek,rename,renameat,renameat2,link,linkat,symlink,symlinkat,unlink,unlinkat,rmdir,mkdir,"
    "mkdirat,fsync,fdatasync,sync,syncfs,access,faccessat,faccessat2,copy_file_range,sendfile"
)

_BY_PATH = (
    *("open", "openat", "creat", "rename", "renameat", "renameat2", "link", "linkat", "symlink"),
    *("symlinkat", "unlink", "unlinkat", "rmdir", "mkdir", "mkdirat", "truncate"),
)
"""Those of them that name a file by its path."""

_ALL_SUBSETS = 10
"""Most operations of which all subsets are made."""

_DRAWN, _DRAWN_OF_MANY = 20, 2_000
"""Subsets that are drawn before a sync; of more operations than `_ALL_SUBSETS`."""

_BLOCK = 512
"""Bytes that a disk writes as a whole."""


class Op(NamedTuple):
    """An `Op` is a change of one file's content, of names, or a sync.

    Files and folders are numbers; the recorded folder is 0.
    """

    kind: str
    """`names`, `write`, `resize`, `sync` or `confirm`."""
    node: int = 0
    """The file or folder that is written or synced."""
    names: tuple[tuple[int, str, int | None], ...] = ()
    """Of `names`, which happen at once: a folder, a name in it, and what has it from then on."""
    offset: int = 0
    """Of `write`, in bytes; of `resize`, the new size."""
    data: bytes = b""
    """Of `write`; of `confirm`, what is confirmed."""
    started: int = 0
    """Of `sync`: number of operations that were complete when it began."""


class Recording(NamedTuple):
    """A `Recording` holds the operations of a program, in the order in which they were complete."""

    ops: list[Op]
    folders: set[int]
    """The numbers of all folders."""


State = Mapping[str, bytes | None]
"""Content of each file by its path; None: a folder."""


def record(arguments: Sequence[str], folder: Path, environment: Mapping[str, str]) -> Recording:
    """Run a Python program, and return what it did below a folder.

    Args:
      arguments: Python's arguments.
      folder: the folder, which must be empty.
      environment: variables of the program.

    Raises:
      UserError: there is no strace, it may not trace here, or the program failed.
    """
    if shutil.which("strace") is None:
        raise UserError("strace is missing, which records the system calls: apt install strace")
    trace = folder.with_name(f"{folder.name}.strace")
    command = ["strace", "-f", "-y", "-xx", "-s", str(2**24), "-e", f"trace={_CALLS}"]
    done = subprocess.run(
        [*command, "-o", str(trace), sys.executable, *arguments],
        env=environment,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise UserError(f"the recorded program failed: {done.stderr.strip()[-2000:]}")
    reader = _TraceReader(folder)
    with trace.open(encoding="ascii") as lines:
        for line in lines:
            reader.read(line)
    return Recording(reader.ops, reader.folders)


class _TraceReader:
    """A `_TraceReader` turns lines of strace into operations below a folder."""

    _UNFINISHED = " <unfinished ...>"
    _RESUMED = re.compile(r"(\d+) +<\.\.\. \w+ resumed>(.*)")
    _LINE = re.compile(r"(\d+) +(\w+)\((.*)\) += (-?\w+)")
    _TEXT = re.compile(r'"((?:\\x[0-9a-f]{2})*)"')
    _OPEN = re.compile(r"(\d+|AT_FDCWD)<((?:\\x[0-9a-f]{2})*)(\(deleted\))?>")

    def __init__(self, root: Path) -> None:
        """Begin with an empty folder."""
        self.ops: list[Op] = []
        self.folders = {0}
        self._root = root.resolve()
        self._names: dict[tuple[int, str], int] = {}
        self._sizes: dict[int, int] = {}
        self._places: dict[int, int | None] = {}
        """Where the next write through each descriptor begins; None: at the end of the file."""
        self._begun: dict[str, tuple[str, int]] = {}

    def read(self, line: str) -> None:
        """Read one line, or the begin of a call that another line ends."""
        line, started = line.rstrip("\n"), len(self.ops)
        if line.endswith(self._UNFINISHED):
            process = line.split(maxsplit=1)[0]
            self._begun[process] = line.removesuffix(self._UNFINISHED), started
            return
        if resumed := self._RESUMED.match(line):
            begun, started = self._begun.pop(resumed[1])
            line = begun + resumed[2]
        if found := self._LINE.match(line):
            self._call(found[2], found[3], found[4], line[found.end() :], started)

    def _call(self, call: str, text: str, result: str, after: str, started: int) -> None:
        """Note what a call changed."""
        texts = [_decode(x) for x in self._TEXT.findall(text)]
        opened = [(x[0], Path(os.fsdecode(_decode(x[1])))) for x in self._OPEN.findall(text)]
        if call in ("access", "faccessat", "faccessat2"):
            asked = Path(os.fsdecode(texts[0]))
            if asked.is_relative_to(CONFIRMED):
                self.ops.append(Op("confirm", data=os.fsencode(asked.relative_to(CONFIRMED))))
        elif result.startswith("-"):
            return
        elif call in ("sync", "syncfs"):
            raise UserError(f"the program called {call}, which is not replayed")
        elif texts and call in _BY_PATH:
            folders = [path for _, path in opened] or [Path.cwd()]
            paths = [
                Path(os.path.normpath(folders[min(i, len(folders) - 1)] / os.fsdecode(x)))
                for i, x in enumerate(texts)
            ]
            if any(self._is_below(path) for path in paths):
                self._change_names(call, paths, text, result)
        elif opened and self._is_below(opened[0][1]):
            descriptor, path = opened[0]
            self._use(call, int(descriptor), path, b"".join(texts), text, int(result), started)

    def _is_below(self, path: Path) -> bool:
        return path.is_relative_to(self._root)

    def _node(self, path: Path) -> int | None:
        node: int | None = 0
        for part in path.relative_to(self._root).parts:
            node = None if node is None else self._names.get((node, part))
        return node

    def _entry(self, path: Path) -> tuple[int, str]:
        folder = self._node(path.parent)
        if folder is None:
            raise UserError(f"the trace lacks the folder of {path}")
        return folder, path.name

    def _name(self, *names: tuple[tuple[int, str], int | None]) -> None:
        for entry, node in names:
            if node is None:
                self._names.pop(entry, None)
            else:
                self._names[entry] = node
        self.ops.append(Op("names", names=tuple((*entry, node) for entry, node in names)))

    def _change_names(self, call: str, paths: list[Path], text: str, result: str) -> None:
        first = paths[0]
        if call in ("open", "openat", "creat"):
            self._open(first, text, int(result))
        elif call in ("mkdir", "mkdirat"):
            if first != self._root:
                node = self._new_node()
                self.folders.add(node)
                self._name((self._entry(first), node))
        elif call in ("unlink", "unlinkat", "rmdir"):
            self._name((self._entry(first), None))
        elif call in ("rename", "renameat", "renameat2"):
            if not all(map(self._is_below, paths)):
                raise UserError(f"{first} was renamed across the recorded folder's border")
            old, new = map(self._entry, paths)
            after = self._names.get(new) if "RENAME_EXCHANGE" in text else None
            self._name((new, self._names[old]), (old, after))
        else:
            raise UserError(f"the program called {call}, which is not replayed")

    def _new_node(self) -> int:
        node = len(self._sizes) + 1
        self._sizes[node] = 0
        return node

    def _open(self, path: Path, text: str, descriptor: int) -> None:
        node = self._node(path)
        if node is None and "O_TMPFILE" not in text:
            node = self._new_node()
            self._name((self._entry(path), node))
        elif node is not None and "O_TRUNC" in text and self._sizes[node]:
            self._resize(node, 0)
        self._places[descriptor] = None if "O_APPEND" in text else 0

    def _resize(self, node: int, size: int) -> None:
        self._sizes[node] = size
        self.ops.append(Op("resize", node, offset=size))

    def _use(
        self,
        call: str,
        descriptor: int,
        path: Path,
        data: bytes,
        text: str,
        result: int,
        started: int,
    ) -> None:
        node = self._node(path)
        if node is None or call == "close":
            return
        if call in ("fsync", "fdatasync"):
            self.ops.append(Op("sync", node, started=started))
        elif call == "lseek":
            if self._places.get(descriptor, 0) is not None:
                self._places[descriptor] = result
        elif call == "ftruncate":
            self._resize(node, int(text.rsplit(",", 1)[1]))
        elif call in ("write", "writev", "pwrite64"):
            here = self._places.get(descriptor, 0)
            offset = self._sizes[node] if here is None else here
            if call == "pwrite64":
                offset = int(text.rsplit(",", 1)[1])
            elif here is not None:
                self._places[descriptor] = offset + result
            self._sizes[node] = max(self._sizes[node], offset + result)
            self.ops.append(Op("write", node, offset=offset, data=data[:result]))
        else:
            raise UserError(f"the program called {call}, which is not replayed")


def _decode(text: str) -> bytes:
    return bytes.fromhex(text.replace("\\x", ""))


def states(
    recording: Recording, rng: random.Random, share: float = 1.0
) -> Iterator[tuple[State, list[str]]]:
    """Make the states that a loss of power may leave, each once for what was confirmed before.

    After each operation: all on the disk, and all with the end of the last write missing. Before
    each sync, and at the end: of the operations since the sync before, all subsets if they are few,
    else all but one, all but two and drawn ones, beside all and none of the earlier ones that no
    sync covers; and drawn subsets of all that no sync covers.

    Args:
      recording: what `record` returned.
      rng: draws subsets.
      share: the part of all states that is made, drawn by chance.

    Yields:
      A state, and the names that were confirmed before.
    """
    ops, made = recording.ops, set[tuple[str, int]]()
    confirmed: list[str] = []
    covered: list[int] = []
    earlier: list[int] = []
    window: list[int] = []
    for end in range(len(ops) + 1):
        op = ops[end] if end < len(ops) else None
        is_end = op is None or op.kind == "sync"
        for subset, is_torn in _subsets(earlier, window, rng) if is_end else _last(earlier, window):
            if rng.random() >= share:
                continue
            torn = max(subset, default=None) if is_torn else None
            done = [_torn(ops[i]) if i == torn else ops[i] for i in sorted([*covered, *subset])]
            state = _build(done, recording.folders)
            key = _digest(state), len(confirmed)
            if key not in made:
                made.add(key)
                yield state, list(confirmed)
        if op is None:
            return
        if op.kind == "confirm":
            confirmed.append(os.fsdecode(op.data))
        elif op.kind == "sync":
            open_ = [*earlier, *window]
            now = {i for i in open_ if i < op.started and _covers(op.node, ops[i])}
            covered += sorted(now)
            earlier, window = [i for i in open_ if i not in now], []
        else:
            window.append(end)


def _covers(node: int, op: Op) -> bool:
    """Return whether the sync of a file or folder covers an operation."""
    return node == op.node if op.kind != "names" else node in {folder for folder, _, _ in op.names}


_Subset = tuple[Sequence[int], bool]
"""Numbers of the operations on the disk, and whether the end of the last one is missing."""


def _last(earlier: Sequence[int], window: Sequence[int]) -> Iterator[_Subset]:
    yield [*earlier, *window], False
    yield [*earlier, *window], True


def _subsets(
    earlier: Sequence[int], window: Sequence[int], rng: random.Random
) -> Iterator[_Subset]:
    """Yield which of the operations that no sync covers are on the disk, all of them first."""
    yield from _last(earlier, window)
    if len(window) <= _ALL_SUBSETS:
        sizes, drawn = range(len(window) + 1), _DRAWN
    else:
        sizes, drawn = (len(window), len(window) - 1, len(window) - 2), _DRAWN_OF_MANY
    for size in sizes:
        for part in itertools.combinations(window, size):
            for before in (earlier, ()):
                yield [*before, *part], False
                yield [*before, *part], True
    for _ in range(drawn):
        share = rng.random()
        yield [i for i in (*earlier, *window) if rng.random() < share], rng.random() < 0.5


def _torn(op: Op) -> Op:
    """Return a write without its last block."""
    return op._replace(data=op.data[: (len(op.data) - 1) // _BLOCK * _BLOCK])


def _build(ops: Sequence[Op], folders: Collection[int]) -> State:
    """Return what a disk holds after these operations."""
    names: dict[tuple[int, str], int] = {}
    contents: dict[int, bytearray] = {}
    for op in ops:
        if op.kind == "names":
            for folder, name, node in op.names:
                if node is None:
                    names.pop((folder, name), None)
                else:
                    names[folder, name] = node
            continue
        content = contents.setdefault(op.node, bytearray())
        end = op.offset + len(op.data)
        if op.kind == "resize":
            del content[op.offset :]
        if len(content) < end:
            content.extend(bytes(end - len(content)))
        content[op.offset : end] = op.data
    inside: dict[int, list[tuple[str, int]]] = {}
    for (folder, name), node in names.items():
        inside.setdefault(folder, []).append((name, node))
    state: dict[str, bytes | None] = {}
    visited = {0}

    def walk(folder: int, path: str) -> None:
        for name, node in inside.get(folder, []):
            state[path + name] = None if node in folders else bytes(contents.get(node, b""))
            # A folder that has its old and its new name has both.
            if node in folders and node not in visited:
                visited.add(node)
                walk(node, f"{path}{name}/")

    walk(0, "")
    return state


def _digest(state: State) -> str:
    total = hashlib.sha256()
    for path, content in sorted(state.items()):
        total.update(f"{path}\n{-1 if content is None else len(content)}\n".encode())
        total.update(content or b"")
    return total.hexdigest()


def write_state(folder: Path, state: State) -> None:
    """Write a state into a folder, in the place of what was there."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for path, content in sorted(state.items()):
        if content is None:
            (folder / path).mkdir(mode=0o700)
        else:
            (folder / path).write_bytes(content)
