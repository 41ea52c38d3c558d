"""A stand-in for the trials of a search, which trains nothing."""

import functools
from typing import ClassVar

from jetbot_mjx.tuning.trials import Outcome


class Quick:
    """Stands for `Trials`: scores a learning rate by its distance to 3e-3, and notes its calls."""

    calls: ClassVar[list] = []
    scored_as = "learning"

    def __init__(self, config, names, evaluations):
        self.config, self.names = config, names

    def run(self, values, seeds, goes_on=lambda trial, outcome: True):
        # As in the program: arguments are numbers, and seeds of 32 bits.
        assert all(isinstance(one[name], int | float) for one in values for name in self.names)
        assert all(0 <= seed < 2**32 for seed in seeds)
        self.calls.append((self.config.ppo.unroll_length, len(values), tuple(seeds)))
        return [
            self.train(one["ppo.learning_rate"], seed, functools.partial(goes_on, i))
            for i, (one, seed) in enumerate(zip(values, seeds, strict=True))
        ]

    def train(self, learning_rate, seed, goes_on):
        # The smaller the rate the shorter the time, and below 7e-4 goals are missed.
        last = 1 - abs(learning_rate - 3e-3) * 10
        success = 1.0 if learning_rate >= 7e-4 else 0.99
        scores = {"learning": (0.5, last), "time": (success, success)}[self.scored_as]
        seconds = 1.0 + (self.scored_as == "time") * learning_rate
        if goes_on(Outcome(scores[:1], seconds, None)):
            return Outcome(scores, seconds, {"w": seed})
        return Outcome(scores[:1], seconds, None)

    def evaluate(self, params, keys):
        class Seen:
            success = [[1.0, 0.0]] * len(params["w"])
            steps = [[60.0, 10.0]] * len(params["w"])

        return Seen
