"""List the keys of all settings, and find the one that an unknown key probably means."""

import difflib
from collections.abc import Sequence

from jetbot_mjx.config.run import Config

ALL_KEYS = tuple(Config().flat())
"""Every setting with its section, such as `ppo.learning_rate`."""


_OTHER_NAMES = {
    "ppo.learning_rate": "lr",
    "ppo.discounting": "gamma discount",
    "ppo.gae_lambda": "lam",
    "ppo.num_envs": "n_envs",
    "ppo.unroll_length": "n_steps num_steps",
    "ppo.num_updates_per_batch": "n_epochs num_epochs update_epochs",
    "ppo.num_timesteps": "total_timesteps timesteps",
    "ppo.num_minibatches": "minibatches",
    "ppo.batch_size": "minibatch_size",
    "ppo.clipping_epsilon": "clip_range clip_coef",
    "ppo.entropy_cost": "ent_coef entropy_coef",
    "ppo.vf_loss_coefficient": "vf_coef",
    "ppo.desired_kl": "target_kl",
    "ppo.network.policy_hidden_layer_sizes": "net_arch",
    "seed": "random_seed",
    "seeds": "num_seeds n_seeds",
}
"""The names that Stable-Baselines3, CleanRL, rsl_rl and Brax have for settings; they are suggested,
and not accepted."""


def keys_meant_by(key: str, *, similar: bool = True) -> list[str]:
    """Return the full keys that were probably meant by an unknown one, the likeliest first.

    Args:
      key: the key, with its section or without, perhaps as another library calls it.
      similar: whether keys that are only spelt like it count too.
    """
    section, _, last = key.rpartition(".")
    if meant := [known for known, names in _OTHER_NAMES.items() if last in names.split()]:
        return meant
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
    if len(sections) > 1 and sections[0] != sections[1] in Config.model_fields:
        return f"{sections[1]} is a section of its own, beside {sections[0]}"
    if likely := keys_meant_by(".".join(location)):
        return f"did you mean {' or '.join(likely)}?"
    section = Config()
    for name in sections:
        section = getattr(section, name, Config())
    return f"known are {', '.join(type(section).model_fields)}"
