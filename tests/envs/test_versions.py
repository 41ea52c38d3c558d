"""Versions of the libraries on which results depend."""

import importlib.metadata
import re

from jetbot_mjx.envs.versions import LIBRARIES, installed_version


def test_each_library_is_pinned_and_has_the_version_that_is_installed(root):
    pinned = re.findall(r"^([\w-]+)==", (root / "constraints.txt").read_text(), re.MULTILINE)
    assert set(LIBRARIES) <= set(pinned)
    for library in LIBRARIES:
        assert installed_version(library) == importlib.metadata.version(library)


def test_a_library_that_is_not_installed_has_no_version():
    assert installed_version("no-such-library") is None
