"""The functions of other libraries that the packages replace while they run."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]

PATCHED = {
    # MJX compares costs that float32 does not resolve (google-deepmind/mujoco_warp#1374).
    ("jetbot_mjx/envs/line_search.py", "solver", "_linesearch"),
    ("jetbot_mjx/envs/line_search.py", "solver._LSPoint", "create"),
    # MJX leaves corners of boxes out that are 1 mm less deep than another.
    ("jetbot_mjx/envs/box_contacts.py", "collision_driver", "_COLLISION_FUNC"),
    # JAX has no reverse mode of MJX's solver, which is a `while_loop`.
    ("onekernel/optimum.py", "solver", "solve"),
    # viser takes no origins for its websocket server.
    ("jetbot_mjx/viewers/viser_server.py", "websockets.asyncio.server", "serve"),
    # Brax 0.14 calls a function that JAX 0.10 has removed.
    ("jetbot_mjx/training/brax_trainer.py", "jax", "device_put_replicated"),
}
MOST_PATCHED = 6


def patched(source):
    """What a module replaces or adds: the object, and the name of its attribute."""
    tree = ast.parse(source)
    imported = {
        alias.asname or alias.name.partition(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Attribute(attr="object"), args=[one, ast.Constant(value), *_]):
                yield ast.unparse(one), value
            case ast.Call(func=ast.Attribute(attr="dict"), args=[ast.Attribute() as one, *_]):
                yield ast.unparse(one.value), one.attr
            case ast.Call(func=ast.Name("setattr"), args=[one, ast.Constant(value), *_]):
                yield ast.unparse(one), value
            case ast.Assign(targets=targets):
                for target in targets:
                    if isinstance(target, ast.Attribute):
                        owner = ast.unparse(target.value)
                        if owner.replace(".", "").isidentifier() and owner.partition(".")[0] in (
                            imported
                        ):
                            yield owner, target.attr


def test_few_functions_of_others_are_replaced_and_each_is_known():
    found = {
        (path.relative_to(ROOT).as_posix(), name, attribute)
        for package in ("jetbot_mjx", "onekernel")
        for path in (ROOT / package).rglob("*.py")
        for name, attribute in patched(path.read_text("utf-8"))
        # A module may replace what is its own, and a command what Python provides for that.
        if not name.startswith(("_thread", "sys"))
    }
    assert found == PATCHED
    assert len(found) <= MOST_PATCHED
