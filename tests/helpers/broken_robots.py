"""Robots that are each wrong in one way: what to replace in an example's model or settings."""

from typing import NamedTuple


class Broken(NamedTuple):
    robot: str
    """The example that is changed."""
    changes: tuple[tuple[str, str], ...]
    """What in its model is replaced by what, everywhere."""
    said: str
    """A part of the line that tells what is wrong."""
    settings: dict[str, object] = {}  # noqa: RUF012
    """Settings that are changed too."""


BROKEN = {
    "an actuator is missing": Broken(
        "turtlebot",
        (('<velocity name="right" joint="right_wheel" kv="0.08" forcerange="-0.2 0.2"/>', ""),),
        "robot.wheels.right: the model has no actuator 'right': there are left",
    ),
    "an actuator is misspelt": Broken(
        "turtlebot",
        (('name="right" joint', 'name="rigth" joint'),),
        "robot.wheels.right: the model has no actuator 'right': did you mean rigth?",
    ),
    "no free joint": Broken(
        "turtlebot", (("<freejoint/>", ""),), "no body of the world has a free joint"
    ),
    "unstable motors": Broken(
        "turtlebot",
        (('kv="0.08" forcerange="-0.2 0.2"', 'kv="8"'),),
        "unstable with physics.sim_dt = 0.00833333",
    ),
    "a wheel in the air": Broken(
        "rover",
        (('name="front_left" pos="0.085 0.1 0"', 'name="front_left" pos="0.085 0.1 0.04"'),),
        "the wheel of fl does not touch the floor where the robot rests: it is",
    ),
    "a wheel that does not collide": Broken(
        "turtlebot",
        (('name="left_tyre" class="touches"', 'name="left_tyre"'),),
        "left has no sphere, ellipsoid, cylinder or capsule around its axis that touches",
    ),
    "swapped sides": Broken(
        "turtlebot",
        (),
        "robot.wheels.left: right is 0.08 m to the right of the base: name it under right, or",
        {"wheels": {"left": ["right"], "right": ["left"]}},
    ),
    "one wheel on both sides": Broken(
        "turtlebot",
        (),
        "robot.wheels: left is named twice",
        {"wheels": {"left": ["left"], "right": ["left", "right"]}},
    ),
    "a wrong axis": Broken(
        "turtlebot",
        (('name="left_wheel" axis="0 1 0"', 'name="left_wheel" axis="1 0 0"'),),
        "the axis of left_wheel is (1 0 0) in the frame of the base: it should point to the left",
    ),
    "a base that looks to the side": Broken(
        "turtlebot",
        (
            ('axis="0 1 0"', 'axis="1 0 0"'),
            ('pos="0 0.08 0"', 'pos="0.08 0 0"'),
            ('pos="0 -0.08 0"', 'pos="-0.08 0 0"'),
        ),
        "it should point to the left (0 1 0), where x is forward",
    ),
    "meshes that are missing": Broken(
        "turtlebot",
        (("<worldbody>", '<asset><mesh name="m" file="body.stl"/></asset><worldbody>'),),
        "body.stl does not exist",
    ),
    "two bases": Broken(
        "turtlebot",
        (
            (
                "</worldbody>",
                '<body name="b" pos="1 0 1"><freejoint/><geom mass="1" size="0.1"/></body>'
                "</worldbody>",
            ),
        ),
        "2 bodies have a free joint (base, b): name the robot's by robot.base",
    ),
    "a base that is none": Broken(
        "turtlebot", (), "robot.base = 'frame' is no body of the world", {"base": "frame"}
    ),
    "something beside the robot": Broken(
        "turtlebot",
        (("</worldbody>", '<body name="wall"><geom size="0.1" pos="2 0 0"/></body></worldbody>'),),
        "wall is beside the robot: scenery belongs to a task's build_scene",
    ),
    "a box without a name beside the robot": Broken(
        "turtlebot",
        (("</worldbody>", '<geom type="box" size="0.1 0.1 0.1"/></worldbody>'),),
        "a geom without a name is beside the robot",
    ),
    "a base without a name": Broken(
        "turtlebot", (('name="base"', ""),), "the body with a free joint has no name"
    ),
    "a base in a frame": Broken(
        "turtlebot",
        (
            ('<body name="base"', '<frame><body name="base"'),
            ("</worldbody>", "</frame></worldbody>"),
        ),
        "is in a <frame>: put it into <worldbody> itself",
    ),
    "one wheel twice": Broken(
        "turtlebot",
        (),
        "robot.wheels: left is named twice",
        {"wheels": {"left": ["left", "left"], "right": ["right"]}},
    ),
    "wheels that cannot turn apart": Broken(
        "turtlebot",
        (
            (
                "</mujoco>",
                '<equality><joint joint1="left_wheel" joint2="right_wheel"/></equality></mujoco>',
            ),
        ),
        "told to turn half as fast as it may, it turns",
    ),
    "millimetres": Broken(
        "turtlebot",
        (
            ('type="sphere" size="0.033"', 'type="sphere" size="33"'),
            ('pos="0 0.08 0"', 'pos="0 80 0"'),
            ('pos="0 -0.08 0"', 'pos="0 -80 0"'),
            ('pos="-0.081 0 -0.023" size="0.01"', 'pos="-81 0 -23" size="10"'),
        ),
        "has a radius of 33 m: lengths are in metres",
    ),
    "motors of torque": Broken(
        "turtlebot",
        (
            (
                '<velocity name="left" joint="left_wheel" kv="0.08"',
                '<motor name="left" joint="left_wheel"',
            ),
        ),
        "left does not take a wheel speed as its control: make it <velocity kv=",
    ),
    "an actuator with a state": Broken(
        "turtlebot",
        (
            (
                '<velocity name="left" joint="left_wheel" kv="0.08"',
                '<general name="left" joint="left_wheel" dyntype="filter" dynprm="0.1"'
                ' biastype="affine" gainprm="0.08" biasprm="0 0 -0.08"',
            ),
        ),
        "left has a state of its own (dyntype): leave it out",
    ),
    "an actuator of no wheel": Broken(
        "rover",
        (),
        "no wheel has the actuator rl, rr: name it in robot.wheels or robot.steering",
        {"wheels": {"left": ["fl"], "right": ["fr"]}},
    ),
    "unequal wheels": Broken(
        "rover",
        (
            (
                'name="rear_left_tyre" class="touches"',
                'name="rear_left_tyre" class="touches" size="0.04"',
            ),
        ),
        "wheels of 0.04 and 0.05 m: give them one",
    ),
    "steering without limits": Broken(
        "car",
        (('ctrlrange="-0.7 0.7" ', ""),),
        "steer_left has no limits: give it a ctrlrange [rad]",
    ),
    "steering in degrees": Broken(
        "car", (('ctrlrange="-0.7 0.7"', 'ctrlrange="-40 40"'),), "a ctrlrange is in radians"
    ),
    "a steered wheel in the middle": Broken(
        "car",
        (('name="left_knuckle" pos="0.16 0.06 0"', 'name="left_knuckle" pos="0.16 0 0"'),),
        "robot.steering.left: steer_left is in the middle of the base: name it under middle, or",
    ),
    "a car without a straight axle": Broken(
        "car",
        (
            ('joint name="rear_left" class="axle"', 'joint name="rear_left" axis="1 0 0"'),
            ('joint name="rear_right" class="axle"', 'joint name="rear_right" axis="1 0 0"'),
            ('joint="rear_', 'joint="front_'),
        ),
        "robot.steering: no wheel that stays straight is behind the steered ones or before them",
    ),
    "a car without steering": Broken(
        "car", (), "a car has actuators in robot.wheels and in robot.steering", {"steering": None}
    ),
    "a number that is none": Broken(
        "turtlebot",
        (('pos="0 0.08 0"', 'pos="nan 0.08 0"'),),
        "<body pos='nan 0.08 0'> holds NaN: give a number",
    ),
    "an infinite wheel": Broken(
        "turtlebot",
        (('type="sphere" size="0.033"', 'type="sphere" size="inf"'),),
        "the size of a geom is infinite: give a finite number",
    ),
    "a negative mass": Broken(
        "turtlebot", (('0.02" mass="', '0.02" mass="-'),), "MuJoCo refuses it: "
    ),
    "grams": Broken(
        "turtlebot",
        (('mass="1.7"', 'mass="1700"'),),
        "it weighs 1,700 kg: masses are in kilograms (grams are kilograms × 0.001)",
    ),
    "gravity that lifts": Broken(
        "turtlebot",
        (("<worldbody>", '<option gravity="0 0 9.81"/><worldbody>'),),
        "its gravity is (0 0 9.81), which does not hold it on the floor",
    ),
    "degrees": Broken(
        "car",
        (('<compiler angle="radian"/>', ""),),
        'a joint\'s range in degrees unless there is <compiler angle="radian"/>',
    ),
    "a wheel with an end": Broken(
        "turtlebot",
        (('name="left_wheel" axis="0 1 0"', 'name="left_wheel" axis="0 1 0" range="-1 1"'),),
        "left drives left_wheel, which has a range: a wheel turns without an end",
    ),
    "a gear that moves nothing": Broken(
        "turtlebot",
        (('name="left" joint="left_wheel"', 'name="left" joint="left_wheel" gear="0"'),),
        "left has a gear of 0, which moves nothing: leave it out",
    ),
    "an actuator without a name": Broken(
        "turtlebot",
        (('name="right" joint', "joint"),),
        "the model has no actuator 'right': there are left, one without a name",
    ),
    "an actuator of no joint": Broken(
        "turtlebot",
        (
            ('name="left" joint="left_wheel"', 'name="left" tendon="both"'),
            (
                "</mujoco>",
                '<tendon><fixed name="both"><joint joint="left_wheel" coef="1"/></fixed></tendon>'
                "</mujoco>",
            ),
        ),
        "left drives no joint: give it joint=…",
    ),
    "a base that is held": Broken(
        "turtlebot",
        (("</mujoco>", '<equality><weld body1="base"/></equality></mujoco>'),),
        "something holds it, such as a part that drags on the floor, a joint's damping or an",
    ),
    "a base that is a mocap body": Broken(
        "turtlebot", (('name="base"', 'name="base" mocap="true"'),), "MuJoCo refuses it: "
    ),
    "an integrator of C alone": Broken(
        "turtlebot",
        (("<worldbody>", '<option integrator="implicit"/><worldbody>'),),
        "MJX does not support mjtIntegrator.mjINT_IMPLICIT",
    ),
    "a file that includes itself": Broken(
        "turtlebot",
        (("<worldbody>", '<include file="turtlebot.xml"/><worldbody>'),),
        "MuJoCo refuses it: XML Error: File 'turtlebot.xml' already included",
    ),
    "a file that includes another folder's": Broken(
        "turtlebot",
        (("<worldbody>", '<include file="/etc/passwd"/><worldbody>'),),
        "/etc/passwd is outside of the model's folder",
    ),
    "another byte than of text": Broken(
        "turtlebot", (("<worldbody>", "\0<worldbody>"),), "this is not XML: not well-formed"
    ),
    "no MuJoCo model": Broken(
        "turtlebot",
        (("<mujoco", "<sdf"), ("</mujoco", "</sdf")),
        "<sdf> is not a MuJoCo model",
    ),
    "no XML": Broken("turtlebot", (("</body>", ""),), "this is not XML: mismatched tag"),
    "what MuJoCo refuses": Broken(
        "turtlebot",
        (('diaginertia="0.0055 0.0055 0.0065"', 'diaginertia="0.0055 0.0055 1"'),),
        "MuJoCo refuses it: ",
    ),
    "motors that are too weak": Broken(
        "turtlebot",
        (('forcerange="-0.2 0.2"', 'forcerange="-0.0001 0.0001"'),),
        "the motors are too weak or too slow, the wheels slip, or something holds it",
    ),
    "a robot that falls over": Broken(
        "turtlebot",
        (('<inertial pos="-0.03 0 0.02"', '<inertial pos="0.05 0 0.02"'),),
        "does not come to rest",
    ),
}
