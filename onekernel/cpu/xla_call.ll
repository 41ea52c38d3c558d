; The function `kernel`, which XLA calls on a CPU, around a function `block`. It reads the call frame, and XLA's
; own threads take blocks from a job as long as there are any. Offsets are those of XLA's xla/ffi/api/c_api.h,
; version 0.3. The steps of a call:
;
; 1. `kernel` checks the call frame, makes a job of it, and asks XLA's thread pool for helpers (`ask_for_help`).
; 2. The calling thread and its helpers (`task`) each take the next block that nobody has begun (`work`).
; 3. `kernel` waits until all blocks have ended, and returns to XLA.
; 4. A helper may come later still. So a job counts who holds it, and the last one frees it (`release`).
;
; To read the text: `getelementptr` computes an address, here mostly that of a field so many bytes behind the
; start of a C structure, and the `load` after it reads the field. `atomicrmw` changes a number in memory as one
; step, whatever other threads do, and returns the number before. `acq_rel` and `acquire` let a thread see all
; that others wrote before; `monotonic` does not.
;
; `onekernel.cpu.xla_call` puts in front of this text what differs between kernels: the functions `block` and
; `needed`, the constants @instances_per_block, @blocks_per_instance, @blocks_per_thread and @scratch_bytes,
; and for the processor `begin`, `end` and `relax`.

; The state of one call, which its threads share. The fields: 0 number of blocks that were begun, 1 of blocks that
; have ended, 2 of threads that hold the job, 3 of all blocks, 4 of all instances, 5 the addresses of the
; arguments and then of the results.
%Job = type { i64, i64, i64, i64, i64, [0 x ptr] }
declare ptr @malloc(i64)
declare ptr @aligned_alloc(i64, i64)
declare void @free(ptr)
declare i32 @sched_yield()

; Lets go of a job; the last one frees it.
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

; Waits until so many blocks have ended. Other threads have begun them, so they will end without this thread.
define internal void @wait_for(ptr %job, i64 %count) {
entry:
  %ended.at = getelementptr %Job, ptr %job, i32 0, i32 1
  br label %check
check:
  %ended = load atomic i64, ptr %ended.at acquire, align 8
  %enough = icmp uge i64 %ended, %count
  br i1 %enough, label %done, label %wait
wait:
  ; A block takes microseconds. A thread that gives its core away gets it back later than that, so it first waits
  ; in a loop, and gives the core away after 1000 rounds, about 20 µs.
  %round = phi i64 [0, %check], [%round.next, %relax]
  %round.next = add i64 %round, 1
  %long = icmp uge i64 %round, 1000
  br i1 %long, label %yield, label %relax
relax:
  call void @relax()
  %seen = load atomic i64, ptr %ended.at acquire, align 8
  %over = icmp uge i64 %seen, %count
  br i1 %over, label %done, label %wait
yield:
  %ignored = call i32 @sched_yield()
  br label %check
done:
  ret void
}

; Returns memory to work with, which stays in the cache of a thread's core from block to block; null: there is none.
define internal ptr @make_scratch() {
  %bytes = load i64, ptr @scratch_bytes
  ; Never none, of which null would be the address.
  %some = call i64 @llvm.umax.i64(i64 %bytes, i64 64)
  %scratch = call ptr @aligned_alloc(i64 64, i64 %some)
  ret ptr %scratch
}

; Takes blocks as long as there are any, and frees the memory that it worked with.
define internal void @work(ptr %job, ptr %scratch) {
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
  %needed = call i64 @needed(ptr %job, i64 %index)
  call void @wait_for(ptr %job, i64 %needed)
  call void @block(ptr %job, i64 %index, ptr %scratch)
  %old = atomicrmw add ptr %ended, i64 1 acq_rel
  br label %take
done:
  call void @free(ptr %scratch)
  call void @end(i64 %mode)
  ret void
}

