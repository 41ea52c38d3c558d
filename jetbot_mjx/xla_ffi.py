"""A kernel as a function that XLA calls on a CPU, in LLVM's intermediate representation.

XLA hands over one address, of a call frame. Around a `step` of as many robots as a vector register
has lanes, what is written here reads the frame, deals blocks of robots to XLA's own threads, and
moves each block between XLA's arrays and a tile, of which a row holds one number of every robot.
No Python takes part.

Offsets are those of XLA's C header `xla/ffi/api/c_api.h`, version 0.3. Every structure tells its
size; where one is other than expected, nothing is done.
"""

from collections.abc import Sequence
from string import Template

from jetbot_mjx.llvm import STEP

VERSION = (0, 3)
"""Of the interface."""

SYMBOLS = ("malloc", "free", "sched_yield")
"""What a kernel calls of the C library."""

_BLOCKS_PER_THREAD = 4
"""Fewer are done sooner than another thread wakes."""

# Subnormal numbers are zeros: on whichever thread, for XLA's own have it so and others may not.
_SUBNORMALS = {
    "x86_64": """
declare void @llvm.x86.sse.stmxcsr(ptr)
declare void @llvm.x86.sse.ldmxcsr(ptr)
define internal i64 @begin() {
  %place = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %place)
  %before = load i32, ptr %place
  %flushing = or i32 %before, 32832
  store i32 %flushing, ptr %place
  call void @llvm.x86.sse.ldmxcsr(ptr %place)
  %wide = zext i32 %before to i64
  ret i64 %wide
}
define internal void @end(i64 %before) {
  %place = alloca i32
  %narrow = trunc i64 %before to i32
  store i32 %narrow, ptr %place
  call void @llvm.x86.sse.ldmxcsr(ptr %place)
  ret void
}
""",
    "aarch64": """
declare i64 @llvm.aarch64.get.fpcr()
declare void @llvm.aarch64.set.fpcr(i64)
define internal i64 @begin() {
  %before = call i64 @llvm.aarch64.get.fpcr()
  %flushing = or i64 %before, 16777216
  call void @llvm.aarch64.set.fpcr(i64 %flushing)
  ret i64 %before
}
define internal void @end(i64 %before) {
  call void @llvm.aarch64.set.fpcr(i64 %before)
  ret void
}
""",
}
MACHINES = tuple(_SUBNORMALS)
"""Processors that a kernel can be written for."""

# A job: counters of blocks begun and ended, and of those that hold it; blocks, robots, addresses.
_JOB = """
%Job = type { i64, i64, i64, i64, i64, [$arrays x ptr] }
declare ptr @malloc(i64)
declare void @free(ptr)
declare i32 @sched_yield()

define internal void @block(ptr %job, i64 %index) {
entry:
  %tile = alloca [$rows x <$lanes x float>], align $alignment
  %robots.at = getelementptr %Job, ptr %job, i32 0, i32 4
  %robots = load i64, ptr %robots.at
  %last = sub i64 %robots, 1
  %first = mul i64 %index, $lanes
  $addresses
  br label %read
read:
  %lane = phi i64 [0, %entry], [%lane.next, %read]
  %wanted = add i64 %first, %lane
  ; Lanes beyond the last robot do what it does.
  %there = icmp ult i64 %wanted, %robots
  %robot = select i1 %there, i64 %wanted, i64 %last
  $reads
  %lane.next = add i64 %lane, 1
  %more = icmp ult i64 %lane.next, $lanes
  br i1 %more, label %read, label %steps
steps:
  %count = phi i64 [0, %read], [%count.next, %steps]
  call void @$step(ptr %tile)
  %count.next = add i64 %count, 1
  %again = icmp ult i64 %count.next, $steps
  br i1 %again, label %steps, label %write
write:
  %out = phi i64 [0, %steps], [%out.next, %write]
  %to = add i64 %first, %out
  $writes
  %out.next = add i64 %out, 1
  %to.next = add i64 %to, 1
  %inside = icmp ult i64 %out.next, $lanes
  %exists = icmp ult i64 %to.next, %robots
  %on = and i1 %inside, %exists
  br i1 %on, label %write, label %done
done:
  ret void
}

define internal void @release(ptr %job) {
  %holders = getelementptr %Job, ptr %job, i32 0, i32 2
  %before = atomicrmw sub ptr %holders, i64 1 acq_rel
  %is.last = icmp eq i64 %before, 1
  br i1 %is.last, label %drop, label %done
drop:
  call void @free(ptr %job)
  ret void
done:
  ret void
}

define internal void @work(ptr %job) {
entry:
  %blocks.at = getelementptr %Job, ptr %job, i32 0, i32 3
  %blocks = load i64, ptr %blocks.at
  %ended = getelementptr %Job, ptr %job, i32 0, i32 1
  %mode = call i64 @begin()
  br label %take
take:
  %index = atomicrmw add ptr %job, i64 1 monotonic
  %is.left = icmp ult i64 %index, %blocks
  br i1 %is.left, label %do, label %done
do:
  call void @block(ptr %job, i64 %index)
  %old = atomicrmw add ptr %ended, i64 1 release
  br label %take
done:
  call void @end(i64 %mode)
  ret void
}

define internal void @task(ptr %job) {
  call void @work(ptr %job)
  call void @release(ptr %job)
  ret void
}
"""

