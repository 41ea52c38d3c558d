"""The setting that an unknown key probably means."""

import pytest

from jetbot_mjx.config.keys import _OTHER_NAMES, ALL_KEYS, keys_meant_by, likely_key


def test_names_of_other_libraries_lead_to_settings_that_there_are():
    assert set(_OTHER_NAMES) <= set(ALL_KEYS)
    others = [name for names in _OTHER_NAMES.values() for name in names.split()]
    assert len(others) == len(set(others))
    assert not set(others) & {key.rpartition(".")[2] for key in ALL_KEYS}


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        ("lr", ["ppo.learning_rate"]),
        ("ppo.clip_range", ["ppo.clipping_epsilon"]),
        ("learning_rate", ["ppo.learning_rate"]),
        ("task.num_envs", ["ppo.num_envs"]),
        ("ppo.lerning_rate", ["ppo.learning_rate"]),
        ("seeed", ["seed"]),
        ("zzz", []),
    ],
)
def test_the_likeliest_key_is_found(key, meant):
    assert keys_meant_by(key) == meant


def test_a_similar_spelling_counts_only_where_that_is_asked_for():
    assert keys_meant_by("ppo.lerning_rate", similar=False) == []
    assert keys_meant_by("learning_rate", similar=False) == ["ppo.learning_rate"]


def test_a_key_written_with_a_dot_belongs_below_its_section():
    assert likely_key(["ppo.num_envs"]) == "write `num_envs` below `ppo:`, indented"


def test_where_nothing_is_like_it_the_keys_of_the_section_are_told():
    assert likely_key(["evaluation", "zzz"]) == "known are episodes, video"
    assert likely_key(["zzz"]).startswith("known are seed, ")
