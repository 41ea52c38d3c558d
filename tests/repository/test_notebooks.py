"""The notebooks run from top to bottom, as a reader would, on the smallest configuration."""

import importlib.util
import re
import shutil
import sys
import types
from pathlib import Path

import pytest

pytest.importorskip("ipykernel")
pytest.importorskip("nbclient")

import nbformat
from ipykernel.kernelspec import write_kernel_spec
from IPython.core.interactiveshell import InteractiveShell
from nbclient import NotebookClient

NAMES = (
    *("01_environment", "02_train", "03_evaluate_and_render", "04_own_task"),
    "05_one_kernel",
)

SHORT = (
    "checkpoint_interval=16384",
    "ppo.num_timesteps=32768",
    "ppo.network.policy_hidden_layer_sizes=[32]",
    "ppo.network.value_hidden_layer_sizes=[32]",
    "evaluation.episodes=32",
)
"""For the task of one's own, whose configuration is part of the notebook."""

IMAGES = {"image/png", "image/jpeg", "image/gif"}


GLIDE = f"""
import atexit, functools, sys
sys.path.append({str(Path(__file__).parents[1])!r})
from helpers import gliding
everywhere = gliding.everywhere()
everywhere.__enter__()
atexit.register(everywhere.__exit__, None, None, None)  # not before, though its name is forgotten
from jetbot_mjx.viewers import gallery, video
gallery.VideoRenderer = lambda env, size, of=video.VideoRenderer: of(env, (128, 64), fps=2)
"""
"""What the kernel begins with: a robot that glides, and small videos."""


