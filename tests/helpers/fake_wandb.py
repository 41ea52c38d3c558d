"""A stand-in for the package of Weights & Biases."""

import importlib.machinery
import types


class FakeWandb(types.ModuleType):
    """Stands in for the package: remembers what it is told, fails where it is asked to."""

    def __init__(self):
        super().__init__("wandb")
        self.__spec__ = importlib.machinery.ModuleSpec("wandb", None, origin="here")
        self.runs = []
        self.failing = set()

    def Video(self, path, format):
        return path, format

    def Settings(self, **settings):
        return settings

    def init(self, **arguments):
        if "init" in self.failing:
            raise RuntimeError("no network\nand much more")
        self.runs.append(FakeRun(self, arguments))
        return self.runs[-1]


class FakeRun:
    """One run of it."""

    offline = False
    url = "https://example.com/run"

    def __init__(self, wandb, arguments):
        self.wandb = wandb
        self.arguments = arguments
        self.logged = {}
        self.defined = {}
        self.finished = False

    def define_metric(self, name, **settings):
        self.defined[name] = settings

    def log(self, values, step):
        if "log" in self.wandb.failing:
            raise ValueError
        assert step == max(self.logged, default=step) or step > max(self.logged)
        assert not self.logged.get(step, {}).keys() & values.keys()
        self.logged.setdefault(step, {}).update(values)

    def finish(self):
        if "finish" in self.wandb.failing:
            raise TimeoutError("Timed out finishing run.")
        self.finished = True
