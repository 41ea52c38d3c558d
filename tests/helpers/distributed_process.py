"""The training command as one of several processes, which tells what it holds."""

import json
import os
import signal
import sys
import time

import jax
import numpy as np

from helpers import gliding
from helpers.command_modules import train
from jetbot_mjx import cli
from jetbot_mjx.runs.checkpoint_store import digest
from jetbot_mjx.training import ppo_trainer
from jetbot_mjx.training.callbacks import TrainerCallback


def main():
    """Run the command, one training step a call.

    The first argument names a signal that it gets after each training step, and is `-` for none.
    """
    name, *arguments = sys.argv[1:]
    ppo_trainer.next_chunk = lambda steps, seconds, wanted: 1
    report = ppo_trainer._report

    def reported(trainer, recorder, state, seconds):
        own = jax.tree.map(lambda x: np.asarray(x.addressable_data(0)), state)
        worlds = own.env_state.unpack()
        told = {
            "parameters": digest(own.params),
            "keys": worlds.key.reshape(-1, 2).tolist(),
            "goals": worlds.goal.reshape(-1, 3).tolist(),
            "devices": [jax.local_device_count(), jax.device_count()],
        }
        print("told:", json.dumps(told), flush=True)
        return report(trainer, recorder, state, seconds)

    def interrupt(self, env_steps, metrics, seconds):
        os.kill(os.getpid(), signal.Signals[name])
        time.sleep(0.5)

    ppo_trainer._report = reported
    if name != "-":
        TrainerCallback.on_progress = interrupt
    with gliding.everywhere():
        cli.run_command(lambda _: train.main(arguments), at_once=True)
