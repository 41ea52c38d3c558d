"""Checkpoints damaged on purpose."""

import json

from jetbot_mjx.runs import checkpoint_store


def damage_about(change):
    """A damage to a checkpoint: `change` its metadata, with a hash that fits again."""

    def damage(checkpoint):
        path = checkpoint / "about" / "metadata"
        about = json.loads(path.read_text())
        change(about)
        del about["sha256"]["about"]
        about["sha256"]["about"] = checkpoint_store._digest_json(about)
        path.write_text(json.dumps(about))

    return damage
