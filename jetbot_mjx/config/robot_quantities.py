"""Declare every quantity by which a robot may differ from its preset.

A further quantity is declared here, and applied where its like are: friction and masses in
`envs.robot_params`, wheels and motors in `envs.actuators`, measurement errors in `envs.sensors`.
"""

from typing import Annotated, NamedTuple

from jetbot_mjx.config.quantities import ANGLE, Evaluated, Range, Value, differs


class RobotParams(NamedTuple):
    """A `RobotParams` holds the differences of one robot from its preset.

    Each field is a number or a traced scalar. The defaults are the preset. A parameter at its
    default costs nothing: programs omit its code.
    """

    differs = differs

    friction: Annotated[
        Value,
        Range(0.05, 5, "ISAACRL 0.4 to 1.2; WHEELEDLAB from 0.3"),
        Evaluated("wheel-floor friction", "× preset", (0.3, 0.4, 0.6, 0.8, 1.0, 1.2)),
    ] = 1.0
    """Factor on the Coulomb coefficient of wheel on floor."""
    mass: Annotated[
        Value,
        Range(0.2, 5, "EST 0.60 to 0.85 kg in total, from the BOM's parts; ISAACRL ±15 %"),
        Evaluated("chassis mass and inertia", "× preset", (0.85, 0.92, 1.0, 1.12, 1.25)),
    ] = 1.0
    """Factor on mass and inertia of the chassis."""
    com_x: Annotated[
        Value,
        Range(-0.03, 0.03, "CAD ±15 mm; further forward the robot tips over its wheels"),
        Evaluated("centre of mass, forward", "m", (-0.03, -0.015, 0.0, 0.015)),
    ] = 0.0
    """[m] shift of the chassis's centre of mass forwards."""
    com_y: Annotated[
        Value,
        Range(-0.03, 0.03, "CAD ±5 mm"),
        Evaluated("centre of mass, left", "m", (-0.01, -0.005, 0.0, 0.005, 0.01)),
    ] = 0.0
    """[m] shift of the centre of mass to the left."""
    com_z: Annotated[
        Value,
        Range(-0.03, 0.03, "EST ±10 mm"),
        Evaluated("centre of mass, up", "m", (-0.01, 0.0, 0.01, 0.02)),
    ] = 0.0
    """[m] shift of the centre of mass upwards."""
    wheel_radius: Annotated[
        Value,
        Range(0.5, 2, "BOM wheels of 60 and 65 mm, worn or new; measured to 68 mm"),
        Evaluated("radius of the wheels", "× preset", (0.92, 0.96, 1.0, 1.04, 1.08)),
    ] = 1.0
    """Factor on the radius of both wheels."""
    wheel_radius_mismatch: Annotated[
        Value,
        Range(-0.5, 0.5, "EST radius ±2 %"),
        Evaluated(
            "unequal wheels", "(left - right) / mean", (-0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1)
        ),
    ] = 0.0
    """Difference of the wheel radii, (left - right) / mean."""
    wheel_separation: Annotated[
        Value,
        Range(0.5, 2, "CAD ±5 %; CSE276A turns as if 1.4 to 1.8 times as wide"),
        Evaluated("wheel separation", "× preset", (0.9, 0.95, 1.0, 1.05, 1.25, 1.6)),
    ] = 1.0
    """Factor on the distance between the wheels; above 1 the robot turns less."""
    motor_gain: Annotated[
        Value,
        Range(0.1, 2, "ISAACRL ±10 %"),
        Evaluated("motor gain", "× preset", (0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15)),
    ] = 1.0
    """Factor on the wheel speed that a command produces."""
    motor_gain_mismatch: Annotated[
        Value,
        Range(-0.5, 0.5, "CSE276A 3 % apart; DUCKIETOWN deviation 2 %, to 5 % EST"),
        Evaluated("unequal motors", "(left - right) / mean", (-0.2, -0.1, 0.0, 0.1, 0.2)),
    ] = 0.0
    """Difference of the motor gains, (left - right) / mean."""
    supply_voltage: Annotated[
        Value,
        Range(0.5, 2, "BOM 5 V bank 0.9 to 1.05; three cells 9.6 to 12.6 V"),
        Evaluated("supply voltage", "× nominal", (0.8, 0.9, 1.0, 1.05, 1.15)),
    ] = 1.0
    """Factor on the motors' voltage."""
    dead_band: Annotated[
        Value,
        Range(0, 0.9, "CSE276A 1 %, PICOBOT 11 %, TT 11 to 25 %"),
        Evaluated(
            "dead-band of the motors", "of full voltage", (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3)
        ),
    ] = 0.0
    """Fraction of full voltage below which a wheel stands still."""
    motor_lag: Annotated[
        Value,
        Range(0, 1, "PICOBOT 0.085 s, DUCKIETOWN 0.20 to 0.25 s, motors and all"),
        Evaluated("further lag of the motors", "s", (0.0, 0.05, 0.1, 0.15, 0.2, 0.25)),
    ] = 0.0
    """[s] time constant of a first-order lag in front of the motors' own dynamics."""
    action_delay: Annotated[
        Value,
        Range(0, 60, "ISAACRL 0 to 3 steps; DUCKIETOWN 0.15 s", whole=True),
        Evaluated("delay of actions", "control steps", (0.0, 1.0, 2.0, 3.0, 6.0, 9.0)),
    ] = 0.0
    """[control steps] delay from command to motor."""
    position_noise: Annotated[
        Value,
        Range(0, 0.5, "ISAACRL 0.01 to 0.03 m"),
        Evaluated("noise of the position", "m", (0.0, 0.01, 0.02, 0.03, 0.06)),
    ] = 0.0
    """[m] standard deviation of the noise on the observed position, drawn at every step."""
    yaw_noise: Annotated[
        Value,
        Range(0, 1, "ISAACRL 0.01 to 0.03 rad"),
        Evaluated("noise of the heading", "rad", (0.0, 0.01, 0.03, 0.1)),
    ] = 0.0
    """[rad] standard deviation of the noise on the observed heading."""
    speed_noise: Annotated[
        Value,
        Range(0, 1, "ISAACRL 0.01 m/s"),
        Evaluated("noise of the velocity", "m/s", (0.0, 0.01, 0.03)),
    ] = 0.0
    """[m/s] standard deviation of the noise on the observed velocity."""
    yaw_rate_noise: Annotated[
        Value,
        Range(0, 1, "ISAACRL 0.03 rad/s"),
        Evaluated("noise of the yaw rate", "rad/s", (0.0, 0.03, 0.1)),
    ] = 0.0
    """[rad/s] standard deviation of the noise on the observed yaw rate."""
    observation_delay: Annotated[
        Value,
        Range(0, 60, "EST 30 to 60 ms of a camera with 30 frames per second", whole=True),
        Evaluated("delay of observations", "control steps", (0.0, 1.0, 2.0, 3.0, 6.0)),
    ] = 0.0
    """[control steps] delay of the observation of the robot's own state."""
    height_offset: Annotated[
        Value,
        Range(
            -0.05,
            0.05,
            "SIM MuJoCo's default contact carries it 0.4 mm higher; EST 3 mm, a carpet",
        ),
        Evaluated("observed height, offset", "m", (-0.003, -0.001, 0.0, 0.001, 0.003)),
    ] = 0.0
    """[m] offset of the observed height, constant over an episode."""
    pitch_offset: Annotated[
        Value,
        Range(-0.5, 0.5, "EST 1°, how straight a sensor is mounted"),
        Evaluated("observed pitch, offset", "rad", (-0.0175, 0.0, 0.0175)),
    ] = 0.0
    """[rad] offset of the observed pitch, positive nose down, constant over an episode."""
    start_x: Annotated[
        Value,
        Range(-5, 5, "EST set down by hand"),
        Evaluated("start, forward", "m", (-0.05, 0.0, 0.05)),
    ] = 0.0
    """[m] start position of the robot, forwards from the origin."""
    start_y: Annotated[
        Value,
        Range(-5, 5, "EST set down by hand"),
        Evaluated("start, left", "m", (-0.05, 0.0, 0.05)),
    ] = 0.0
    """[m] start position of the robot, to the left of the origin."""
    start_yaw: Annotated[
        Value,
        Range(-ANGLE, ANGLE, "EST any heading"),
        Evaluated("heading at the start", "rad", (-3.14, -1.57, 0.0, 1.57, 3.14)),
    ] = 0.0
    """[rad] heading at the start, counter-clockwise."""
