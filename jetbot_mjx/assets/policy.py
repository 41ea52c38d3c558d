"""A policy of jetbot_mjx in NumPy alone, for Python 3.6 or newer and NumPy 1.13 or newer.

    from policy import act
    action, wheel_speeds = act(obs)            # a policy that observes numbers
    action, wheel_speeds = act(image)          # a policy that sees
    action, wheel_speeds = act(image, state)   # a policy that sees, and observes numbers too
    action = act(obs)                          # a policy of an environment without wheels

`policy.json` describes the inputs. `act` applies the normaliser, the network, the clip to [-1, 1]
and the controller that converts an action to wheel speeds. It does not compute motor values, which
depend on the robot. `python3 policy.py` checks the policy against the recording beside it, and
measures the time of a call.
"""

import base64
import json
import os
import sys
import time
from typing import Any, Optional

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
_LAYERS = list(zip(_REST[0::2], _REST[1::2]))
_CONVOLUTIONS = [(*_LAYERS.pop(0), stride) for stride in ABOUT["strides"]]
_DENSE = [_LAYERS.pop(0)] if _CONVOLUTIONS else []


def stack(image: np.ndarray, before: Optional[np.ndarray] = None) -> np.ndarray:
    """Return what `act` takes as the image, if it takes the images of several control periods.

    Call it once in every control period. `act` cannot stack, since it keeps nothing.

    Args:
      image: The newest image, uint8 of shape [height, width, 1 for grey or 3].
      before: The result of the period before; None at the start: copies of the image.

    Returns:
      The images along the channels, the newest last.
    """
    if before is None:
        return np.tile(image, (1, 1, ABOUT["image"][2] // image.shape[2]))
    return np.concatenate([before[:, :, image.shape[2] :], image], axis=2)


def _normalised(numbers: np.ndarray) -> np.ndarray:
    x = np.asarray(numbers, np.float32)
    if x.ndim == 0 or x.shape[-1] != _MEAN.size:
        raise ValueError(f"the observation has the shape {x.shape}, not {_MEAN.size} numbers")
    return (x - _MEAN) / _STD


def _features(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    if image.dtype != np.uint8 or list(image.shape[-3:]) != ABOUT["image"] or image.ndim > 4:
        raise ValueError(
            f"the image is {image.dtype} of shape {image.shape}, not uint8 of {ABOUT['image']}"
        )
    x = image.reshape((-1, *image.shape[-3:])).astype(np.float32)
    for kernel, bias, stride in _CONVOLUTIONS:
        x = np.maximum(_convolve(x, kernel, stride) + bias, np.float32(0))
    x = x.reshape(x.shape[0], -1)
    for kernel, bias in _DENSE:
        x = np.maximum(np.dot(x, kernel) + bias, np.float32(0))
    return x.reshape((*image.shape[:-3], -1))


def _convolve(x: np.ndarray, kernel: np.ndarray, stride: int) -> np.ndarray:
    side, channels = kernel.shape[0], kernel.shape[2]
    count, height, width, _ = x.shape
    rows, columns = (height - side) // stride + 1, (width - side) // stride + 1
    # A view of the squares that the kernel covers, each of which becomes a row of a matrix.
    every, down, right, channel = x.strides
    squares = np.lib.stride_tricks.as_strided(
        x,
        (count, rows, columns, side, side, channels),
        (every, stride * down, stride * right, down, right, channel),
    )
    squares = squares.reshape(count * rows * columns, side * side * channels)
    return np.dot(squares, kernel.reshape(squares.shape[1], -1)).reshape(count, rows, columns, -1)


def act(obs: np.ndarray, state: Optional[np.ndarray] = None) -> Any:
    """Return the action and the wheel speeds for one observation or a batch.

    Args:
      obs: Numbers of shape [obs] or [n, obs], in the order and the units of `policy.json`. A policy
        that sees takes the image here, uint8 of shape [height, width, channels], or n of them.
      state: The numbers beside the image, of shape [state] or [n, state]; None: there are none.

    Returns:
      The action in [-1, 1], and the wheel speeds (left, right) [rad/s] that it commands, before the
      limits of any motor; for a batch, one row each. Without wheels, the action only; an action
      that is a choice has 1 at its place and 0 elsewhere.

    Raises:
      ValueError: The observation has another shape or type, or there are too many parts.
    """
    if (state is not None) != ("state" in ABOUT["inputs"]):
        raise ValueError(f"give {' and '.join(ABOUT['inputs'])}")
    if not _CONVOLUTIONS:
        x = _normalised(obs)
    elif state is None:
        x = _features(obs)
    else:
        x = np.concatenate([_features(obs), _normalised(state)], axis=-1)
    for kernel, bias in _LAYERS[:-1]:
        x = _activate(np.dot(x, kernel) + bias)
    kernel, bias = _LAYERS[-1]
    x = np.dot(x, kernel) + bias
    if ABOUT.get("choice"):
        return np.eye(x.shape[-1], dtype=np.float32)[np.argmax(x, axis=-1)]
    if ABOUT["squash"]:
        x = np.tanh(x)
    action = np.clip(x, np.float32(-1), np.float32(1))
    return action if ABOUT["controller"] is None else (action, wheel_speeds(action))


def wheel_speeds(action: np.ndarray) -> np.ndarray:
    """Return the wheel speeds of an action, by the controller of training.

        v = (a0 + 1)/2 max_speed          w = a1 max_yaw_rate
        left = (v - w b/2) / r            right = (v + w b/2) / r

    Args:
      action: Action of shape [2] or [n, 2], in [-1, 1].

    Of a car, it is the wheel speed v / r in the middle of the rear axle, and the curvature of the
    path, a1 max_curvature.

    Returns:
      (left, right) [rad/s], in the same shape; of a car (wheel speed [rad/s], curvature [1/m]).
    """
    about = ABOUT["controller"]
    if "action_size" in about:  # only the robot's own function knows what an action means
        return action
    speed = np.float32(0.5) * (action[..., 0] + np.float32(1)) * np.float32(about["max_speed"])
    if "max_curvature" in about:
        curvature = action[..., 1] * np.float32(about["max_curvature"])
        return np.stack([speed / np.float32(about["wheel_radius"]), curvature], axis=-1)
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
    about = ABOUT["controller"] or {}
    turn = 0.5 * about.get("max_yaw_rate", 0.0) * about.get("wheel_separation", 0.0)
    fastest = (about.get("max_speed", 1.0) + turn) / about.get("wheel_radius", 1.0)
    inputs, wanted = _recorded(path)
    worst = [0.0]
    # Piece by piece, since all images at once would fill the memory of a small computer.
    for start in range(0, len(wanted[0]), 100):
        piece = slice(start, start + 100)
        found = act(*(part[piece] for part in inputs))
        found = found if about else (found,)
        for one, right, unit in zip(found, wanted, (1.0, fastest)):
            worst.append(np.abs(one - right[piece]).max() / unit)
    return float(max(worst))


def _recorded(path: str) -> tuple:
    with np.load(path, allow_pickle=False) as recording:
        inputs = [recording[name] for name in ABOUT["inputs"]]
        names = ("action", "wheel_speeds") if ABOUT["controller"] else ("action",)
        return inputs, [recording[name] for name in names]


def _main() -> int:
    path = os.path.join(os.path.dirname(os.path.abspath(__file__)), "recording.npz")
    if not os.path.isfile(path):
        print(f"{path} is missing: copy the whole folder")
        return 2
    worst = check(path)
    times = []
    for parts in zip(*(part[:1000] for part in _recorded(path)[0])):
        start = time.perf_counter()
        act(*parts)
        times.append(1e6 * (time.perf_counter() - start))
    print(
        f"Python {sys.version.split()[0]}, NumPy {np.__version__}: at most {worst:.1e} from JAX;"
        f" a call takes {np.median(times):.0f} microseconds, 1 in 100 more than"
        f" {np.percentile(times, 99):.0f}"
    )
    return 0 if worst < TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(_main())
