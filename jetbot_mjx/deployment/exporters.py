"""Export a policy to files, and read each file back with the library that will run it.

`numpy` is one file of Python, and `stablehlo` is serialised by `jax.export`. `onnx` is built here
node by node, from nine kinds of node: the maintained exporter, jax2onnx 0.17, requires an older
Orbax than this package, and installs a model viewer and a hub client.
"""

import base64
import json
import re
import types
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from jetbot_mjx.deployment.numpy_policy import Outputs, PortablePolicy

_TEXT_WIDTH = 96

# The versions that onnxruntime for a Jetson Nano's JetPack reads; later ones are not needed here.
_ONNX_OPSET = 13
_ONNX_IR_VERSION = 7

_PLATFORMS = ("cpu", "cuda", "rocm", "tpu")

Act = Callable[[Float[np.ndarray, "n obs"]], Outputs]
"""A function from a batch of observations to actions and wheel speeds."""

AsJax = Callable[[Float[Array, "n obs"]], tuple[Float[Array, "n 2"], Float[Array, "n 2"]]]
"""The same as a function of JAX."""


class Format(NamedTuple):
    """A `Format` describes one kind of exported file."""

    file: str
    write: Callable[[PortablePolicy, AsJax, Path], None]
    read: Callable[[Path], Act]
    """Load the file as its user would, without this package."""
    needs: tuple[str, ...] = ()
    """Packages of the extra `export` that the format needs."""


def _write_numpy(policy: PortablePolicy, _: AsJax, path: Path) -> None:
    arrays = [policy.mean, policy.std, *(array for layer in policy.layers for array in layer)]
    about = {
        "shapes": [list(array.shape) for array in arrays],
        "activation": policy.activation,
        "squash": policy.squash,
        "controller": policy.controller._asdict(),
    }
    numbers = base64.b64encode(b"".join(np.asarray(a, "<f4").tobytes() for a in arrays)).decode()
    lines = "\n".join(re.findall(f".{{1,{_TEXT_WIDTH}}}", numbers))
    template = resources.files("jetbot_mjx").joinpath("assets/policy.py").read_text("utf-8")
    text = template.replace('"""{}"""', f'"""{json.dumps(about)}"""')
    text = text.replace('NUMBERS = """\n"""', f'NUMBERS = """\n{lines}\n"""')
    path.write_text(text, encoding="utf-8")


def _read_numpy(path: Path) -> Act:
    # An import would leave bytecode in a folder that is copied to a robot.
    module = types.ModuleType(path.stem)
    exec(compile(path.read_text("utf-8"), path, "exec"), module.__dict__)
    return module.act


def _write_stablehlo(policy: PortablePolicy, as_jax: AsJax, path: Path) -> None:
    from jax import export

    (batch,) = export.symbolic_shape("batch")
    obs = jax.ShapeDtypeStruct((batch, policy.mean.size), np.float32)
    exported = export.export(jax.jit(as_jax), platforms=_PLATFORMS)(obs)
    path.write_bytes(exported.serialize())


def _read_stablehlo(path: Path) -> Act:
    from jax import export

    return jax.jit(export.deserialize(bytearray(path.read_bytes())).call)


def _write_onnx(policy: PortablePolicy, _: AsJax, path: Path) -> None:
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, constants = [], []

    def constant(name: str, value: Any) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def node(kind: str, *inputs: str, to: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, inputs, [to], name=to, **attributes))
        return to

    # Normalise the observation, and apply the layers with their activations.
    x = node("Sub", "obs", constant("mean", policy.mean), to="centred")
    x = node("Div", x, constant("std", policy.std), to="normalised")
    last = len(policy.layers) - 1
    for index, layer in enumerate(policy.layers):
        kernel = constant(f"kernel_{index}", layer.kernel)
        x = node("Gemm", x, kernel, constant(f"bias_{index}", layer.bias), to=f"layer_{index}")
        if index < last and policy.activation == "swish":
            x = node("Mul", x, node("Sigmoid", x, to=f"gate_{index}"), to=f"hidden_{index}")
        elif index < last:
            kind = {"tanh": "Tanh", "relu": "Relu", "elu": "Elu"}[policy.activation]
            x = node(kind, x, to=f"hidden_{index}")
    if policy.squash:
        x = node("Tanh", x, to="squashed")
    node("Clip", x, constant("low", -1.0), constant("high", 1.0), to="action")
    # Append the controller, which is linear in the action.
    drive = 0.5 * policy.controller.max_speed / policy.controller.wheel_radius
    turn = policy.controller.fastest - 2.0 * drive
    mixing = constant("mixing", [[drive, drive], [-turn, turn]])
    node("Gemm", "action", mixing, constant("half_speed", [drive, drive]), to="wheel_speeds")

    def tensor(name: str, size: int) -> Any:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])

    # Check and write the graph.
    graph = helper.make_graph(
        nodes,
        "policy",
        [tensor("obs", policy.mean.size)],
        [tensor("action", 2), tensor("wheel_speeds", 2)],
        constants,
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", _ONNX_OPSET)],
        ir_version=_ONNX_IR_VERSION,
        producer_name="jetbot_mjx",
    )
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)


def _read_onnx(path: Path) -> Act:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session: Any = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    return lambda obs: tuple(session.run(["action", "wheel_speeds"], {"obs": obs}))


FORMATS = {
    "numpy": Format("policy.py", _write_numpy, _read_numpy),
    "onnx": Format("policy.onnx", _write_onnx, _read_onnx, ("onnx", "onnxruntime")),
    "stablehlo": Format("policy.stablehlo", _write_stablehlo, _read_stablehlo),
}
"""Export formats by the name that `--format` takes."""
