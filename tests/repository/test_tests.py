"""How the tests are laid out: every module has its tests, and no test needs another one.

The tests of `jetbot_mjx/<room>/…/<module>.py` are in `test_<module>.py`, in `tests/<room>/` or a
folder below; those of a module beside the rooms in `tests/` or `tests/commands/`; those of the
engine in `tests/onekernel/`. Modules that only make sense together are listed in `TOGETHER`.
"""

import ast
import re

import pytest

from helpers.source_tree import ENGINE, PACKAGE, ROOT, functions, imports, modules_of

TESTS = ROOT / "tests"

TOGETHER = {
    "adapters/test_gymnasium": "adapters.arguments adapters.base adapters.renderer envs.mujoco_env",
    "adapters/test_vector": "adapters.batched_env",
    "agents/test_fused_learner": "agents.fused",
    "agents/test_choose_learner": "agents.learner",
    "agents/test_ppo": "agents.brax_parts agents.train_state agents.xla_learner"
    " training.brax_trainer",
    "agents/test_unroll": "agents.fused.cpu_actions",
    "agents/test_update_kernels": "agents.fused",
    "agents/test_vision": "agents.cnn_sizes",
    "commands/test_evaluate": "evaluation.evaluate_runs",
    "commands/test_check_robot": "envs.robot_facts",
    "commands/test_export": "deployment.exporters deployment.numpy_policy deployment.policy_export"
    " deployment.policy_spec",
    "commands/test_main": "__main__",
    "commands/test_new_robot": "envs.robot_template",
    "commands/test_new_task": "envs.task_template",
    "commands/test_play": "viewers.live",
    "commands/test_render": "viewers.gallery",
    "commands/test_replay": "runs.nan_dump",
    "commands/test_web_page": "deployment.web_page deployment.web_scene",
    "config/test_files": "config.errors",
    "config/test_load": "config.evaluation config.task",
    "config/test_quantities": "config.look_quantities config.randomization config.robot_quantities",
    "deployment/test_camera_drive": "deployment.drive_pictures deployment.simulated_camera",
    "deployment/test_deploy": "deployment.drive_comparison deployment.drive_log sim2real",
    "envs/camera/test_drawn_looks": "envs.camera.timing",
    "envs/camera/test_lens": "config.camera",
    "envs/camera/test_looks": "envs.camera.scene envs.camera.surroundings",
    "envs/camera/test_mujoco_camera": "envs.camera.scenery",
    "envs/camera/test_pictures": "envs.camera.geometry envs.camera.pixel envs.camera.render",
    "envs/test_checks": "envs.checks",
    "envs/test_jetbot_env": "envs.state",
    "envs/test_mjcf_robot": "envs.mjcf_wheels",
    "envs/test_mjx": "mjx_import",
    "evaluation/test_comparison": "evaluation.tables",
    "evaluation/test_evaluator": "evaluation.rollout",
    "evaluation/test_plots": "evaluation.learning_curves",
    "onekernel/test_fuse": "onekernel.explanation",
    "onekernel/test_fused": "onekernel.traced",
    "onekernel/test_llvm_backend": "onekernel.cpu",
    "onekernel/test_llvm_codegen": "onekernel.codegen onekernel.cpu",
    "onekernel/test_lower_jaxpr": "onekernel.lower.jaxpr onekernel.lower.control_flow"
    " onekernel.lower.derived_carries",
    "onekernel/test_operations": "onekernel.lower.arithmetic onekernel.lower.dynamic_indexing"
    " onekernel.lower.expansions",
    "onekernel/test_program_cache": "envs.program_key",
    "onekernel/test_ptx_backend": "onekernel.gpu",
    "onekernel/test_scalar_ir": "onekernel.lower.indexing",
    "runs/test_checkpoint_store": "runs.checkpoint_writer",
    "runs/test_task_code": "training.composition",
    "startup/test_interrupts": "interrupts",
    "startup/test_switch": "startup.process",
    "training/test_memory": "runs.setup",
    "training/test_run_recorder": "training.callbacks",
    "training/test_dashboard": "training.terminal",
    "viewers/test_many": "viewers.grid_renderer viewers.robot_grid",
    "viewers/test_player": "viewers.step_fns",
    "viewers/test_policy_view": "viewers.viser_policy_view",
    "viewers/test_video": "viewers.offscreen",
    "viewers/test_viser_server": "viewers.viser_camera viewers.viser_panel viewers.viser_scene",
}
"""Modules, or whole folders of them, that a file tests besides the module of its name. Several
files may test the same."""

