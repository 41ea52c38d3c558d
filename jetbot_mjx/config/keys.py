"""List the keys of all settings, and find the one that an unknown key probably means."""

import difflib
from collections.abc import Sequence

from jetbot_mjx.config.run import Config

ALL_KEYS = tuple(Config().flat())
"""Every setting with its section, such as `ppo.learning_rate`."""


_OTHER_NAMES = {
    "lr": "ppo.learning_rate",
    "gamma": "ppo.discounting",
    "discount": "ppo.discounting",
    "lam": "ppo.gae_lambda",
    "n_envs": "ppo.num_envs",
    "n_steps": "ppo.unroll_length",
    "num_steps": "ppo.unroll_length",
    "n_epochs": "ppo.num_updates_per_batch",
    "num_epochs": "ppo.num_updates_per_batch",
    "update_epochs": "ppo.num_updates_per_batch",
    "total_timesteps": "ppo.num_timesteps",
    "timesteps": "ppo.num_timesteps",
    "minibatches": "ppo.num_minibatches",
    "minibatch_size": "ppo.batch_size",
    "clip_range": "ppo.clipping_epsilon",
    "clip_coef": "ppo.clipping_epsilon",
    "ent_coef": "ppo.entropy_cost",
    "entropy_coef": "ppo.entropy_cost",
    "vf_coef": "ppo.vf_loss_coefficient",
    "target_kl": "ppo.desired_kl",
    "net_arch": "ppo.network.policy_hidden_layer_sizes",
    "random_seed": "seed",
    "num_seeds": "seeds",
    "n_seeds": "seeds",
}
"""Settings by the names that Stable-Baselines3, CleanRL, rsl_rl and Brax have for them; they are
suggested, and not accepted."""


def keys_meant_by(key: str, *, similar: bool = True) -> list[str]:
    """Return the full keys that were probably meant by an unknown one, the likeliest first.

    Args:
      key: the key, with its section or without, perhaps as another library calls it.
      similar: whether keys that are only spelt like it count too.
    """
    section, _, last = key.rpartition(".")
    if last in _OTHER_NAMES:
        return [_OTHER_NAMES[last]]
    # A key may be that of another section, such as learning_rate without `ppo.`.
    names = {known: known.rpartition(".")[2] for known in ALL_KEYS}
    likely = [known for known, name in names.items() if last == name]
    if likely or not similar:
        return likely
    own = [known for known in ALL_KEYS if known.rpartition(".")[0] == section]
    for keys, cutoff in ((own, 0.6), (ALL_KEYS, 0.8)):
        close = difflib.get_close_matches(last, {names[known] for known in keys}, 1, cutoff)
        likely = [known for known in keys if names[known] in close]
        if likely:
            return likely
    return difflib.get_close_matches(key, ALL_KEYS, 1, 0.8)


def likely_key(location: Sequence[str]) -> str:
    """Return a remedy for an unknown key: the one that was probably meant, or all there are."""
    *sections, key = location
    # YAML nests what `--set` writes with dots.
    if not sections and key in ALL_KEYS:
        section, _, last = key.rpartition(".")
        return f"write `{last}` below `{section}:`, indented"
    if likely := keys_meant_by(".".join(location)):
        return f"did you mean {' or '.join(likely)}?"
    section = Config()
    for name in sections:
        section = getattr(section, name, Config())
    return f"known are {', '.join(type(section).model_fields)}"
