"""What a web page of a policy is made of, once for all tests of a process."""

import base64
import functools
from typing import Any, NamedTuple

import pytest

from helpers import node
from jetbot_mjx.deployment.web_page import page_data
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint import Checkpoint, load_checkpoint
from onekernel import wasm

_LOAD = "const engine = await Engine.load(bytesOf(given.data.module), given.data.meta);"


class Page(NamedTuple):
    """The policy of a page, its environment, and what the page is made of."""

    checkpoint: Checkpoint
    env: JetBotEnv
    data: dict[str, Any]

    @property
    def module(self) -> bytes:
        """Return the WebAssembly module."""
        return base64.b64decode(self.data["module"])

    def run(self, body: str, **given: Any) -> Any:
        """Run a function in Node that has the page's `engine`, as `node.run`."""
        return node.run(_LOAD + body, data=self.data, **given)


def page_of(checkpoint: Checkpoint) -> Page:
    """Return the page of a policy; skip the test where its module cannot be made."""
    try:
        return Page(checkpoint, checkpoint.make_env(), page_data(checkpoint))
    except UserError as error:
        if wasm.obstacle():
            pytest.skip(str(error))
        raise


@functools.cache
def shipped(name: str) -> Page:
    """Return the page of a policy that comes with the package."""
    return page_of(load_checkpoint(f"pretrained:{name}"))
