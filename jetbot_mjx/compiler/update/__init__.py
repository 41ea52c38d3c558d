"""Write and launch the kernels of PPO, as docs/update.md explains them.

- `shapes`: the networks and the minibatch, and their division into tiles
- `adam`: a step of Adam along the gradient
- `launch`: the kernels as JAX functions, for every platform

On GPUs:

- `tensor_core`: LLVM IR with products on tensor cores
- `network`: what all kernels share: loading a network, and its forward pass
- `distribution`: the distribution of an action
- `actions`: the kernel that draws the actions of all environments
- `advantages`: the kernel that computes values, advantages and value targets
- `gradient`: the kernel that computes the gradient of both networks
- `gpu_adam`: the kernel of Adam
- `launch_gpu`: their launch

On CPUs:

- `vector_code`: LLVM IR with loops, vectors and products of matrices
- `sample_loss`: the action of one sample, and its loss with derivatives, as JAX functions
- `cpu_stages`: a call whose threads go through several stages together
- `cpu_network`: a stage that takes rows through a network, and its forward pass
- `cpu_actions`: the call that draws the actions of all environments
- `cpu_gradient`: the stages of the gradient, one for each network and the sum
- `cpu_adam`: the stages of Adam
- `cpu_update`: all minibatches as one call
- `launch_cpu`: their launch
"""
