; What every thread of an NVIDIA GPU runs for a kernel with a table: items of one robot. A template of
; `jetbot_mjx.compiler.ptx_backend`: names after a dollar are filled in.
$declarations
declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
define ptx_kernel void @$name($parameters) {
entry:
  %thread = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()
  %block = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
  %wide = zext i32 %block to i64
  %before = mul i64 %wide, $items
  $loads
  $hoisted
  %is.any = icmp ult i32 %thread, $items
  br i1 %is.any, label %items, label %done
items:
  %item = phi i32 [%thread, %entry], [%next, %$end]
  %wide.item = zext i32 %item to i64
  %place = add i64 %before, %wide.item
  %first.byte = mul i64 %place, $results
  $columns
  $item
  $stores
  %next = add i32 %item, $threads
  %more = icmp ult i32 %next, $items
  br i1 %more, label %items, label %done
done:
  ret void
}
!nvvm.annotations = !{!0}
!0 = !{ptr @$name, !"maxntidx", i32 $max_threads}
