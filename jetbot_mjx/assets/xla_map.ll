; A block of the CPU's kernels with a table: all items of one robot. A template of `jetbot_mjx.compiler.ffi_wrapper`.
define internal void @block(ptr %job, i64 %index, ptr %scratch) {
  $addresses
  call void @$step($pointers)
  ret void
}
