"""The notebooks run from top to bottom, as a reader would, on the smallest configuration."""

import importlib.util
import re
from pathlib import Path

import pytest

pytest.importorskip("ipykernel")
pytest.importorskip("nbclient")

import nbformat
from ipykernel.kernelspec import write_kernel_spec
from IPython.core.interactiveshell import InteractiveShell
from nbclient import NotebookClient

NAMES = ("01_environment", "02_train", "03_evaluate_and_render", "04_own_task")

SHORT = (
    "checkpoint_interval=16384",
    "ppo.num_timesteps=32768",
    "ppo.network.policy_hidden_layer_sizes=[32]",
    "ppo.network.value_hidden_layer_sizes=[32]",
    "evaluation.episodes=32",
)
"""For the task of one's own, whose configuration is part of the notebook."""

IMAGES = {"image/png", "image/jpeg", "image/gif"}


@pytest.fixture(scope="module")
def execute(root, tmp_path_factory):
    """Runs a notebook with this interpreter; the runs share one folder, hence the module."""
    folder = tmp_path_factory.mktemp("notebooks")
    write_kernel_spec(folder / "jupyter" / "kernels" / "this")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JETBOT_CONFIG", str(root / "configs" / "smoke.yaml"))
        patch.setenv("JETBOT_RUN_DIR", str(folder / "run"))
        # As many as are rendered, whose program is the same.
        patch.setenv("JETBOT_EPISODES", "1")
        patch.setenv("JETBOT_OWN_DIR", str(folder / "own"))
        patch.setenv("JETBOT_OVERRIDES", " ".join(SHORT))
        # Nothing of the user's own Jupyter, and nothing left in it.
        patch.setenv("JUPYTER_PATH", str(folder / "jupyter"))
        patch.setenv("JUPYTER_RUNTIME_DIR", str(folder / "runtime"))
        patch.setenv("JUPYTER_PLATFORM_DIRS", "1")
        # The kernel sets its own back end, which puts metrics into the notebook.
        patch.delenv("MPLBACKEND", raising=False)

        def run(name, profile="ipython"):
            patch.setenv("IPYTHONDIR", str(folder / profile))
            notebook = nbformat.read(root / "notebooks" / f"{name}.ipynb", as_version=4)
            client = NotebookClient(
                notebook,
                kernel_name="this",
                timeout=300,
                resources={"metadata": {"path": str(root / "notebooks")}},
            )
            return client.execute()

        yield run


@pytest.fixture(scope="module")
def gliding_profile(tmp_path_factory):
    """A folder of IPython's from which every kernel begins with a robot that glides, and with
    small videos."""
    profile = tmp_path_factory.mktemp("gliding")
    startup = profile / "profile_default" / "startup" / "glide.py"
    startup.parent.mkdir(parents=True)
    tests = str(Path(__file__).parents[1])
    startup.write_text(
        f"import sys\nsys.path.append({tests!r})\nfrom helpers import gliding\n"
        "everywhere = gliding.everywhere()\neverywhere.__enter__()\n"
        "import functools\nfrom jetbot_mjx.viewers import gallery, video\n"
        "gallery.VideoRenderer = functools.partial(video.VideoRenderer, side=64, fps=2)\n"
    )
    return profile


@pytest.fixture(scope="module")
def trained(execute, gliding_profile):
    return execute("02_train", gliding_profile)


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


def test_environment_notebook_runs(execute):
    notebook = execute("01_environment")
    assert images(notebook) == ["image/png"] * 2
    assert "<video" in html(notebook)
    assert "20 different goals in 20 episodes" in text(notebook)


def test_training_notebook_runs(trained):
    assert images(trained) == ["image/png"]
    assert "best policy" in text(trained)


def test_evaluation_notebook_shows_the_run_of_the_training_notebook(
    execute, gliding_profile, trained
):
    notebook = execute("03_evaluate_and_render", gliding_profile)
    assert images(notebook) == ["image/png", "image/png", "image/gif"]
    assert "scripted" in text(notebook)


@pytest.mark.slow
def test_the_notebook_of_a_new_task_trains_it_from_a_blank_class(execute, gliding_profile):
    notebook = execute("04_own_task", gliding_profile)
    assert images(notebook) == ["image/png", "image/gif"]
    assert "blank_task:BlankTask sees" in text(notebook)
    assert "training parking_task:ParkingTask" in text(notebook)
    assert "reward/parked" in text(notebook)


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
    for source, package in (("https://host/x.git", "git+https://host/x.git"), ("x.whl", "x.whl")):
        named = code.source.replace('SOURCE = ""', f'SOURCE = "{source}"')
        assert shell.run_cell(named).success
        assert typed.pop() == f"install --quiet {package}"


def test_every_notebook_is_tested(root):
    assert sorted(path.stem for path in (root / "notebooks").glob("*.ipynb")) == list(NAMES)
