"""Text that is not YAML, or holds no settings, is refused in one line."""

import re

import pytest

from jetbot_mjx.config import ConfigError, load_config
from jetbot_mjx.errors import printable

BAD_YAML = {
    "key given twice": ("seed: 1\nrobot: {}\nseed: 2", 'line 3 is not valid YAML: .* "seed"'),
    "nested key given twice": ("ppo: {num_envs: 3, num_envs: 4}", 'line 1 .* "num_envs"'),
    "open bracket": ("seed: 1\nppo: [", "line 2 is not valid YAML"),
    "open quote": ("seed: 'x", "line 1 is not valid YAML"),
    "tab": ("ppo:\n\tseed: 1", "line 2 is not valid YAML: a tab: indent by spaces"),
    "two colons": ("a: b: c", "line 1 is not valid YAML: mapping values are not allowed"),
    "unknown alias": ("seed: *nowhere", "line 1 is not valid YAML: .*nowhere"),
    "tag that runs code": ("seed: !!python/object:os.system x", "line 1 .* could not determine"),
    "two documents": ("seed: 1\n---\nseed: 2", "is not valid YAML: but found another document"),
    "control character": ("seed: 1\x07", "is not valid YAML: unacceptable character"),
    "list": ("- 1\n- 2", r"holds \[1, 2\]: write `key: value` lines"),
    "text": ("seed 3", "holds 'seed 3': write `key: value` lines"),
    "number": ("3", "holds 3: write `key: value` lines"),
    "deep brackets": ("a: " + "[" * 3000, "is not valid YAML: it is nested too deeply"),
    "as many values": ("a: [" + "1," * 21_000 + "1]", "has more than 20,000 values: leave some"),
    "a model": ("\n<mujoco/>", r"mine.yaml is XML, not YAML: name a robot's model in a conf"),
}


@pytest.mark.parametrize(("text", "pattern"), BAD_YAML.values(), ids=BAD_YAML)
def test_a_file_that_is_no_mapping_is_refused(refusal, text, pattern):
    message = refusal(text)
    assert "mine.yaml" in message
    assert re.search(pattern, message)


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("missing.yaml", "does not exist: give the path of a YAML file"),
        ("folder", "is a folder: give a YAML file"),
        ("picture.png", "cannot be read: it is not UTF-8 text"),
        ("picture.png/x.yaml", "cannot be read: Not a directory"),
        (f"{'x' * 300}.yaml", "cannot be read: File name too long"),
        ("a\0b.yaml", "cannot be read: embedded null byte"),
    ],
)
def test_a_path_that_is_no_text_file_is_refused(tmp_path, name, remedy):
    (tmp_path / "folder").mkdir()
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n\x00\xff")
    with pytest.raises(ConfigError) as caught:
        load_config(tmp_path / name)
    assert str(caught.value) == printable(f"config {tmp_path / name} {remedy}")
