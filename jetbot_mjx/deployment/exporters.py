"""Export a policy to files, and read each file back with the library that will run it.

`numpy` is one file of Python, and `stablehlo` is serialised by `jax.export`. `onnx` is built here
node by node, from a dozen kinds of node: the maintained exporter, jax2onnx 0.17, requires an older
Orbax than this package, and installs a model viewer and a hub client.
"""

import base64
import json
import math
import re
import types
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32
from numpy.typing import ArrayLike, DTypeLike

from jetbot_mjx import runs
from jetbot_mjx.agents import Observation, Policy
from jetbot_mjx.deployment.numpy_policy import (
    Encoder,
    Layer,
    Outputs,
    OwnController,
    PortablePolicy,
)
from jetbot_mjx.envs import NUMBERS, PIXELS
from jetbot_mjx.errors import InvalidError, UserError, shown
from jetbot_mjx.runs import JsonObject

if TYPE_CHECKING:
    import onnx

_TEXT_WIDTH = 96

# The versions that onnxruntime for a Jetson Nano's JetPack reads; later ones are not needed here.
_ONNX_OPSET = 13
_ONNX_IR_VERSION = 7

_PLATFORMS = ("cpu", "cuda", "rocm", "tpu")

Act = Callable[..., Outputs]
"""A function from batches of the inputs, in their order, to actions and wheel speeds."""


class Format(NamedTuple):
    """A `Format` describes one kind of exported file."""

    file: str
    write: Callable[[PortablePolicy, Act, Path], None]
    """Write the file, from the policy as arrays or as a function of JAX."""
    read: Callable[[Path], Act]
    """Load the file as its user would, without this package."""
    needs: tuple[str, ...] = ()
    """Packages of the extra `export` that the format needs."""


def _write_numpy(policy: PortablePolicy, _: Act, path: Path) -> None:
    encoder = policy.encoder
    convolutions = encoder.convolutions if encoder else ()
    layers = [*([encoder.dense] if encoder else []), *policy.layers]
    pairs = [*(one[:2] for one in convolutions), *layers]
    arrays = [policy.mean, policy.std, *(array for pair in pairs for array in pair)]
    about = {
        "shapes": [list(array.shape) for array in arrays],
        "inputs": list(policy.inputs),
        "image": list(encoder.image_shape) if encoder else None,
        "strides": [one.stride for one in convolutions],
        "activation": policy.activation,
        "squash": policy.squash,
        "choice": policy.is_choice,
        "controller": policy.controller and policy.controller._asdict(),
    }
    numbers = base64.b64encode(b"".join(np.asarray(a, "<f4").tobytes() for a in arrays)).decode()
    lines = "\n".join(re.findall(f".{{1,{_TEXT_WIDTH}}}", numbers))
    path.write_text(_numpy_text(about, lines), encoding="utf-8")


def _numpy_text(about: JsonObject, numbers: str) -> str:
    """Return the text of `policy.py` with what it must know, and its numbers in base64."""
    template = resources.files("jetbot_mjx").joinpath("assets/policy.py").read_text("utf-8")
    text = template.replace('"""{}"""', f'"""{json.dumps(about)}"""')
    return text.replace('NUMBERS = """\n"""', f'NUMBERS = """\n{numbers}\n"""')


_MOST_PIXELS = 2**24
"""Largest size of an image that a policy takes."""


def _read_numpy(path: Path) -> Act:
    # An import would leave bytecode in a folder that is copied to a robot.
    return _act_of(path.read_text("utf-8"), path)


def _act_of(text: str, path: Path) -> Act:
    """Return the function of a file's text, which returns no tuple where there is one output."""
    module = _module_of(text, path)
    if module.ABOUT["controller"] is None:
        return lambda *inputs: (module.act(*inputs),)
    return module.act


def _module_of(text: str, path: Path) -> types.ModuleType:
    module = types.ModuleType(path.stem)
    exec(compile(text, path, "exec"), module.__dict__)
    return module


