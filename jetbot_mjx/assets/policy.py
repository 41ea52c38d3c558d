"""A policy of jetbot_mjx in NumPy alone, for Python 3.6 or newer and NumPy 1.13 or newer.

    from policy import act
    action, wheel_speeds = act(obs)

`policy.json` describes each number. `act` applies the normaliser, the network, the clip to [-1, 1]
and the controller that converts an action to wheel speeds. It does not compute motor values, which
depend on the robot. `python3 policy.py` checks the policy against the recording beside it, and
measures the time of a call.
"""

import base64
import json
import os
import sys
import time

import numpy as np

ABOUT = json.loads("""{}""")
NUMBERS = """
"""

TOLERANCE = 1e-5


def _arrays() -> list:
    flat = np.frombuffer(base64.b64decode(NUMBERS), dtype="<f4")
    arrays, start = [], 0
    for shape in ABOUT["shapes"]:
        end = start + int(np.prod(shape))
        arrays.append(flat[start:end].reshape(shape).astype(np.float32))
        start = end
    return arrays


def _activate(x: np.ndarray) -> np.ndarray:
    kind = ABOUT["activation"]
    if kind == "tanh":
        return np.tanh(x)
    if kind == "relu":
        return np.maximum(x, np.float32(0))
    if kind == "elu":
        return np.where(x > 0, x, np.expm1(np.minimum(x, np.float32(0))))
    # Swish, written with tanh because exp could overflow.
    half = np.float32(0.5)
    return x * half * (np.float32(1) + np.tanh(half * x))


_MEAN, _STD, *_REST = _arrays()
_KERNELS, _BIASES = _REST[0::2], _REST[1::2]


def act(obs: np.ndarray) -> tuple:
    """Return the action and the wheel speeds for one observation or a batch.

    Args:
      obs: Observation of shape [obs] or [n, obs], in the order and the units of `policy.json`.

    Returns:
      The action in [-1, 1], and the wheel speeds (left, right) [rad/s] that it commands, before the
      limits of any motor; for a batch, one row each.

    Raises:
      ValueError: The observation has another length.
    """
    x = np.asarray(obs, np.float32)
    if x.ndim == 0 or x.shape[-1] != _MEAN.size:
        raise ValueError(f"the observation has the shape {x.shape}, not {_MEAN.size} numbers")
    x = (x - _MEAN) / _STD
    for kernel, bias in zip(_KERNELS[:-1], _BIASES[:-1]):
        x = _activate(np.dot(x, kernel) + bias)
    x = np.dot(x, _KERNELS[-1]) + _BIASES[-1]
    if ABOUT["squash"]:
        x = np.tanh(x)
    action = np.clip(x, np.float32(-1), np.float32(1))
    return action, wheel_speeds(action)


def wheel_speeds(action: np.ndarray) -> np.ndarray:
    """Return the wheel speeds of an action, by the controller of training.

        v = (a0 + 1)/2 max_speed          w = a1 max_yaw_rate
        left = (v - w b/2) / r            right = (v + w b/2) / r

    Args:
      action: Action of shape [2] or [n, 2], in [-1, 1].

    Returns:
      (left, right) [rad/s], in the same shape.
    """
    about = ABOUT["controller"]
    speed = np.float32(0.5) * (action[..., 0] + np.float32(1)) * np.float32(about["max_speed"])
    turn = action[..., 1] * np.float32(0.5 * about["max_yaw_rate"] * about["wheel_separation"])
    radius = np.float32(about["wheel_radius"])
    return np.stack([(speed - turn) / radius, (speed + turn) / radius], axis=-1)


def check(path: str) -> float:
    """Return the largest difference from JAX, on the recording that was exported with the policy.

    Args:
      path: Path of `recording.npz`.

    Returns:
      The largest difference of any number, wheel speeds as a share of the fastest.
    """
    about = ABOUT["controller"]
    turn = 0.5 * about["max_yaw_rate"] * about["wheel_separation"]
    fastest = (about["max_speed"] + turn) / about["wheel_radius"]
    with np.load(path) as recording:
        action, wheels = act(recording["obs"])
        worst = [
            np.abs(action - recording["action"]).max(),
            np.abs(wheels - recording["wheel_speeds"]).max() / fastest,
        ]
    return float(max(worst))


def _main() -> int:
    path = os.path.join(os.path.dirname(os.path.abspath(__file__)), "recording.npz")
    if not os.path.isfile(path):
        print(f"{path} is missing: copy the whole folder")
        return 2
    worst = check(path)
    with np.load(path) as recording:
        observations = recording["obs"][:1000]
    times = []
    for obs in observations:
        start = time.perf_counter()
        act(obs)
        times.append(1e6 * (time.perf_counter() - start))
    print(
        f"Python {sys.version.split()[0]}, NumPy {np.__version__}: at most {worst:.1e} from JAX;"
        f" a call takes {np.median(times):.0f} microseconds, 1 in 100 more than"
        f" {np.percentile(times, 99):.0f}"
    )
    return 0 if worst < TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(_main())