; The function that XLA's other threads run. They may begin when the work is done and the call is over. A thread without
; memory leaves the work to the others.
define internal void @task(ptr %job) {
  %scratch = call ptr @make_scratch()
  %none = icmp eq ptr %scratch, null
  br i1 %none, label %done, label %help
help:
  call void @work(ptr %job, ptr %scratch)
  br label %done
done:
  call void @release(ptr %job)
  ret void
}

; Every structure of the interface begins with its size.
define internal i1 @has_size(ptr %structure, i64 %size) {
  %told = load i64, ptr %structure
  %same = icmp eq i64 %told, %size
  ret i1 %same
}

; Frees an error, if it is one (XLA_FFI_Error_Destroy).
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

; Each function of XLA's interface takes the address of a structure: its size, an unused pointer, then the
; arguments.

; Makes the error that there is no memory (XLA_FFI_Error_Create, with the code 8 of exhausted resources).
@no_memory = internal constant [32 x i8] c"there is no memory for a kernel\00"
define internal ptr @out_of_memory(ptr %api) {
  %arguments = alloca [4 x i64]
  store [4 x i64] [i64 28, i64 0, i64 0, i64 8], ptr %arguments
  %message.at = getelementptr i8, ptr %arguments, i64 16
  store ptr @no_memory, ptr %message.at
  %function.at = getelementptr i8, ptr %api, i64 48
  %function = load ptr, ptr %function.at
  %error = call ptr %function(ptr %arguments)
  ret ptr %error
}

; Returns the number of XLA's threads (XLA_FFI_ThreadPool_NumThreads); one if it has none.
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

; Gives a job to one more thread (XLA_FFI_ThreadPool_Schedule).
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

; Copies the addresses of the arrays of some buffers (XLA_FFI_Buffer).
define internal void @copy_addresses(ptr %buffers, i64 %count, ptr %addresses) {
entry:
  br label %check
check:
  %i = phi i64 [0, %entry], [%i.next, %copy]
  %more = icmp ult i64 %i, %count
  br i1 %more, label %copy, label %done
copy:
  %buffer.at = getelementptr ptr, ptr %buffers, i64 %i
  %buffer = load ptr, ptr %buffer.at
  %data.at = getelementptr i8, ptr %buffer, i64 24
  %data = load ptr, ptr %data.at
  %address.at = getelementptr ptr, ptr %addresses, i64 %i
  store ptr %data, ptr %address.at
  %i.next = add i64 %i, 1
  br label %check
done:
  ret void
}