def _check_shapes(shapes: Sequence[Sequence[int]], numbers: str | None = None) -> None:
    """Check shapes before arrays are made of them, which could be of any size.

    Args:
      shapes: the shapes.
      numbers: all their float32 numbers in base64; None: there are none.

    Raises:
      ValueError: they are no shapes, or of other numbers.
    """
    if not all(type(size) is int and 0 <= size < 2**24 for shape in shapes for size in shape):
        raise ValueError(f"{shown(shapes)} are no shapes")
    total = sum(map(math.prod, shapes))
    most = _MOST_PIXELS if numbers is None else 3 * len(numbers.replace("\n", "")) // 16
    if total > most:
        raise ValueError(f"shapes of {total:,} numbers, and there are {most:,}")


def read_exported(folder: Path) -> Policy:
    """Return an exported policy as a function of the observation, as `load_policy` does of a run.

    Nothing of the file is executed: its numbers are put into the package's own text.

    Args:
      folder: a folder with `policy.py`, of an export or downloaded from a page.

    Returns:
      `policy(obs) -> action`, which is deterministic: an exported policy does not explore.

    Raises:
      UserError: the file is not such a policy.
    """
    path = folder / FORMATS["numpy"].file
    try:
        text = runs.read_text(path)
        about = re.search(r'json\.loads\("""(.*?)"""\)', text)
        numbers = re.search(r'^NUMBERS = """\n([A-Za-z0-9+/=\n]*)\n"""', text, re.MULTILINE)
        if about is None or numbers is None:
            raise ValueError("its numbers are missing")
        known = json.loads(about[1])
        _check_shapes(known["shapes"], numbers[1])
        _check_shapes([known["image"] or []])
        act = _act_of(_numpy_text(known, numbers[1]), path)
        # What is missing or does not fit shows in the first action.
        zeros = {"image": np.zeros(known["image"] or 0, np.uint8)}
        with np.errstate(divide="raise", invalid="raise", over="ignore"):
            found = act(
                *(zeros.get(name, np.zeros(known["shapes"][0])) for name in known["inputs"])
            )
        if not all(np.isfinite(one).all() for one in found):
            raise ValueError("its actions are not finite")
    except RecursionError:
        raise UserError(f"{path} is not an exported policy: it is nested too deeply") from None
    except (ValueError, LookupError, TypeError, ArithmeticError, AttributeError) as error:
        raise UserError(f"{path} is not an exported policy: {error}") from None

    def policy(obs: Observation, key: UInt32[Array, "2"] | None = None) -> Array:
        if key is not None:
            raise InvalidError("key: an exported policy has no deviations and does not explore")
        parts = (
            [obs[name] for name in (PIXELS, NUMBERS) if name in obs]
            if isinstance(obs, Mapping)
            else [obs]
        )
        try:
            return jnp.asarray(act(*map(np.asarray, parts))[0])
        except ValueError as error:
            raise InvalidError(f"observation: {error}") from None

    return policy


def _write_stablehlo(policy: PortablePolicy, as_jax: Act, path: Path) -> None:
    from jax import export

    (batch,) = export.symbolic_shape("batch")
    inputs = [jax.ShapeDtypeStruct((batch, *x.shape), x.dtype) for x in policy.inputs.values()]
    exported = export.export(jax.jit(as_jax), platforms=_PLATFORMS)(*inputs)
    path.write_bytes(exported.serialize())


def _read_stablehlo(path: Path) -> Act:
    from jax import export

    return jax.jit(export.deserialize(bytearray(path.read_bytes())).call)


