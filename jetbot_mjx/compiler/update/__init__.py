"""Write and launch the kernels of PPO's update on NVIDIA GPUs; docs/update.md explains them.

- `tensor_core`: LLVM IR with products on tensor cores
- `shapes`: the networks and the minibatch, and their division into tiles
- `network`: what both kernels share: loading a network, and its forward pass
- `advantages`: the kernel that computes values, advantages and value targets
- `gradient`: the kernel that computes the gradient of both networks
- `launch`: both kernels as one JAX function
"""