@pytest.fixture(scope="module")
def kernel(root, tmp_path_factory):
    """One process for all notebooks, which imports once what they import."""
    folder = tmp_path_factory.mktemp("notebooks")
    write_kernel_spec(folder / "jupyter" / "kernels" / "this")
    startup = folder / "ipython" / "profile_default" / "startup" / "glide.py"
    startup.parent.mkdir(parents=True)
    startup.write_text(GLIDE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JETBOT_CONFIG", str(root / "configs" / "smoke.yaml"))
        patch.setenv("JETBOT_RUN_DIR", str(folder / "run"))
        # As many as are rendered, whose program is the same.
        patch.setenv("JETBOT_EPISODES", "1")
        patch.setenv("JETBOT_OWN_DIR", str(folder / "own"))
        patch.setenv("ONEKERNEL_INSTANCES", "32")
        # XLA compiles the hopper for a quarter of a minute, a pendulum for a second.
        patch.setenv("ONEKERNEL_MODEL", "pendulum")
        patch.setenv("JETBOT_OVERRIDES", " ".join(SHORT))
        # Nothing of the user's own Jupyter, and nothing left in it.
        patch.setenv("JUPYTER_PATH", str(folder / "jupyter"))
        patch.setenv("JUPYTER_RUNTIME_DIR", str(folder / "runtime"))
        patch.setenv("JUPYTER_PLATFORM_DIRS", "1")
        patch.setenv("IPYTHONDIR", str(folder / "ipython"))
        # The kernel sets its own back end, which puts metrics into the notebook.
        patch.delenv("MPLBACKEND", raising=False)
        resources = {"metadata": {"path": str(root / "notebooks")}}
        client = NotebookClient(
            nbformat.v4.new_notebook(), kernel_name="this", timeout=300, resources=resources
        )
        with client.setup_kernel():
            yield client


@pytest.fixture(scope="module")
def execute(root, kernel):
    """Runs a notebook; the runs share one folder, hence the module."""

    def run(name):
        notebook = nbformat.read(root / "notebooks" / f"{name}.ipynb", as_version=4)
        # It finds no name of the notebook before it.
        notebook.cells.insert(0, nbformat.v4.new_code_cell("%reset -f"))
        kernel.nb = notebook
        return kernel.execute(cleanup_kc=False)

    return run


@pytest.fixture(scope="module")
def trained(execute):
    return execute("02_train")


@pytest.fixture(scope="module")
def read(root):
    return {
        name: nbformat.read(root / "notebooks" / f"{name}.ipynb", as_version=4) for name in NAMES
    }


def images(notebook):
    """MIME types of the images in the outputs."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert not [output for output in outputs if output.output_type == "error"]
    return [mime for output in outputs for mime in output.get("data", {}) if mime in IMAGES]


def text(notebook):
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return "".join(output.get("text", "") for output in outputs)


def html(notebook):
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return "".join(output.get("data", {}).get("text/html", "") for output in outputs)


@pytest.mark.parametrize("name", NAMES)
def test_committed_notebooks_hold_the_outputs_of_one_run(read, name):
    nbformat.validate(read[name])
    code = [cell for cell in read[name].cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert images(read[name])  # none of the outputs is an error
    assert not re.search(r"Traceback|Error:", text(read[name]))


@pytest.mark.parametrize("name", NAMES)
def test_committed_notebooks_are_small(root, name):
    assert (root / "notebooks" / f"{name}.ipynb").stat().st_size < 1_000_000


@pytest.mark.parametrize("name", NAMES)
def test_the_first_cell_installs_what_is_not_there(read, name, monkeypatch):
    code = next(cell for cell in read[name].cells if cell.cell_type == "code")
    assert code.source == read[NAMES[0]].cells[1].source
    typed = []
    shell = InteractiveShell()
    shell.register_magic_function(typed.append, magic_name="pip")
    monkeypatch.setattr(shell, "system", lambda line: typed.append(line))
    # Installed: nothing to do. Elsewhere: it asks for the source, and installs it.
    assert shell.run_cell(code.source).success
    assert typed == []
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "name a SOURCE" in str(shell.run_cell(code.source).error_in_exec)
    for gpu, extra in ((None, ""), ("/usr/bin/nvidia-smi", "[cuda]")):
        monkeypatch.setattr(shutil, "which", lambda name, gpu=gpu: gpu)
        for source, package in (
            ("https://host/x.git", f"jetbot_mjx{extra}@git+https://host/x.git"),
            ("x.whl", f"x.whl{extra}"),
        ):
            named = code.source.replace('SOURCE = ""', f'SOURCE = "{source}"')
            assert shell.run_cell(named).success
            assert typed.pop() == f"install --quiet {package}"


@pytest.mark.parametrize("name", NAMES)
def test_in_colab_the_first_cell_looks_for_a_gpu(read, name, monkeypatch, capsys):
    assert "colab-badge.svg)](https://colab.research.google.com/" in read[name].cells[0].source
    monkeypatch.setitem(sys.modules, "google.colab", types.ModuleType("google.colab"))
    for gpu, told in ((None, "no GPU here: all of it works, but slower"), ("nvidia-smi", "")):
        monkeypatch.setattr(shutil, "which", lambda name, gpu=gpu: gpu)
        assert InteractiveShell().run_cell(read[name].cells[1].source).success
        assert capsys.readouterr().out.partition(";")[0] == told


@pytest.mark.parametrize("name", NAMES[:1])
def test_in_colab_what_its_own_jax_needed_is_taken_away(read, name, monkeypatch):
    typed = []
    shell = InteractiveShell()
    shell.register_magic_function(typed.append, magic_name="pip")
    monkeypatch.setattr(shell, "system", typed.append)
    monkeypatch.setitem(sys.modules, "google.colab", types.ModuleType("google.colab"))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    source = read[name].cells[1].source.replace('SOURCE = ""', 'SOURCE = "x.whl"')
    assert shell.run_cell(source).success
    installed, removed, library = typed
    assert installed.startswith("install --quiet x.whl")
    assert removed == "uninstall -qq --yes jax-cuda12-plugin jax-cuda12-pjrt"
    assert library == "apt-get -qq install libegl1 libegl-mesa0"


def test_every_notebook_is_tested(root):
    assert sorted(path.stem for path in (root / "notebooks").glob("*.ipynb")) == list(NAMES)


# What follows asks for the kernel, which ends, and is paid for, with the last.


@pytest.mark.slow
def test_environment_notebook_runs(execute):
    notebook = execute("01_environment")
    assert images(notebook) == ["image/png"] * 2
    assert "<video" in html(notebook)
    assert "20 different goals in 20 episodes" in text(notebook)


@pytest.mark.slow
def test_training_notebook_runs(trained):
    assert images(trained) == ["image/png"]
    assert "best policy" in text(trained)


@pytest.mark.slow
def test_evaluation_notebook_shows_the_run_of_the_training_notebook(execute, trained):
    notebook = execute("03_evaluate_and_render")
    assert images(notebook) == ["image/png", "image/png", "image/gif"]
    assert "scripted" in text(notebook)


@pytest.mark.slow
def test_the_notebook_about_kernels_compares_them_with_xla_and_c_mujoco(execute):
    notebook = execute("05_one_kernel")
    assert images(notebook) == ["image/png"]
    printed = text(notebook)
    assert printed.count("one kernel   compiled in") == 3
    assert printed.count("XLA          compiled in") == 3
    assert printed.count("M instances a second") == 6
    assert "balance is one kernel" in printed
    # Of a chaotic system, round-off grows; it is small after the time that is integrated here.
    apart, state, position, velocity = re.findall(
        r"largest difference (?:of a (?:state|position|velocity) )?(\S+?),?\s", printed
    )
    assert float(apart) < 0.02
    # Poles that fell, and began anew from the same keys.
    falls, by_xla = re.search(r"(\S+) falls of a pole in the mean, (\S+) by XLA", printed).groups()
    assert falls == by_xla
    assert float(falls) > 1
    assert float(state) < 1e-4
    assert float(position) < 1e-6
    assert float(velocity) < 1e-5


@pytest.mark.slow
def test_the_notebook_of_a_new_task_trains_it_from_a_blank_class(execute):
    notebook = execute("04_own_task")
    assert images(notebook) == ["image/png", "image/gif"]
    assert "blank_task:BlankTask sees" in text(notebook)
    assert "training parking_task:ParkingTask" in text(notebook)
    assert "reward/parked" in text(notebook)
