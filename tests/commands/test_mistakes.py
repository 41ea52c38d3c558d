"""Common mistakes, each with the line that it prints, as `docs/mistakes.md` lists them."""

import functools
import importlib
import re
import shlex
import shutil
import socket
from pathlib import Path

import pytest

import jetbot_mjx
from helpers import fake_hub
from helpers.damage import damage_about
from jetbot_mjx import __main__ as entry
from jetbot_mjx import cli
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import TaskCode, write_task_code
from jetbot_mjx.terminal import progress

PAGE = Path(__file__).parents[2] / "docs" / "mistakes.md"
ROWS = re.findall(r"^\| `(jetbot-mjx.*?)` \| `+ ?(.*?) ?`+ \|$", PAGE.read_text("utf-8"), re.M)

FILES = {
    "notes.txt": "buy wheels\n",
    "indented.yaml": "ppo:\n  num_envs: 128\n batch_size: 64\n",
    "tabs.yaml": "ppo:\n\tnum_envs: 128\n",
    "flat.yaml": "ppo:\nnum_envs: 128\n",
    "dotted.yaml": "ppo.num_envs: 128\n",
    "open.yaml": "ppo: {num_envs: 128\n",
    "twice.yaml": "seed: 1\nseed: 2\n",
    "quoted.yaml": 'ppo:\n  normalize_observations: "yes"\n',
    "reversed.yaml": "ppo.learning_rate: {low: 0.01, high: 0.001}\n",
    "listed.yaml": "ppo.learning_rate: [0.001, 0.01]\n",
    "good.yaml": "ppo.learning_rate: {low: 0.001, high: 0.01}\n",
    "my_task.py": (
        "import jax.numpy as jnp\n"
        "from jetbot_mjx import GoalTask\n"
        "class Docking(GoalTask):\n"
        "    pass\n"
        "class Shapeless:\n"
        "    pass\n"
        "class Wide(GoalTask):\n"
        "    def observe(self, robot, goal):\n"
        "        return jnp.append(super().observe(robot, goal), 0.0)\n"
        "class Failing(GoalTask):\n"
        "    def reward(self, before, after, goal, action):\n"
        "        return {}['missing']\n"
    ),
    "my_env.py": (
        "import jax\n"
        "import jax.numpy as jnp\n"
        "from jetbot_mjx import State\n"
        "class Balance:\n"
        "    action_size = 1\n"
        "    def reset(self, rng):\n"
        "        zero = jnp.zeros(())\n"
        "        return State(zero, jnp.zeros(2), zero, zero)\n"
        "    def step(self, state, action):\n"
        "        return state.replace(pipeline_state=action.sum())\n"
        "class Endless(Balance):\n"
        "    def step(self, state, action):\n"
        "        return state.replace(reward=action[0] / 0.0)\n"
        "class Deciding(Balance):\n"
        "    def step(self, state, action):\n"
        "        return state if action[0] > 0 else self.reset(None)\n"
        "class Growing(Balance):\n"
        "    def step(self, state, action):\n"
        "        return state.replace(obs=jnp.zeros(3))\n"
        "class Python(Balance):\n"
        "    def step(self, state, action):\n"
        "        return state.obs, 0.0, False, False, {}\n"
        "class Counting(Balance):\n"
        "    count = 0\n"
        "    def step(self, state, action):\n"
        "        self.count += 1\n"
        "        return state.replace(reward=jnp.float32(self.count))\n"
        "class Ending(Balance):\n"
        "    def step(self, state, action):\n"
        "        return state.replace(done=jnp.ones(()))\n"
        "class Scoring(Balance):\n"
        "    def step(self, state, action):\n"
        "        return state.replace(info={'success': jnp.float32(2)})\n"
        "    def reset(self, rng):\n"
        "        return super().reset(rng).replace(info={'success': jnp.float32(0)})\n"
        "@jax.custom_batching.custom_vmap\n"
        "def rank(x):\n"
        "    return x\n"
        "@rank.def_vmap\n"
        "def rank_of_a_batch(size, is_batched, x):\n"
        "    return x - x.mean(), True\n"
        "class Racing(Balance):\n"
        "    def step(self, state, action):\n"
        "        return state.replace(reward=rank(action[0]))\n"
    ),
    "my_env.yaml": "environment: my_env.py:Balance\n",
    "half_a_task.py": "class Docking(:\n",
}


