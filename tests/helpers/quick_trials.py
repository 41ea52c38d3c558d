"""A stand-in for the trials of a search, which trains nothing."""

from typing import ClassVar

from jetbot_mjx.tuning.trials import Outcome


class Quick:
    """Stands for `Trials`: scores a learning rate by its distance to 3e-3, and notes its calls."""

    calls: ClassVar[list] = []

    def __init__(self, config, names, evaluations):
        self.config, self.names = config, names

    def run(self, values, seeds):
        # As in the program: arguments are numbers, and seeds of 32 bits.
        assert all(isinstance(one[name], int | float) for one in values for name in self.names)
        assert all(0 <= seed < 2**32 for seed in seeds)
        self.calls.append((self.config.ppo.unroll_length, len(values), tuple(seeds)))
        return [
            Outcome((0.5, 1 - abs(one["ppo.learning_rate"] - 3e-3) * 10), 1.0, {"w": seed})
            for one, seed in zip(values, seeds, strict=True)
        ]

    def evaluate(self, params, keys):
        class Seen:
            success = [[1.0, 0.0]] * len(params["w"])
            steps = [[60.0, 10.0]] * len(params["w"])

        return Seen