_HANDLER = """
define internal i1 @has_size(ptr %structure, i64 %size) {
  %told = load i64, ptr %structure
  %same = icmp eq i64 %told, %size
  ret i1 %same
}

define internal void @forgive(ptr %api, ptr %error) {
entry:
  %none = icmp eq ptr %error, null
  br i1 %none, label %done, label %destroy
destroy:
  %arguments = alloca [3 x i64]
  store [3 x i64] [i64 24, i64 0, i64 0], ptr %arguments
  %error.at = getelementptr i8, ptr %arguments, i64 16
  store ptr %error, ptr %error.at
  %function.at = getelementptr i8, ptr %api, i64 64
  %function = load ptr, ptr %function.at
  call void %function(ptr %arguments)
  br label %done
done:
  ret void
}

define internal i64 @thread_count(ptr %api, ptr %context) {
  %count = alloca i64
  store i64 1, ptr %count
  %arguments = alloca [4 x i64]
  store [4 x i64] [i64 32, i64 0, i64 0, i64 0], ptr %arguments
  %context.at = getelementptr i8, ptr %arguments, i64 16
  store ptr %context, ptr %context.at
  %count.at = getelementptr i8, ptr %arguments, i64 24
  store ptr %count, ptr %count.at
  %function.at = getelementptr i8, ptr %api, i64 144
  %function = load ptr, ptr %function.at
  %error = call ptr %function(ptr %arguments)
  call void @forgive(ptr %api, ptr %error)
  %result = load i64, ptr %count
  ret i64 %result
}

define internal void @ask_for_help(ptr %api, ptr %context, ptr %job) {
  %holders = getelementptr %Job, ptr %job, i32 0, i32 2
  %before = atomicrmw add ptr %holders, i64 1 monotonic
  %arguments = alloca [5 x i64]
  store [5 x i64] [i64 40, i64 0, i64 0, i64 0, i64 0], ptr %arguments
  %context.at = getelementptr i8, ptr %arguments, i64 16
  store ptr %context, ptr %context.at
  %task.at = getelementptr i8, ptr %arguments, i64 24
  store ptr @task, ptr %task.at
  %job.at = getelementptr i8, ptr %arguments, i64 32
  store ptr %job, ptr %job.at
  %function.at = getelementptr i8, ptr %api, i64 136
  %function = load ptr, ptr %function.at
  %error = call ptr %function(ptr %arguments)
  %helped = icmp eq ptr %error, null
  br i1 %helped, label %done, label %alone
alone:
  call void @release(ptr %job)
  call void @forgive(ptr %api, ptr %error)
  ret void
done:
  ret void
}

define ptr @$name(ptr %frame) {
entry:
  %extension.at = getelementptr i8, ptr %frame, i64 8
  %extension = load ptr, ptr %extension.at
  %plain = icmp eq ptr %extension, null
  br i1 %plain, label %call, label %question
question:
  %kind.at = getelementptr i8, ptr %extension, i64 8
  %kind = load i32, ptr %kind.at
  %is.metadata = icmp eq i32 %kind, 1
  br i1 %is.metadata, label %answer, label %call
answer:
  %metadata.at = getelementptr i8, ptr %extension, i64 24
  %metadata = load ptr, ptr %metadata.at
  %major.at = getelementptr i8, ptr %metadata, i64 24
  store i32 $major, ptr %major.at
  %minor.at = getelementptr i8, ptr %metadata, i64 28
  store i32 $minor, ptr %minor.at
  %traits.at = getelementptr i8, ptr %metadata, i64 32
  store i32 0, ptr %traits.at
  ret ptr null
call:
  %arguments = getelementptr i8, ptr %frame, i64 40
  %results = getelementptr i8, ptr %frame, i64 80
  %frame.fits = call i1 @has_size(ptr %frame, i64 168)
  br i1 %frame.fits, label %look, label %refuse
look:
  %arguments.fit = call i1 @has_size(ptr %arguments, i64 40)
  %results.fit = call i1 @has_size(ptr %results, i64 40)
  %buffers.at = getelementptr i8, ptr %arguments, i64 32
  %buffers = load ptr, ptr %buffers.at
  %buffer = load ptr, ptr %buffers
  %buffer.fits = call i1 @has_size(ptr %buffer, i64 48)
  %api.at = getelementptr i8, ptr %frame, i64 16
  %api = load ptr, ptr %api.at
  %api.major.at = getelementptr i8, ptr %api, i64 32
  %api.major = load i32, ptr %api.major.at
  %api.fits = icmp eq i32 %api.major, $major
  %fit.1 = and i1 %arguments.fit, %results.fit
  %fit.2 = and i1 %buffer.fits, %api.fits
  %fit = and i1 %fit.1, %fit.2
  br i1 %fit, label %prepare, label %refuse
refuse:
  ret ptr null
prepare:
  %context.at = getelementptr i8, ptr %frame, i64 24
  %context = load ptr, ptr %context.at
  %sizes.at = getelementptr i8, ptr %buffer, i64 40
  %sizes = load ptr, ptr %sizes.at
  %robots = load i64, ptr %sizes
  %rounded = add i64 %robots, $fill
  %blocks = udiv i64 %rounded, $lanes
  %end = getelementptr %Job, ptr null, i32 1
  %bytes = ptrtoint ptr %end to i64
  %job = call ptr @malloc(i64 %bytes)
  store %Job { i64 0, i64 0, i64 1, i64 0, i64 0, [$arrays x ptr] zeroinitializer }, ptr %job
  %blocks.at = getelementptr %Job, ptr %job, i32 0, i32 3
  store i64 %blocks, ptr %blocks.at
  %robots.at = getelementptr %Job, ptr %job, i32 0, i32 4
  store i64 %robots, ptr %robots.at
  %outputs.at = getelementptr i8, ptr %results, i64 32
  %outputs = load ptr, ptr %outputs.at
  $pointers
  %threads = call i64 @thread_count(ptr %api, ptr %context)
  %useful = udiv i64 %blocks, $blocks_per_thread
  %most = call i64 @llvm.umin.i64(i64 %threads, i64 %useful)
  br label %help
help:
  %helpers = phi i64 [1, %prepare], [%helpers.next, %ask]
  %enough = icmp uge i64 %helpers, %most
  br i1 %enough, label %start, label %ask
ask:
  call void @ask_for_help(ptr %api, ptr %context, ptr %job)
  %helpers.next = add i64 %helpers, 1
  br label %help
start:
  call void @work(ptr %job)
  %ended.at = getelementptr %Job, ptr %job, i32 0, i32 1
  br label %check
check:
  ; Those that are begun and not ended are in other threads' hands, and none of them waits.
  %ended = load atomic i64, ptr %ended.at acquire, align 8
  %all = icmp eq i64 %ended, %blocks
  br i1 %all, label %done, label %wait
wait:
  %ignored = call i32 @sched_yield()
  br label %check
done:
  call void @release(ptr %job)
  ret ptr null
}
declare i64 @llvm.umin.i64(i64, i64)
"""


