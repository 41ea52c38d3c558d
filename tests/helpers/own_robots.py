"""The examples of robots that are models of their own, changed and small enough for tests."""

from pathlib import Path

from ruamel.yaml import YAML

from jetbot_mjx.config import load_config

EXAMPLES = Path(__file__).parents[2] / "examples"
OWN_ROBOTS = ("turtlebot", "rover", "car")


def copy_robot(folder, name, changes=(), settings=None):
    """Write an example's model and settings, changed, into a folder; returns the configuration."""
    text = (EXAMPLES / f"{name}.xml").read_text("utf-8")
    for old, new in changes:
        assert old in text, f"{name}.xml has no {old}"
        text = text.replace(old, new)
    (folder / f"{name}.xml").write_text(text, "utf-8")
    values = YAML(typ="safe").load(EXAMPLES / f"{name}.yaml")
    values["robot"] |= settings or {}
    config = folder / f"{name}.yaml"
    YAML().dump(values, config)
    return config


def load_robot(name, *overrides):
    """The configuration of an example."""
    return load_config(EXAMPLES / f"{name}.yaml", overrides)


def copy_tricycle(folder, *, driven):
    """Write the car with one steered front wheel; `driven`: its rear wheels, or the front one."""
    car = (EXAMPLES / "car.xml").read_text("utf-8")
    right = car[car.index('<body name="right_knuckle"') : car.index("    </body>\n  </worldbody>")]
    steer = car[car.index('<position name="steer_right"') : car.index("  </actuator>")]
    drive = car[
        car.index('<velocity name="drive_right"') : car.index('<position name="steer_left"')
    ]
    changes = [(right, ""), (steer, "")]
    changes += [('pos="0.16 0.06 0"', 'pos="0.16 0 0"'), ('pos="0 0.005 0"', 'pos="0 0 0"')]
    settings = {"steering": {"middle": ["steer_left"]}}
    if driven == "front":
        changes += [(drive, ""), ('joint="rear_left"', 'joint="front_left"')]
        settings["wheels"] = {"middle": ["drive_left"]}
    return copy_robot(folder, "car", changes, settings)