class _OnnxGraph:
    """An `_OnnxGraph` collects nodes and constants."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: ArrayLike) -> str:
        """Add an array of float32 and return its name."""
        from onnx import numpy_helper

        self.constants.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def node(self, kind: str, *inputs: str, out: str, **attributes: int | list[int]) -> str:
        """Add a node and return the name of its output, `out`."""
        from onnx import helper

        node = helper.make_node(kind, inputs, [out], name=out)
        node.attribute.extend(helper.make_attribute(*one) for one in sorted(attributes.items()))
        self.nodes.append(node)
        return out

    def dense(self, layer: Layer, x: str, name: str) -> str:
        """Add a dense layer; its constants are named `kernel_name` and `bias_name`."""
        kernel = self.constant(f"kernel_{name}", layer.kernel)
        bias = self.constant(f"bias_{name}", layer.bias)
        return self.node("Gemm", x, kernel, bias, out=f"layer_{name}")

    def action(self, policy: PortablePolicy, x: str) -> None:
        """Add the outputs, from the last layer `x`."""
        constant, node = self.constant, self.node
        if policy.is_choice:
            size = policy.layers[-1].bias.size
            chosen = node("ArgMax", x, out="choice", axis=1, keepdims=0)
            numbers = constant("choices", [size]), constant("off_on", [0.0, 1.0])
            node("OneHot", chosen, *numbers, out="action")
        else:
            if policy.squash:
                x = node("Tanh", x, out="squashed")
            node("Clip", x, constant("low", -1.0), constant("high", 1.0), out="action")
        if policy.controller is None:
            return
        # Append the controller, which is linear in the action; half speed is a drive of 0.
        rows = policy.controller.mixing
        half = 0.0 if isinstance(policy.controller, OwnController) else 1.0
        offset = constant("half_speed", half * np.asarray(rows[0]))
        node("Gemm", "action", constant("mixing", rows), offset, out="wheel_speeds")

    def features(self, encoder: Encoder) -> str:
        """Add the encoder of the input `image`; ONNX has the channels before rows and columns."""
        from onnx import TensorProto

        x = self.node("Cast", "image", out="pixels", to=TensorProto.FLOAT)
        x = self.node("Transpose", x, out="channels_first", perm=[0, 3, 1, 2])
        for index, (kernel, bias, stride) in enumerate(encoder.convolutions):
            weights = self.constant(f"kernel_conv_{index}", kernel.transpose(3, 2, 0, 1))
            biases = self.constant(f"bias_conv_{index}", bias)
            x = self.node("Conv", x, weights, biases, out=f"conv_{index}", strides=[stride, stride])
            x = self.node("Relu", x, out=f"conv_{index}_relu")
        x = self.node("Transpose", x, out="channels_last", perm=[0, 2, 3, 1])
        x = self.node("Flatten", x, out="flat")
        return self.node("Relu", self.dense(encoder.dense, x, "features"), out="features")


def _write_onnx(policy: PortablePolicy, _: Act, path: Path) -> None:
    import onnx
    from onnx import helper

    graph = _OnnxGraph()
    constant, node = graph.constant, graph.node
    # Encode the image, normalise the numbers, and apply the layers with their activations.
    parts = [graph.features(policy.encoder)] if policy.encoder else []
    if policy.mean.size:
        x = node("Sub", list(policy.inputs)[-1], constant("mean", policy.mean), out="centred")
        parts.append(node("Div", x, constant("std", policy.std), out="normalised"))
    x = parts[0] if len(parts) == 1 else node("Concat", *parts, out="observed", axis=1)
    last = len(policy.layers) - 1
    for index, layer in enumerate(policy.layers):
        x = graph.dense(layer, x, str(index))
        if index < last and policy.activation == "swish":
            x = node("Mul", x, node("Sigmoid", x, out=f"gate_{index}"), out=f"hidden_{index}")
        elif index < last:
            kind = {"tanh": "Tanh", "relu": "Relu", "elu": "Elu"}[policy.activation]
            x = node(kind, x, out=f"hidden_{index}")
    graph.action(policy, x)

    def tensor(name: str, shape: Sequence[int], dtype: DTypeLike) -> "onnx.ValueInfoProto":
        kind = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
        return helper.make_tensor_value_info(name, kind, ["batch", *shape])

    # Check and write the graph.
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "policy",
            [tensor(name, x.shape, x.dtype) for name, x in policy.inputs.items()],
            [tensor(name, [size], np.float32) for name, size in policy.outputs.items()],
            graph.constants,
        ),
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
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [one.name for one in session.get_inputs()]

    def act(*inputs: np.ndarray) -> Outputs:
        return tuple(map(np.asarray, session.run(None, dict(zip(names, inputs, strict=True)))))

    return act


FORMATS = {
    "numpy": Format("policy.py", _write_numpy, _read_numpy),
    "onnx": Format("policy.onnx", _write_onnx, _read_onnx, ("onnx", "onnxruntime")),
    "stablehlo": Format("policy.stablehlo", _write_stablehlo, _read_stablehlo),
}
"""Export formats by the name that `--format` takes."""