def kernel_text(
    step: str, sizes: Sequence[int], *, carried: int, lanes: int, steps: int, name: str, machine: str
) -> str:
    """Writes what XLA calls.

    It takes float32 arrays of (robots, ...) and returns as many as are carried.

    Args:
      step: the text of what `lanes` robots do once.
      sizes: of each argument, how many numbers one robot has.
      carried: how many of the arguments change, and are the results.
      lanes: robots in a block.
      steps: how often each robot makes the step.
      name: of the function, a C identifier.
      machine: the processor, of `MACHINES`.

    Returns:
      The text of a module.
    """
    arrays = len(sizes) + carried
    values = {
        "addresses": "\n  ".join(_address(i) for i in range(arrays)),
        "alignment": 4 * lanes,
        "arrays": arrays,
        "blocks_per_thread": _BLOCKS_PER_THREAD,
        "fill": lanes - 1,
        "lanes": lanes,
        "major": VERSION[0],
        "minor": VERSION[1],
        "name": name,
        "pointers": "\n  ".join(_pointer(i, len(sizes)) for i in range(arrays)),
        "reads": "\n  ".join(_reads(sizes, lanes)),
        "rows": max(1, sum(sizes)),
        "step": STEP,
        "steps": steps,
        "writes": "\n  ".join(_writes(sizes[:carried], len(sizes), lanes)),
    }
    return _SUBNORMALS[machine] + step + Template(_JOB + _HANDLER).substitute(values)