MODULES = [
    name
    for package in (PACKAGE, ENGINE)
    for name, path in modules_of(package).items()
    if path.stem != "__init__"
]


def full_names(text):
    """Names of the table in full: all but those of the engine leave out the package."""
    return [x if x.split(".")[0] == ENGINE else f"{PACKAGE}.{x}" for x in text.split()]


LISTED = {name for text in TOGETHER.values() for name in full_names(text)}


def own_files(name):
    """The files that are a module's tests by their name."""
    package, *rooms, module = name.split(".")
    if package == ENGINE:
        folders = {TESTS / ENGINE: "**/"}
    elif rooms:
        folders = {TESTS / rooms[0]: "**/"}
    else:
        folders = {TESTS: "", TESTS / "commands": ""}
    pattern = f"test_{module}.py"
    return [x for folder, deep in folders.items() for x in folder.glob(f"{deep}{pattern}")]


def is_listed(name):
    """Whether the table has the module, or a folder that it is in."""
    parts = name.split(".")
    return any(".".join(parts[:end]) in LISTED for end in range(2, len(parts) + 1))


@pytest.mark.parametrize("name", MODULES)
def test_every_module_has_its_tests(name):
    remedy = f"write test_{name.rpartition('.')[2]}.py, or name a file in TOGETHER"
    assert own_files(name) or is_listed(name), f"nothing tests {name}: {remedy}"


def test_the_table_names_what_there_is_and_no_more():
    for file in TOGETHER:
        assert (TESTS / f"{file}.py").is_file(), f"there is no tests/{file}.py"
    known = {*MODULES, *(name for name in modules_of(PACKAGE) | modules_of(ENGINE))}
    assert known >= LISTED, LISTED - known
    needless = [name for name in LISTED & {*MODULES} if own_files(name)]
    assert needless == [], "these have a file of their name"


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("jetbot_mjx.envs.task", True),
        ("jetbot_mjx.envs.camera.lens", True),
        ("jetbot_mjx.train", True),
        ("jetbot_mjx.errors", True),
        ("jetbot_mjx.agents.fused.adam", True),
        ("onekernel.lower.scalar_ir", True),
        ("jetbot_mjx.envs.nothing", False),
        ("jetbot_mjx.viewers.task", False),  # the file of this name is another room's
        ("jetbot_mjx.nothing", False),
        ("onekernel.nothing", False),
    ],
)
def test_a_module_without_tests_is_seen(name, found):
    assert bool(own_files(name) or is_listed(name)) is found


# No test needs another one.


TEST_FILES = sorted(TESTS.rglob("*.py"))
IN_A_PROGRAM = re.compile(r"\b(?:import|from) +(?:[\w.]+\.)?(test_\w+|conftest)\b")


def borrowed(source):
    """Modules of tests that a file imports, itself or in a program that it writes."""
    for name in imports(source):
        yield from (part for part in name.split(".") if re.match("test_|conftest$", part))
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from IN_A_PROGRAM.findall(node.value)


@pytest.mark.parametrize("path", TEST_FILES, ids=lambda path: str(path.relative_to(TESTS)))
def test_no_test_imports_another(path):
    found = list(borrowed(path.read_text("utf-8")))
    assert found == [], "move what they share into tests/helpers"


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("from {}_ppo import TINY", True),
        ("from tests.agents import {}_ppo", True),
        ("def late():\n    import {}_ppo as ppo", True),
        ("PROGRAM = 'import sys; import {}_ppo; {}_ppo.main()'", True),
        ("from conf{} import ROOT", True),
        ("from helpers.small_ppo import {}ed", False),
        ("import {}", False),
    ],
)
def test_an_import_of_a_test_is_seen(line, found):
    # Put together here, so that this file does not import it either.
    assert bool(list(borrowed(line.format(*["test"] * 3)))) is found


def test_helpers_hold_no_tests():
    for path in (TESTS / "helpers").glob("*.py"):
        names = [name for name, _ in functions(ast.parse(path.read_text("utf-8")))]
        assert not [name for name in names if name.startswith("test_")], path.name
