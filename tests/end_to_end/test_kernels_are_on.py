"""The kernels are used with the installed versions of all libraries."""

import jax
import pytest

from jetbot_mjx.config import load_config, shipped_configs
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.fallbacks import collect
from jetbot_mjx.runs import Setup
from jetbot_mjx.training.ppo_trainer import CompiledTrainer, build_ppo
from onekernel import cpu, gpu
from onekernel.aot.program_cache import ProgramCache

IMAGES = "it takes observations without images"
WITHOUT_FUSED_UPDATE = {
    "best_camera": IMAGES,
    "camera_gpu": IMAGES,
    "camera_real": IMAGES,
    "jetbot_camera": IMAGES,
    "isaac_sb3": "it takes two networks of the same hidden layers of one width",
}
BACKENDS = {"cpu": cpu, "gpu": gpu}


def test_the_back_end_of_this_device_can_be_used():
    assert BACKENDS[jax.default_backend()].obstacle() is None


NAMES = sorted(shipped_configs(["configs"]))
QUICK = ("jetbot_camera",)
"""All others are traced by `make wheel`, with the newest versions, and by `make test-slow`."""


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[] if x in QUICK else [pytest.mark.slow]) for x in NAMES]
)
def test_no_shipped_configuration_falls_back(name, capsys):
    config = load_config(name)
    with collect() as found:
        env = make_env(config)
        ppo = build_ppo(Setup(config, env=env))
        CompiledTrainer(ppo, [0], ProgramCache({})).trace()
    assert env.physics.impl == BACKENDS[jax.default_backend()].IMPL
    reason = WITHOUT_FUSED_UPDATE.get(name)
    assert found == ([("ppo.update", reason)] if reason else [])
    assert ppo.learner.name == ("xla" if reason else "fused")