@pytest.fixture(scope="module")
def home(tmp_path_factory, smoke_run):
    """The folder in which the page's commands are typed."""
    folder = tmp_path_factory.mktemp("home")
    for name, text in FILES.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "empty").mkdir()
    (folder / "runs" / "other").mkdir(parents=True)
    (folder / "runs" / "other" / "thesis.tex").touch()
    for name in ("mine", "damaged", "smoke-20261123-101500"):
        shutil.copytree(smoke_run, folder / "runs" / name)
    shutil.copytree(smoke_run, folder / "runs" / "cut")
    for name in ("theirs", "linked"):
        shutil.copytree(smoke_run, folder / "runs" / name)
    (folder / "runs" / "linked" / "policy").symlink_to(folder / "runs" / "other")
    write_their_task(folder / "runs" / "theirs")
    cut = folder / "runs" / "cut" / "config.yaml"
    cut.write_text(cut.read_text()[:500])
    for path in (folder / "runs" / "damaged" / "checkpoints").glob("*/policy/**/d/*"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return folder


def write_their_task(run_dir):
    """Change a run to one of a task that its folder stores."""
    write_task_code(run_dir, TaskCode("their_task", (("their_task.py", b"raise AssertionError"),)))
    change = damage_about(lambda about: about["config"]["task"].update(name="their_task:Task"))
    for checkpoint in (run_dir / "checkpoints").iterdir():
        change(checkpoint)
    config = run_dir / "config.yaml"
    config.write_text(config.read_text().replace("jetbot_mjx:GoalTask", "their_task:Task"))


@pytest.fixture
def type_(home, monkeypatch, capfd):
    """Types a command as a user would; returns the exit code and all that it prints."""
    monkeypatch.chdir(home)
    monkeypatch.setenv("COLUMNS", "80")
    # A slow machine would show what it is doing, too.
    monkeypatch.setattr(progress, "_SECONDS_BEFORE_LINE", 3600.0)

    def type_(line):
        words = shlex.split(line)[1:]
        monkeypatch.setattr("sys.argv", ["jetbot-mjx", *words[1:]])
        run = functools.partial(entry.main, words)
        if words[0] in entry.COMMANDS:
            module = importlib.import_module(f"jetbot_mjx.{entry.COMMANDS[words[0]][0]}")
            run = functools.partial(cli.run_command, module.main)
        with pytest.raises(SystemExit) as caught:
            run()
        out, err = capfd.readouterr()
        return caught.value.code, out, err.replace(str(home), "~")

    return type_


@pytest.fixture(scope="module", autouse=True)
def hub():
    """A Hub with a run and other things, for one who is logged in as ada."""
    with pytest.MonkeyPatch.context() as patch, fake_hub.serving() as server:
        patch.setenv("HF_TOKEN", "hf_ada")
        patch.setenv("HF_ENDPOINT", server.url)
        server.commit("eve/jetbot", {"config.yaml": b""})
        for name in ("ada/llm", "eve/llm"):
            server.commit(name, {"model.safetensors": b""})
        yield


@pytest.fixture(scope="module", autouse=True)
def port():
    """Port 8421 is taken, by this test or by whoever took it before."""
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            taken.bind(("127.0.0.1", 8421))
            taken.listen()
        except OSError:
            pass
        yield


@pytest.mark.slow
@pytest.mark.parametrize(("command", "answer"), ROWS, ids=[command for command, _ in ROWS])
def test_a_mistake_is_answered_by_the_pages_line(home, type_, command, answer):
    before = sorted(home.rglob("*"))
    code, out, err = type_(command.replace("\\|", "|"))
    assert (code, out) == (2, "")
    expected = re.escape(answer.replace("\\|", "|")).replace("…", ".*")
    assert re.fullmatch(f"{expected}\n", err), err
    assert [path for path in sorted(home.rglob("*")) if "__pycache__" not in path.parts] == [
        path for path in before if "__pycache__" not in path.parts
    ]


def test_the_page_lists_at_least_forty_mistakes():
    assert len(ROWS) >= 40
    assert len({command for command, _ in ROWS}) == len(ROWS)


# The same in Python, where callers catch what they know.


@pytest.mark.parametrize(
    ("mistake", "kind"),
    [
        (lambda: load_config("nowhere.yaml"), FileNotFoundError),
        (lambda: load_config("folder/nowhere.yaml"), FileNotFoundError),
        (lambda: load_config("smoke", ["ppo.num_envs=many"]), ValueError),
        (lambda: load_config("smoke", ["nonsense=1"]), ValueError),
        (lambda: parse_config({"seed": "x"}), ValueError),
        (lambda: jetbot_mjx.load_policy("runs/nowhere"), FileNotFoundError),
        (lambda: jetbot_mjx.load_policy("pretrained:nobody"), FileNotFoundError),
        (lambda: make_env(parse_config({"task": {"name": "nowhere:Task"}})), ImportError),
        (lambda: make_env(parse_config({"task": {"name": "nonsense"}})), ValueError),
        (lambda: make_env(parse_config({"task": {"name": "builtins:str"}})), ValueError),
        (lambda: make_env(parse_config({"task": {"name": "jetbot_mjx:Nobody"}})), ValueError),
    ],
)
def test_in_python_an_error_is_also_one_of_pythons(monkeypatch, tmp_path, mistake, kind):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as caught:
        mistake()
    assert isinstance(caught.value, kind)
    assert len(str(caught.value).splitlines()) == 1
