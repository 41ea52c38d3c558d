"""Write arrays with TensorStore in the format of Orbax, which takes five times as long for it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tensorstore as ts

_CONTEXT = {
    # Two threads are enough for one checkpoint at a time, and leave the others to the training.
    "data_copy_concurrency": {"limit": 2},
}


def write_arrays(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays, which Orbax's `StandardCheckpointer` can read.

    Args:
      folder: the folder to create.
      arrays: the arrays by name.

    Raises:
      Exception: TensorStore could not write them; it raises many kinds.
    """
    key_value_store(folder)  # refuses a folder that nothing could be read from
    # TensorStore writes into memory: where a drive fails, some of its commits never end.
    memory: dict[str, Any] = {"driver": "memory"}
    context = ts.Context(_CONTEXT)
    with ts.Transaction() as transaction:
        for name, array in arrays.items():
            place = {"driver": "ocdbt", "base": memory, "path": f"{name}/"}
            store = ts.open(
                {"driver": "zarr", "kvstore": place, "store_data_equal_to_fill_value": True},
                create=True,
                dtype=array.dtype,
                shape=array.shape,
                chunk_layout=ts.ChunkLayout(chunk_shape=[max(1, size) for size in array.shape]),
                transaction=transaction,
                context=context,
            ).result()
            store.write(array).result()
    files = ts.KvStore.open(memory, context=context).result()
    folder.mkdir()
    for key in files.list().result():
        file = folder / key.decode()
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(files.read(key).result().value)
    (folder / "_METADATA").write_text(json.dumps(_metadata(arrays)))


def key_value_store(folder: Path) -> dict[str, Any]:
    """Return what TensorStore calls the specification of the arrays' files in a folder.

    Raises:
      ValueError: it would find nothing there.
    """
    # It refuses a path with `..` in it.
    path = f"{folder.resolve().as_posix()}/"
    if "\\" in path or path != path.encode(errors="ignore").decode():
        raise ValueError("its path has a backslash, or bytes that are not UTF-8: rename the folder")
    return {"driver": "ocdbt", "base": {"driver": "file", "path": path}}


def _metadata(names: Mapping[str, np.ndarray]) -> Mapping[str, object]:
    """Return what Orbax reads before the arrays."""
    value = {"value_type": "np.ndarray", "skip_deserialize": False}
    return {
        "tree_metadata": {
            str((name,)): {
                "key_metadata": [{"key": name, "key_type": 2}],
                "value_metadata": value,
            }
            for name in names
        },
        "use_ocdbt": True,
        "use_zarr3": False,
        "store_array_data_equal_to_fill_value": True,
        "custom_metadata": None,
    }
