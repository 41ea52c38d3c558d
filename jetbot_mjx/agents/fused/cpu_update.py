"""Write all minibatches of a training step on CPUs as one call.

Each minibatch has the stages of its gradient, and then those of Adam, whose first one is joined
with the sum of the gradients: it squares what that has just written.
"""

from jetbot_mjx.agents.fused.adam import UPDATED, AdamRule
from jetbot_mjx.agents.fused.cpu_adam import adam_stages
from jetbot_mjx.agents.fused.cpu_gradient import BETWEEN, gradient_sizes, gradient_stages
from jetbot_mjx.agents.fused.cpu_stages import SQUARES, Call, JoinedStage
from jetbot_mjx.agents.fused.shapes import Minibatch

ARGUMENTS = (
    *("mean", "scale", "rows", "last", "unrolls", "noise", "terms", "adam_terms"),
    *UPDATED,
)
"""The arrays of `launch.update`; the last ones are changed in place, and returned."""


def update_call(rule: AdamRule, batch: Minibatch, lanes: int) -> Call:
    """Return the call, which takes `ARGUMENTS`.

    Args:
      rule: the networks, and how the step size changes.
      batch: the minibatch.
      lanes: the number of float32 values in a vector register.
    """
    sizes = {
        **rule.sizes,
        **gradient_sizes(rule.shape, batch, lanes),
        "squares": SQUARES,
    }
    *parts, total = gradient_stages(rule.shape, batch, lanes)
    squares, *rest = adam_stages(rule, lanes)
    stages = [*parts, JoinedStage(total, squares), *rest]
    results = *UPDATED, "gradient", "squares", *BETWEEN
    return Call(ARGUMENTS, results, sizes, stages, minibatches=batch.count)
