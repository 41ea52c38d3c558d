"""The model of a GPU: what it computes, and what it refuses."""

import numpy as np
import pytest

from helpers import simt

SYNC = 'call void asm sideeffect "bar.sync 0;", "~{memory}"() #0'
WARP_SYNC = 'call void asm sideeffect "bar.warp.sync -1;", "~{memory}"() #0'


def module(body, arrays=1):
    """A kernel whose threads know their place in the block, and addresses in shared memory."""
    parameters = ", ".join(f"ptr addrspace(1) %a{i}" for i in range(arrays))
    return f"""
define ptx_kernel void @small({parameters}) {{
entry:
  %tid = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()
  %block = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
  %value = uitofp i32 %tid to float
  %own = getelementptr float, ptr addrspace(3) @shared, i32 %tid
  %neighbour = xor i32 %tid, 1
  %next = getelementptr float, ptr addrspace(3) @shared, i32 %neighbour
  %across = xor i32 %tid, 32
  %far = getelementptr float, ptr addrspace(3) @shared, i32 %across
  %out = getelementptr float, ptr addrspace(1) %a0, i32 %tid
{body}
  ret void
}}
!0 = !{{ptr @small, !"maxntidx", i32 64}}
"""


def run(body, *arrays, **options):
    arrays = arrays or (np.full(64, np.nan, np.float32),)
    simt.run(module(body, len(arrays)), arrays, shared_memory=256, **options)
    return arrays[0]


def exchange(*barriers, place="%next"):
    """Each thread writes a number, and reads that of another thread."""
    lines = "\n".join(barriers)
    return f"""
store float %value, ptr addrspace(3) %own
{lines}
%read = load float, ptr addrspace(3) {place}
store float %read, ptr addrspace(1) %out"""


@pytest.mark.parametrize(("place", "other"), [("%next", 1), ("%far", 32)])
def test_a_barrier_shows_each_thread_what_others_wrote(place, other):
    np.testing.assert_array_equal(run(exchange(SYNC, place=place)), np.arange(64) ^ other)


def test_a_warps_barrier_serves_its_lanes_and_nobody_else():
    np.testing.assert_array_equal(run(exchange(WARP_SYNC)), np.arange(64) ^ 1)
    with pytest.raises(simt.Fault, match="another thread writes it before"):
        run(exchange(WARP_SYNC, place="%far"))


@pytest.mark.parametrize("place", ["%next", "%far"])
def test_a_read_without_a_barrier_is_a_race(place):
    with pytest.raises(simt.Fault, match="another thread writes it before"):
        run(exchange(place=place))


def test_a_write_after_a_read_without_a_barrier_is_a_race():
    again = "store float %value, ptr addrspace(3) %far"
    with pytest.raises(simt.Fault, match="another thread reads it before"):
        run(exchange(SYNC) + "\n" + again)
    run(exchange(SYNC) + f"\n{SYNC}\n{again}")


def test_two_writers_of_one_word_must_agree():
    same = "store float 1.0, ptr addrspace(3) @shared"
    run(same)
    with pytest.raises(simt.Fault, match="different numbers together"):
        run("store float %value, ptr addrspace(3) @shared")
    with pytest.raises(simt.Fault, match="another thread writes it before"):
        run(exchange().split("%read")[0] + "store float -1.0, ptr addrspace(3) %next")


def named(count):
    """The two warps of a block each at a barrier of their own."""
    return f"""
%warp = udiv i32 %tid, 32
%number = add i32 %warp, 1
call void asm sideeffect "bar.sync $0, {count};", "r,~{{memory}}"(i32 %number) #0"""


def test_a_barrier_with_a_number_serves_those_who_come_to_it():
    np.testing.assert_array_equal(run(exchange(named(32))), np.arange(64) ^ 1)
    with pytest.raises(simt.Fault, match="another thread writes it before"):
        run(exchange(named(32), place="%far"))
    with pytest.raises(simt.Fault, match="never reach"):
        run(exchange(named(64)))
    both = named(64).replace("%number = add i32 %warp, 1", "%number = add i32 1, 0")
    np.testing.assert_array_equal(run(exchange(both, place="%far")), np.arange(64) ^ 32)


def when(limit, body):
    return f"""
%is.there = icmp ult i32 %tid, {limit}
br i1 %is.there, label %then, label %end
then:
{body}
br label %end
end:"""


