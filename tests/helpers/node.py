"""Node, which runs the scripts of web pages without a browser."""

import base64
import json
import shutil
import subprocess

import numpy as np
import pytest

from helpers.source_tree import ROOT

_WEB = ROOT / "jetbot_mjx" / "assets" / "web"

_KINDS = {
    "Float32Array": np.float32,
    "Float64Array": np.float64,
    "Uint32Array": np.uint32,
    "Int32Array": np.int32,
    "Uint8Array": np.uint8,
}
_NAMES = {np.dtype(kind): name for name, kind in _KINDS.items()}

# Typed arrays travel as an object of their kind and their bytes in base64.
_PROGRAM = """
const fs = require("fs"), vm = require("vm");
const [given, ...sources] = JSON.parse(fs.readFileSync(0), (_, value) => {
  if (!value || !value.typed) return value;
  const bytes = Uint8Array.from(Buffer.from(value.bytes, "base64"));
  return new globalThis[value.typed](bytes.buffer);
});
const told = (_, value) => ArrayBuffer.isView(value)
  ? { typed: value.constructor.name,
      bytes: Buffer.from(value.buffer, value.byteOffset, value.byteLength).toString("base64") }
  : value;
// A script sees the classes and functions of those before it.
const last = sources.map((source) => vm.runInThisContext(source)).pop();
Promise.resolve(last(given)).then((result) =>
  fs.writeFileSync(1, JSON.stringify(result ?? null, told)));
"""


def run(body, *, page=True, timeout=300, **given):
    """Run the body of a function in Node.

    Args:
      body: the body of an asynchronous function of `given`.
      page: whether it may use the classes of `engine.js` and `learner.js`.
      timeout: the longest time that it may take [s].
      **given: values of JSON, arrays and bytes among them.

    Returns:
      What the function returns; typed arrays are arrays.
    """
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node is not installed")
    files = ("engine.js", "learner.js") if page else ()
    sources = [(_WEB / file).read_text("utf-8") for file in files]
    request = json.dumps([given, *sources, f"(async (given) => {{{body}}})"], default=_typed)
    done = subprocess.run(
        [node, "--stack-trace-limit=20", "-e", _PROGRAM],
        input=request,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    # `console.error` is a mistake, too.
    assert done.stderr == ""
    return json.loads(done.stdout, object_hook=_array)


def _typed(value):
    value = np.frombuffer(value, np.uint8) if isinstance(value, bytes) else np.asarray(value)
    text = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
    return {"typed": _NAMES[value.dtype], "bytes": text}


def _array(value):
    if "typed" not in value:
        return value
    return np.frombuffer(base64.b64decode(value["bytes"]), _KINDS[value["typed"]])