; The function that XLA calls: it takes a call frame, and returns null or an error. The frame's fields, by their offsets
; in bytes: 8 extensions, 16 the interface, 24 the context, 40 the arguments, 80 the results.
define ptr @kernel(ptr %frame) {
entry:
  %extension.at = getelementptr i8, ptr %frame, i64 8
  %extension = load ptr, ptr %extension.at
  %plain = icmp eq ptr %extension, null
  br i1 %plain, label %call, label %question
; XLA asks for the version of the interface (XLA_FFI_Metadata_Extension) when the function is registered: answer 0.3.
question:
  %kind.at = getelementptr i8, ptr %extension, i64 8
  %kind = load i32, ptr %kind.at
  %is.metadata = icmp eq i32 %kind, 1
  br i1 %is.metadata, label %answer, label %call
answer:
  %metadata.at = getelementptr i8, ptr %extension, i64 24
  %metadata = load ptr, ptr %metadata.at
  %major.at = getelementptr i8, ptr %metadata, i64 24
  store i32 0, ptr %major.at
  %minor.at = getelementptr i8, ptr %metadata, i64 28
  store i32 3, ptr %minor.at
  %traits.at = getelementptr i8, ptr %metadata, i64 32
  store i32 0, ptr %traits.at
  ret ptr null
call:
  %arguments = getelementptr i8, ptr %frame, i64 40
  %results = getelementptr i8, ptr %frame, i64 80
  %frame.fits = call i1 @has_size(ptr %frame, i64 168)
  br i1 %frame.fits, label %look, label %refuse
; Check the sizes of arguments, results and the first buffer, and the interface's major version. If one differs, do
; nothing: XLA is another version, and the probe of `obstacle` finds wrong numbers.
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
  %api.fits = icmp eq i32 %api.major, 0
  %fit.1 = and i1 %arguments.fit, %results.fit
  %fit.2 = and i1 %buffer.fits, %api.fits
  %fit = and i1 %fit.1, %fit.2
  br i1 %fit, label %prepare, label %refuse
refuse:
  ret ptr null
; The first size of the first argument is the number of instances. Round up to whole blocks.
prepare:
  %context.at = getelementptr i8, ptr %frame, i64 24
  %context = load ptr, ptr %context.at
  %sizes.at = getelementptr i8, ptr %buffer, i64 40
  %sizes = load ptr, ptr %sizes.at
  %instances = load i64, ptr %sizes
  %per.block = load i64, ptr @instances_per_block
  %fill = sub i64 %per.block, 1
  %rounded = add i64 %instances, %fill
  %groups = udiv i64 %rounded, %per.block
  %per.instance = load i64, ptr @blocks_per_instance
  %blocks = mul i64 %groups, %per.instance
  %argument.count.at = getelementptr i8, ptr %arguments, i64 16
  %argument.count = load i64, ptr %argument.count.at
  %result.count.at = getelementptr i8, ptr %results, i64 16
  %result.count = load i64, ptr %result.count.at
  %count = add i64 %argument.count, %result.count
  ; Make the job. Its size in bytes is the address behind its last array, in a job at address 0.
  %end = getelementptr %Job, ptr null, i32 0, i32 5, i64 %count
  %bytes = ptrtoint ptr %end to i64
  %job = call ptr @malloc(i64 %bytes)
  %no.job = icmp eq ptr %job, null
  br i1 %no.job, label %fail, label %fill.job
fill.job:
  store %Job { i64 0, i64 0, i64 1, i64 0, i64 0, [0 x ptr] zeroinitializer }, ptr %job
  %blocks.at = getelementptr %Job, ptr %job, i32 0, i32 3
  store i64 %blocks, ptr %blocks.at
  %instances.at = getelementptr %Job, ptr %job, i32 0, i32 4
  store i64 %instances, ptr %instances.at
  %outputs.at = getelementptr i8, ptr %results, i64 32
  %outputs = load ptr, ptr %outputs.at
  %given.at = getelementptr %Job, ptr %job, i32 0, i32 5, i64 0
  call void @copy_addresses(ptr %buffers, i64 %argument.count, ptr %given.at)
  %returned.at = getelementptr %Job, ptr %job, i32 0, i32 5, i64 %argument.count
  call void @copy_addresses(ptr %outputs, i64 %result.count, ptr %returned.at)
  %scratch = call ptr @make_scratch()
  %no.scratch = icmp eq ptr %scratch, null
  br i1 %no.scratch, label %free.job, label %count.threads
free.job:
  call void @free(ptr %job)
  br label %fail
fail:
  %error = call ptr @out_of_memory(ptr %api)
  ret ptr %error
  ; Ask for as many threads as XLA has, but not for more than the blocks are worth.
count.threads:
  %threads = call i64 @thread_count(ptr %api, ptr %context)
  %per.thread = load i64, ptr @blocks_per_thread
  %useful = udiv i64 %blocks, %per.thread
  %most = call i64 @llvm.umin.i64(i64 %threads, i64 %useful)
  br label %help
help:
  %helpers = phi i64 [1, %count.threads], [%helpers.next, %ask]
  %enough = icmp uge i64 %helpers, %most
  br i1 %enough, label %start, label %ask
ask:
  call void @ask_for_help(ptr %api, ptr %context, ptr %job)
  %helpers.next = add i64 %helpers, 1
  br label %help
; Work like the others, and return when all blocks have ended.
start:
  call void @work(ptr %job, ptr %scratch)
  call void @wait_for(ptr %job, i64 %blocks)
  call void @release(ptr %job)
  ret ptr null
}
declare i64 @llvm.umin.i64(i64, i64)
declare i64 @llvm.umax.i64(i64, i64)