def _address(i: int) -> str:
    """Array `i` of a job."""
    return (
        f"%a{i}.at = getelementptr %Job, ptr %job, i32 0, i32 5, i64 {i}\n"
        f"  %a{i} = load ptr, ptr %a{i}.at"
    )


def _pointer(i: int, arguments: int) -> str:
    """Copies the address of an argument, or of a result, from the call frame into a job."""
    source, place = ("buffers", i) if i < arguments else ("outputs", i - arguments)
    return (
        f"%b{i}.at = getelementptr ptr, ptr %{source}, i64 {place}\n"
        f"  %b{i} = load ptr, ptr %b{i}.at\n"
        f"  %d{i}.at = getelementptr i8, ptr %b{i}, i64 24\n"
        f"  %d{i} = load ptr, ptr %d{i}.at\n"
        f"  %j{i} = getelementptr %Job, ptr %job, i32 0, i32 5, i64 {i}\n"
        f"  store ptr %d{i}, ptr %j{i}"
    )


def _reads(sizes: Sequence[int], lanes: int) -> list[str]:
    lines, row = [], 0
    for i, size in enumerate(sizes):
        lines.append(f"%r{i} = mul i64 %robot, {size}")
        for j in range(size):
            lines += [
                f"%ri{i}.{j} = add i64 %r{i}, {j}",
                f"%rp{i}.{j} = getelementptr float, ptr %a{i}, i64 %ri{i}.{j}",
                f"%rv{i}.{j} = load float, ptr %rp{i}.{j}",
                f"%rt{i}.{j} = getelementptr <{lanes} x float>, ptr %tile, i64 {row}, i64 %lane",
                f"store float %rv{i}.{j}, ptr %rt{i}.{j}",
            ]
            row += 1
    return lines


def _writes(sizes: Sequence[int], first: int, lanes: int) -> list[str]:
    lines, row = [], 0
    for i, size in enumerate(sizes, start=first):
        lines.append(f"%w{i} = mul i64 %to, {size}")
        for j in range(size):
            lines += [
                f"%wt{i}.{j} = getelementptr <{lanes} x float>, ptr %tile, i64 {row}, i64 %out",
                f"%wv{i}.{j} = load float, ptr %wt{i}.{j}",
                f"%wi{i}.{j} = add i64 %w{i}, {j}",
                f"%wp{i}.{j} = getelementptr float, ptr %a{i}, i64 %wi{i}.{j}",
                f"store float %wv{i}.{j}, ptr %wp{i}.{j}",
            ]
            row += 1
    return lines
