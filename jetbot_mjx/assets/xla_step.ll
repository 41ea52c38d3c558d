; A step of some robots on a CPU. A template of `jetbot_mjx.compiler.ffi_wrapper`.
; Takes robots from the given one on through all steps: rows of a tile are numbers, columns are robots.
define internal void @robots($pointers, i64 %first, i64 %robots) {
entry:
  %tile = alloca [$rows x <$lanes x float>], align $alignment
  %last = sub i64 %robots, 1
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
  br i1 %more, label %read, label %before
before:
  $before
  br label %steps
steps:
  %count = phi i64 [0, %before], [%count.next, %steps]
  call void @$step(ptr %tile)
  %count.next = add i64 %count, 1
  %again = icmp ult i64 %count.next, $steps
  br i1 %again, label %steps, label %after
after:
  $after
  br label %write
write:
  %out = phi i64 [0, %after], [%out.next, %write]
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
