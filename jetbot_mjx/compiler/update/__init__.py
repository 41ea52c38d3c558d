"""Write and launch the kernels of PPO's update, as docs/update.md explains them.

- `shapes`: the networks and the minibatch, and their division into tiles
- `launch`: the kernels as one JAX function, for every platform

On GPUs:

- `tensor_core`: LLVM IR with products on tensor cores
- `network`: what both kernels share: loading a network, and its forward pass
- `advantages`: the kernel that computes values, advantages and value targets
- `gradient`: the kernel that computes the gradient of both networks
- `launch_gpu`: their launch

On CPUs:

- `vector_code`: LLVM IR with loops, vectors and products of matrices
- `sample_loss`: the loss of one sample with its derivatives, as JAX functions
- `cpu_kernels`: a kernel for each network
- `launch_cpu`: their launch
"""
