"""What the tests of the adapters' environments share: a name, goals that end episodes, a camera."""

ID = "jetbot_mjx.adapters:JetBot-v0"
GOAL = slice(13, 16)
"""Where the goal is in the `world` observation."""
ENDS = {"task": {"success_radius": 0.6}}
"""Goals so near that they are reached within some steps."""


def sees(observation="camera", **camera):
    """A configuration with a small camera."""
    return {
        "task": {"observation": observation},
        "camera": {"width": 40, "height": 36, **camera},
    }
