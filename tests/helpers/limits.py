"""The limits of a robot's motion that rolls without slip or drift."""

import numpy as np

from benchmarks.learning.reachable import Limits

PLAIN = Limits(
    ctrl_dt=1 / 30,
    track=0.05,
    step=0.06,
    brake=1.0,
    swing=0.0,
    drag=0.0,
    outer_loss=0.0,
    inner_loss=0.0,
    max_speed=0.6,
    min_speed=0.0,
    motor_yaw_rate=3.0,
    growth=0.0,
    max_yaw_rate=3.0,
    max_turn=np.inf,
    grip=10.0,
    spun_step=0.06,
    half_track=0.06,
    max_wheel_speed=np.inf,
    lateness=0.75,
    slip=0.0,
    error=0.0,
)
