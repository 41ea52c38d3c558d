"""Search for hyperparameters, with many trials side by side in one compiled program."""

from jetbot_mjx.imports import load_lazily as _load_lazily

__getattr__, __dir__ = _load_lazily(
    __name__,
    {
        "Parameter": "tuning.space",
        "Trials": "tuning.trials",
        "read_space": "tuning.space",
        "tune": "tuning.search",
    },
)