def test_a_barrier_of_all_is_not_for_some():
    with pytest.raises(simt.Fault, match="never reach"):
        run(when(32, SYNC))
    with pytest.raises(simt.Fault, match="a part of a warp"):
        run(when(16, WARP_SYNC))


def test_blocks_may_not_access_what_others_write():
    write = """
%mine = getelementptr float, ptr addrspace(1) %a0, i32 %block
store float 1.0, ptr addrspace(1) %mine
"""
    np.testing.assert_array_equal(run(write, grid=(3, 1, 1))[:4], [1, 1, 1, np.nan])
    with pytest.raises(simt.Fault, match=r"another block .*'ctaid.x': 1}: %x = load"):
        run(f"{write}{SYNC}\n%x = load float, ptr addrspace(1) %a0", grid=(2, 1, 1))
    # The first block reads what the second one writes, which goes wrong in another order only.
    following = """
%k = xor i32 %block, 1
%there = getelementptr float, ptr addrspace(1) %a0, i32 %k
%x = load float, ptr addrspace(1) %there"""
    with pytest.raises(simt.Fault, match=r"another block .*'ctaid.x': 1}: store"):
        run(write + following, grid=(2, 1, 1))


@pytest.mark.parametrize("threads", [32, 64])
def test_threads_that_part_in_a_loop_meet_again_behind_it(threads):
    """Each thread counts to its number, and those that are odd double it."""
    body = f"""
br label %loop
loop:
%count = phi i32 [0, %entry], [%more, %loop]
%before = phi i32 [7, %entry], [%count, %loop]
%more = add i32 %count, 1
%again = icmp ult i32 %more, %tid
br i1 %again, label %loop, label %behind
behind:
%bit = and i32 %more, 1
%odd = icmp eq i32 %bit, 1
br i1 %odd, label %then, label %end
then:
%twice = mul i32 %more, 2
br label %end
end:
%both = phi i32 [%more, %behind], [%twice, %then]
{SYNC}
%sum = add i32 %both, %before
%float = uitofp i32 %sum to float
store float %float, ptr addrspace(1) %out"""
    more = np.maximum(np.arange(threads), 1)
    expected = more * (1 + more % 2) + np.where(more > 1, more - 2, 7)
    np.testing.assert_array_equal(run(body, threads=threads)[:threads], expected)


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("getelementptr i8, ptr addrspace(3) %own, i32 1", "misaligned"),
        ("getelementptr float, ptr addrspace(3) %own, i32 1", "beyond the 64 words"),
        ("getelementptr float, ptr addrspace(3) %own, i32 -1", "beyond the 64 words"),
        ("getelementptr i8, ptr addrspace(1) %out, i64 2", "misaligned"),
        ("getelementptr float, ptr addrspace(1) %out, i64 1", "beyond the 64 words"),
        ("getelementptr float, ptr addrspace(1) %out, i32 -1", "array"),
    ],
)
@pytest.mark.parametrize("access", ["%x = load float, {}", "store float 1.0, {}"])
def test_addresses_are_inside_of_arrays_and_aligned(access, address, reason):
    space = "ptr addrspace(3)" if "(3)" in address else "ptr addrspace(1)"
    with pytest.raises(simt.Fault, match=reason):
        run(f"%there = {address}\n{access.format(f'{space} %there')}")


def test_a_thread_that_does_not_run_may_have_any_address():
    far = "getelementptr float, ptr addrspace(1) %out, i32 32"
    run(when(32, f"%there = {far}\nstore float 1.0, ptr addrspace(1) %there"))


def test_a_byte_holds_numbers_up_to_255():
    body = """
%sum = fadd float %value, {}
%byte = fptoui float %sum to i8
%there = getelementptr i8, ptr addrspace(1) %a0, i32 %tid
store i8 %byte, ptr addrspace(1) %there"""
    result = run(body.format("0x4067E00000000000"), np.zeros(64, np.uint8))  # 191.0
    np.testing.assert_array_equal(result, np.arange(64) + 191)
    for number in ("0x4068400000000000", "-1.0", "0x7FF8000000000000"):
        with pytest.raises(simt.Fault, match="cannot hold it"):
            run(body.format(number), np.zeros(64, np.uint8))


def test_what_it_does_not_know_it_says():
    with pytest.raises(NotImplementedError, match="cmpxchg"):
        run("%x = cmpxchg ptr addrspace(3) %own, i32 0, i32 1 acq_rel monotonic")
