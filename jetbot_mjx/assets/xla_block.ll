; A block of the CPU's kernels that step. A template of `jetbot_mjx.compiler.ffi_wrapper`.
define internal void @block(ptr %job, i64 %index, ptr %scratch) {
  %robots.at = getelementptr %Job, ptr %job, i32 0, i32 4
  %robots = load i64, ptr %robots.at
  %first = mul i64 %index, $lanes
  $addresses
  call void @robots($arrays, i64 %first, i64 %robots)
  ret void
}
