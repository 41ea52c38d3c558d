"""Write and launch the kernels of PPO; docs/kernels.md explains them and defines their words.

- `shapes`: the networks, the data, and the step of an unroll
- `sample_loss`: the action of one sample, and its loss with derivatives, as JAX functions
- `adam`: a step of Adam along the gradient, as JAX functions
- `arrays`: the arrays that the kernels take and return, with their axes
- `launch`: the kernels as JAX functions, for every platform
- `layout`: parameters and moments as vectors
- `learner`: the kernels as a learner of `PPO`
- `probe`: the check that a GPU's kernels compute correctly

On GPUs:

- `gpu_tiling`: the division of the work into tiles
- `tensor_core`: a kernel and its writer, with products on tensor cores
- `gpu_network`: what all kernels share: loading a network, and its forward pass
- `gpu_actions`: the kernel that draws the actions of all environments
- `gpu_advantages`: the kernel that computes values, advantages and value targets
- `gpu_gradient`: the kernel that computes the gradient of both networks
- `gpu_adam`: the kernel of Adam
- `launch_gpu`: their launch

On CPUs:

- `cpu_product`: products of matrices, and loops over numbers in memory
- `cpu_stages`: a call whose threads go through several stages together
- `cpu_network`: a stage that takes rows through a network, and its forward pass
- `cpu_actions`: the calls that draw the actions of all environments, for one step or for all
  steps of an unroll
- `cpu_gradient`: the stages of the gradient: of the value network, of the policy, and the sum
- `cpu_adam`: the stages of Adam, and all minibatches as one call
- `launch_cpu`: their launch

For web pages:

- `web`: the kernels of CPUs as WebAssembly, and what a script must know of them

What the work is divided into, from the largest to the smallest:

- GPU: launch > replica > network > block > tile of rows > warp > lane
- CPU: call > minibatch > stage > part of one replica (a block of `xla_call.ll`) > tile of rows >
  group of as many rows as a vector has lanes
"""
