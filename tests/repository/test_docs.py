"""The documentation: complete, in step with the code, and every command and example of it works."""

import argparse
import contextlib
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ruamel.yaml import YAML

from helpers.doc_pages import (
    ALL_PAGES,
    COMMANDS,
    DEMO,
    DOCS,
    GENERATED,
    PAGES,
    REFERENCE,
    ROOT,
    blocks,
    commands,
    in_full,
    load,
    own_files,
    reference,
)
from helpers.further import slow_fixture
from jetbot_mjx import (
    cli,
)
from jetbot_mjx.agents import LOSSES
from jetbot_mjx.config import (
    CHANGEABLE_ON_RESUME,
    QUANTITIES,
    Config,
    ConfigError,
    LookParams,
    RobotParams,
    load_config,
    parse_config,
    shipped_configs,
)
from jetbot_mjx.envs import write_environment_template
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.runs import metrics
from jetbot_mjx.runs.sb3_tags import aliases
from onekernel import fuse, gpu
from onekernel.gpu.kernel_text import kernel_text

NAV = YAML(typ="safe").load(ROOT / "mkdocs.yml")["nav"]


def pages_of(entry):
    """Pages of an entry of the navigation."""
    match entry:
        case str():
            yield entry
        case dict():
            for value in entry.values():
                yield from pages_of(value)
        case list():
            for value in entry:
                yield from pages_of(value)


# Pages and links.


def test_every_page_is_in_the_navigation():
    assert sorted(pages_of(reference.with_reference(NAV))) == sorted(ALL_PAGES)


def test_every_page_is_linked_from_the_first():
    """From the overview; the rooms from the page of public names, and their parts from them."""

    def linked(page):
        found = re.findall(r"\]\(([^)#]+\.md)", ALL_PAGES[page])
        return {os.path.normpath(Path(page).parent / target) for target in found}

    assert linked("index.md") | {"index.md"} >= ALL_PAGES.keys() - REFERENCE.keys()
    rooms = linked("api/index.md") & REFERENCE.keys()
    assert rooms == {page for page in REFERENCE if page.endswith("/index.md")}
    assert rooms.union(*map(linked, rooms)) >= REFERENCE.keys()


def groups():
    """Titles and pages by the groups of the navigation."""
    return {
        group: [(title, page) for entry in pages for title, page in entry.items()]
        for entry in NAV
        for group, pages in entry.items()
        if isinstance(pages, list)
    }


def test_the_first_page_has_the_groups_of_the_navigation():
    found = {}
    for line in PAGES["index.md"].splitlines():
        if group := re.match(r"\| \*\*(.+)\*\* \|", line):
            found[group[1]] = []
        elif row := re.match(r"\| .+? \| \[(.+?)\]\((\S+?)\)", line):
            found[next(reversed(found))].append((row[1], row[2]))
    assert found == groups()


def test_the_index_for_assistants_has_the_groups_of_the_navigation():
    text = (DOCS / "llms.txt").read_text("utf-8")
    found = {
        section.partition("\n")[0]: re.findall(r"^- \[(.+?)\]\((\S+?)\)", section, re.M)
        for section in text.split("\n## ")[1:]
    }
    found["Start"].remove(("Overview", "index.md"))
    assert found == groups()


def test_a_page_of_the_reference_is_short():
    """None has more than a class or a family of functions, so that it can be read as one."""
    public = {page: text.partition("\n:::")[0] for page, text in REFERENCE.items()}
    for page, text in public.items():
        if not page.endswith(("/index.md", "/inside.md")):
            assert text.count("\n    ") <= 25, page


def test_every_module_has_its_place_in_the_reference():
    told = re.findall(r"^::: ([\w.]+)$", "\n".join(ALL_PAGES.values()), flags=re.M)
    paths = [*(ROOT / "jetbot_mjx").rglob("*.py"), *(ROOT / "onekernel").rglob("*.py")]
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in paths
        if "assets" not in path.parts
    }
    # The docstring of a room is the text of its page.
    rooms = {
        ".".join(x.parent.relative_to(ROOT).parts) for x in ROOT.glob("jetbot_mjx/*/__init__.py")
    }
    rooms |= {"jetbot_mjx", "onekernel"}
    assert sorted(told) == sorted(modules - rooms)


def test_every_public_name_is_listed(root):
    for name in re.findall(r" as (\w+)$", (root / "jetbot_mjx/__init__.pyi").read_text(), re.M):
        if not name.startswith("_"):
            assert f"[`{name}`][jetbot_mjx." in PAGES["api/index.md"]


@pytest.mark.parametrize("page", ALL_PAGES)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]*)(?:#[^)]*)?\)", ALL_PAGES[page]):
        if target:
            path = os.path.normpath(Path(page).parent / target)
            assert path in ALL_PAGES or path in DEMO or (DOCS / path).is_file(), target


@pytest.mark.parametrize("page", ALL_PAGES)
def test_files_that_are_named_exist(page):
    named = re.findall(
        r"\b(?:configs|examples|benchmarks|deploy|jetbot_mjx|tests|notebooks)/[\w/.-]+\.\w+",
        ALL_PAGES[page],
    )
    assert [name for name in named if not (ROOT / name).is_file()] == []


def test_the_design_page_counts_and_lists_the_rooms():
    rooms = {path.parent.name for path in (ROOT / "jetbot_mjx").glob("*/__init__.py")}
    page = PAGES["design.md"]
    (count,) = re.findall(r"is (\d+) rooms", page)
    assert int(count) == len(rooms)
    assert set(re.findall(r"^\| \[`(\w+)`\]", page, re.MULTILINE)) == rooms | {"onekernel"}


def test_the_stages_of_a_training_step_are_where_the_page_says():
    """Each path, and each function or class behind it, of the last table on the kernels' page."""
    table = PAGES["kernels.md"].partition("## Where it is")[2]
    found = re.findall(r"`([\w/]+\.py)`(?:: ((?:`[\w.]+`(?:, )?)+))?", table)
    assert len(found) > 20
    for path, names in found:
        folder = ROOT if path.startswith(("onekernel/", "tests/")) else ROOT / "jetbot_mjx/agents"
        code = (folder / path).read_text("utf-8")
        for name in re.findall(r"[\w.]+", names):
            assert re.search(rf"(def|class) {name.rpartition('.')[2]}\b", code), f"{path}: {name}"


@pytest.mark.parametrize("page", PAGES)
def test_lines_are_short(page):
    long = [
        line
        for line in PAGES[page].splitlines()
        if len(line) > 120 and not line.lstrip().startswith(("|", "!["))
    ]
    assert long == []


@slow_fixture(scope="module")
def site(tmp_path_factory):
    for name in ("mkdocs", "material", "mkdocstrings_handlers.python"):
        pytest.importorskip(name)
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "NO_COLOR": "1"}
    built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    return folder


@pytest.mark.slow
def test_the_site_builds_without_a_warning(site):
    assert all((site / page.replace(".md", ".html")).is_file() for page in ALL_PAGES)
    assert not list(site.rglob("*.py"))
    html = (site / "api/envs/jetbot_env.html").read_text("utf-8")
    assert 'id="jetbot_mjx.envs.jetbot_env.JetBotEnv.step"' in html
    # What docstrings.py mends.
    yaw = (site / "api/envs/kinematics.html").read_text("utf-8")
    assert "Yaw in (-π, π] [rad]" in yaw
    assert "seed-&lt;n&gt;" in (site / "api/runs/run_dir.html").read_text("utf-8")
    told = (site / "api/runs/metrics.html").read_text("utf-8")
    assert "<code>eval/episodes  " in told.replace("<pre><span></span>", "")


@pytest.mark.slow
def test_the_site_has_its_pages_as_markdown_too(site):
    assert (site / "llms.txt").read_text("utf-8") == (DOCS / "llms.txt").read_text("utf-8")
    for page in ALL_PAGES.keys() - REFERENCE.keys():
        assert (site / page).read_text("utf-8") == ALL_PAGES[page]


def test_the_site_loads_nothing_from_elsewhere(site):
    for path in site.rglob("*.html"):
        loaded = re.findall(
            r'<(?:script|link|img)[^>]*(?:src|href)="(https?:[^"]*)"', path.read_text()
        )
        assert loaded == [], path


# The configuration.


def rows(text):
    """Cells of every row of every table."""
    for line in text.splitlines():
        if line.startswith("| ") and not line.startswith("|--"):
            yield [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def leaves(values, prefix=""):
    """Keys with their sections, and values; of the free options one key."""
    for key, value in values.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


DEFAULTS = dict(leaves(Config().model_dump(mode="json")))
SETTINGS = {
    cells[0].split("`")[1]: cells
    for cells in rows(ALL_PAGES[GENERATED].partition("{ #shipped }")[0])
    if cells[0].startswith("`")
}


def test_every_setting_is_in_the_reference():
    assert sorted(SETTINGS) == sorted(DEFAULTS)


@pytest.mark.parametrize("key", DEFAULTS)
def test_a_setting_has_its_default_and_its_meaning(key):
    name, kind, default, meaning = SETTINGS[key]
    assert YAML(typ="safe", pure=True).load(default.split("`")[1]) == DEFAULTS[key]
    assert ("↻" in name) == (key in CHANGEABLE_ON_RESUME)
    assert kind
    assert len(meaning) > 10


def with_value(key, value):
    for part in reversed(key.split(".")):
        value = {part: value}
    return parse_config(value)


# Of a number, not of a list's length.
LOWER_BOUND = re.compile(r", at least ([\d.e-]+)")


@pytest.mark.parametrize("key", [key for key in DEFAULTS if LOWER_BOUND.search(SETTINGS[key][1])])
def test_a_lower_bound_is_the_one_that_holds(key):
    kind = SETTINGS[key][1]
    bound = float(LOWER_BOUND.findall(kind)[-1])
    below = int(bound) - 1 if "whole" in kind else bound - 1e-7
    with pytest.raises(ConfigError, match=r"greater than or equal|at least"):
        with_value(key, [below] if "list" in kind else below)
    # Where the bound itself is refused, it is for another reason.
    with contextlib.suppress(ConfigError):
        with_value(
            key, [int(bound)] if "list" in kind else int(bound) if "whole" in kind else bound
        )


@pytest.mark.parametrize(
    ("word", "message"),
    [("above 0", "greater than 0"), ("at most 1", "less than or equal"), ("below 2^", "less than")],
)
def test_other_bounds_are_those_that_hold(word, message):
    keys = [key for key, cells in SETTINGS.items() if word in cells[1]]
    assert keys
    for key in keys:
        kind = SETTINGS[key][1]
        if word == "above 0":
            value = 0.0
        elif "below 2^" in word:
            value = 2 ** int(re.findall(r"below 2\^(\d+)\^", kind)[0])
        else:
            value = 1 + float(re.findall(r"at most (\d+)", kind)[0])
            value = int(value) if "whole" in kind else value
        with pytest.raises(ConfigError, match=message):
            with_value(key, [value] if "list" in kind else value)


def test_the_shipped_files_are_told(root):
    table = list(rows(ALL_PAGES[GENERATED].partition("{ #shipped }")[2].partition("\n## ")[0]))
    names = [name.strip("`") for name in table[0][1:]]
    assert names == sorted(path.stem for path in (root / "configs").glob("*.yaml"))
    told = {cells[0].strip("`"): dict(zip(names, cells[1:], strict=True)) for cells in table[1:]}
    assert told["ppo.num_envs"]["gpu"] == "`4096`"
    assert told["ppo.clipping_epsilon"]["gpu"] == ""


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("randomization.md", RobotParams._fields),
        ("camera.md", LookParams._fields),
        ("robustness.md", tuple(QUANTITIES)),
    ],
)
def test_every_quantity_has_its_row(page, names):
    keys = [cells[0].strip("`") for cells in rows(PAGES[page])]
    assert tuple(key for key in keys if key in QUANTITIES) == names


@pytest.mark.parametrize(
    ("page", "row"),
    [
        (
            "randomization.md",
            "| `start_yaw` | [rad] heading at the start, counter-clockwise. | -π, π |",
        ),
        (
            "randomization.md",
            "| `height_offset` | [m] offset of the observed height, constant over",
        ),
        ("camera.md", "| `camera_delay` | [control steps] delay of the images. | 0, 2 | EST 30 to"),
        ("camera.md", "stays. | - | BOM cameras of 10 to 60 images a second |"),
        (
            "robustness.md",
            "| `friction` | wheel-floor friction | × preset | 0.3, 0.4, 0.6, 0.8, 1, 1.2 |",
        ),
    ],
)
def test_a_row_tells_a_quantity_s_ranges_and_source(page, row):
    assert row in PAGES[page]


def table_after(page, heading):
    """Rows of the first table below some words."""
    return list(rows(PAGES[page].partition(heading)[2].partition("\n\n")[2].partition("\n\n")[0]))


def values_in(cell):
    """Settings and values that a cell tells, such as `num_envs` 16, `activation: tanh`."""
    for name, value in re.findall(r"`(\w+)` ([\d_.e-]+)", cell):
        yield name, YAML(typ="safe", pure=True).load(value)
    for text in re.findall(r"`(\w+: [^`]+)`", cell):
        yield from YAML(typ="safe", pure=True).load(text).items()


def test_the_tutorials_hyperparameters_are_those_of_its_file(root):
    told = load_config(root / "configs" / "isaac_sb3.yaml").ppo.model_dump()
    told |= told.pop("network")
    cells = [row[1] for row in table_after("from-the-tutorial.md", "translated:") if row]
    found = [pair for cell in cells for pair in values_in(cell)]
    assert len(found) > 15
    assert [(name, told[name]) for name, _ in found] == found


def test_the_differences_to_the_tutorial_are_those_of_the_files(root):
    theirs, ours = (
        load_config(root / "configs" / name).ppo.model_dump()
        for name in ("isaac_sb3.yaml", "jetbot.yaml")
    )
    theirs |= theirs.pop("network")
    ours |= ours.pop("network")
    found = table_after("from-the-tutorial.md", "for these reasons:")[1:]
    assert len(found) > 5
    for name, before, here, _ in found:
        key = name.strip("`")
        if before != "constant":
            parse = YAML(typ="safe", pure=True).load
            values = (parse(before.strip("`")), parse(here.strip("`")))
            assert values == (theirs[key], ours[key])
    schedules = (theirs["learning_rate_schedule"], ours["learning_rate_schedule"])
    assert schedules[0] == "NONE" != schedules[1]


def test_settings_that_may_change_are_listed():
    text = PAGES["stop-and-resume.md"].partition("## What may change")[2].partition("\n## ")[0]
    assert tuple(re.findall(r"`([\w.]+)`", text.partition(". Anything")[0])) == CHANGEABLE_ON_RESUME


def test_every_command_that_may_exit_with_1_is_listed(root):
    text = PAGES["stop-and-resume.md"].partition("## Exit codes")[2].partition("\n## ")[0]
    listed = {cells[1].strip("`") for cells in rows(text) if cells[0] == "1"}
    sources = {path: path.read_text("utf-8") for path in (root / "jetbot_mjx").glob("*.py")}
    ends_with_1 = {
        path.stem.replace("_", "-")
        for path, source in sources.items()
        if re.search(r"^[A-Z]\w+ = 1$", source, re.MULTILINE)
    }
    assert listed == ends_with_1
    for_agents = next(cells for cells in rows(PAGES["agents.md"]) if cells[0] == "1")
    assert listed <= set(re.findall(r"`([\w-]+)`", for_agents[1]))


# Metrics.


def documented_names():
    """Of the list in `metrics.py`: `a/b, c` and `with c, d` and `likewise c` mean `a/c`, `a/d`."""
    names = set()
    for left, right in re.findall(r"^  (\w+/\w+(?:, \w+)*) +(.*)$", metrics.__doc__, re.MULTILINE):
        first, *others = left.split(", ")
        group = first.partition("/")[0]
        others += re.findall(r"(?<=with )\w+_low|success_high", right)
        others += [
            one.rpartition("/")[2]
            for one in re.findall(r"\b[\w/]*_\w+", right.partition("likewise ")[2])
        ]
        names |= {first, *(f"{group}/{other}" for other in others)}
    return names


OURS, THEIRS = PAGES["metrics.md"].split("\n## Stable-Baselines3's names\n")
EXPLAINED = {cells[0].strip("`"): cells[1:] for cells in rows(OURS) if cells[0].startswith("`")}


def test_every_metric_of_the_list_is_explained():
    names = documented_names()
    assert {"eval/success_high", "loss/entropy", "rollout/episode_length"} <= names
    assert names - set(EXPLAINED) == set()
    assert all(unit and len(meaning) > 10 for unit, meaning in EXPLAINED.values())


def test_every_metric_that_is_written_is_explained(smoke_run):
    lines = (smoke_run / "metrics.jsonl").read_text().splitlines()
    written = set().union(*(json.loads(line) for line in lines))
    assert written == set(EXPLAINED)


def test_names_that_other_modules_give_are_explained():
    assert {f"eval/{name}" for name in Summary._fields} < set(EXPLAINED)
    assert set(LOSSES.values()) < set(EXPLAINED)


def test_every_name_of_stable_baselines3_is_explained():
    told = {
        cells[0].strip("`"): re.findall("`([^`]+)`", cells[1])
        for cells in rows(THEIRS)
        if cells[0].startswith("`")
    }
    names = aliases(Config().ppo)
    assert {tag for tag, ours in told.items() if ours != [tag]} == set(names)
    for tag, (figure, _, over) in names.items():
        assert figure in told[tag]
        assert not isinstance(over, str) or over in told[tag]
        assert figure in EXPLAINED


# Commands.


class Parsed(Exception):
    """Raised in place of the work, with what was asked for."""


PLAIN = {"[", "break", "tensorboard", "apt-get", "scp"}
EXPORTED = "policy/policy.py"
"""Where an export lies, in a run folder or on a robot; it takes no arguments."""
VARIABLES = {
    *("JAX_DEFAULT_MATMUL_PRECISION", "JETBOT_MJX_PLAIN_START", "WANDB_MODE"),
    *("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"),
}


SHELL = [
    pytest.param(page, words, id=f"{page}-{' '.join(words)[:60]}")
    for page, text in PAGES.items()
    for block in blocks(text, "sh")
    for words in commands(block)
]


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """Sits in a folder with all of the checkout, and the files that a page tells to write."""

    def sit(page):
        for name in (
            "configs",
            "examples",
            "benchmarks",
            "deploy",
            "tests",
            "Makefile",
            "pyproject.toml",
        ):
            (tmp_path / name).symlink_to(ROOT / name)
        for name, text in own_files(page).items():
            (tmp_path / name).write_text(text, encoding="utf-8")
        monkeypatch.chdir(tmp_path)

    return sit


def test_there_are_commands_on_the_pages():
    assert len(SHELL) > 30


@pytest.mark.parametrize("page", PAGES)
def test_shell_blocks_are_shell(page):
    for block in blocks(PAGES[page], "sh"):
        subprocess.run(["bash", "-n", "-c", block], check=True)


@pytest.mark.parametrize(("page", "words"), SHELL)
def test_a_command_of_the_pages_is_one(page, words, reader, monkeypatch):
    reader(page)
    # There is no run here that could be the latest.
    words = [word.replace("latest", "runs/mine") for word in in_full(words)]
    while re.fullmatch(r"\w+=.*", words[0]):
        assert words[0].partition("=")[0] in VARIABLES
        words = words[1:]
    if words[0] == "srun":
        words = words[words.index("python") :]
    match words:
        case ["python", "-m", "pytest", *arguments]:
            assert all(Path(one).is_file() for one in arguments if one[0] != "-")
        case ["python", "-m", module, *arguments]:
            check_arguments(COMMANDS[module.removeprefix("jetbot_mjx.")], arguments, monkeypatch)
        case ["python", script, *arguments] if script.startswith("examples/"):
            check_arguments(load(Path(script)), arguments, monkeypatch)
        case ["python", "-c", source]:
            compile(source, page, "exec")
        case ["python" | "python3", script, *arguments]:
            check_script(script, arguments, monkeypatch)
        case ["make", *targets]:
            known = re.findall(r"^([\w-]+):", Path("Makefile").read_text(), re.MULTILINE)
            assert set(targets) <= set(known)
        case ["pip", "install", *arguments]:
            check_install(arguments)
        case [first, *_]:
            assert first in PLAIN


def check_script(script, arguments, monkeypatch):
    """It is one of the checkout, or an export's, and takes the arguments."""
    if script.endswith(EXPORTED):
        assert arguments == []
        return
    monkeypatch.syspath_prepend(str((ROOT / script).parent))

    for kind in (argparse.ArgumentParser, cli.Parser):
        monkeypatch.setattr(kind, "parse_args", stop_after(kind.parse_args))
    with pytest.raises(Parsed):
        load(ROOT / script).main(arguments)


def stop_after(parse):
    """The parser's method, which raises what it has parsed."""

    def stop(parser, given=None):
        raise Parsed(parse(parser, given))

    return stop


def check_arguments(command, arguments, monkeypatch):
    """The parser takes the arguments, and the configuration the settings."""
    monkeypatch.setattr(cli.Parser, "parse_args", stop_after(cli.Parser.parse_args))
    with pytest.raises(Parsed) as asked:
        command.main(arguments)
    options = vars(asked.value.args[0])
    if "overrides" in options:
        make_sense = load_config(
            options.get("config") or "configs/jetbot.yaml", options["overrides"]
        )
        assert make_sense.of_each_seed()


def check_install(arguments):
    extras = tomllib.loads(Path("pyproject.toml").read_text())["project"]["optional-dependencies"]
    if arguments[0] == "-c":
        assert (ROOT / arguments[1]).is_file()
        arguments = arguments[2:]
    found = re.match(r"\.(?:\[([\w,]+)\])?$", arguments[0])
    assert found
    assert set((found[1] or "dev").split(",")) <= set(extras)


@pytest.mark.parametrize(
    ("page", "block"),
    [
        ("a.md", "jetbot-mjx train jetbot --sed 1"),
        ("a.md", "jetbot-mjx train jetbot --set ppo.num_env=1"),
        ("a.md", "jetbot-mjx train nothing"),
        ("a.md", "jetbot-mjx dance runs/mine"),
        ("a.md", "python -m jetbot_mjx.train --config configs/jetbot.yaml --sed 1"),
        ("a.md", "python -m jetbot_mjx.train --config configs/nothing.yaml"),
        ("a.md", "python -m jetbot_mjx.dance runs/mine"),
        ("a.md", "python3 deploy/drive.py policy --gaol 1 0"),
        ("a.md", "python deploy/dance.py policy"),
        ("a.md", "make everything"),
        ("a.md", "pip install '.[gpu]'"),
        ("a.md", "rm -rf runs"),
    ],
)
def test_an_invalid_command_is_reported(page, block, reader, monkeypatch):
    monkeypatch.setitem(PAGES, "a.md", f"```sh\n{block}\n```\n")
    ((found,),) = [list(commands(one)) for one in blocks(PAGES[page], "sh")]
    with pytest.raises((AssertionError, ConfigError, FileNotFoundError, KeyError, SystemExit)):
        test_a_command_of_the_pages_is_one(page, found, reader, monkeypatch)


# Examples.


@pytest.mark.parametrize("page", PAGES)
def test_python_blocks_compile(page):
    for block in blocks(PAGES[page], "python"):
        compile(block, page, "exec")


RUNNABLE = [page for page in PAGES if "```python\n# runs\n" in PAGES[page]]


@pytest.mark.slow
@pytest.mark.parametrize("page", RUNNABLE)
def test_blocks_that_are_said_to_run_do(page, reader, monkeypatch, capsys):
    reader(page)
    monkeypatch.syspath_prepend(".")
    namespace = {}
    for block in blocks(PAGES[page], "python"):
        if block.startswith("# runs\n"):
            exec(compile(block, page, "exec"), namespace)
    assert capsys.readouterr().out


URDF = """<robot name="bot">
<link name="base"/>
<joint name="up" type="fixed"><parent link="base"/><child link="box"/>
<origin xyz="0 0 0.03"/></joint>
<link name="box"><inertial><origin xyz="-0.02 0 0.01"/><mass value="1.2"/><inertia ixx="0.004"
iyy="0.004" izz="0.006" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="-0.06 0 -0.02"/><geometry><sphere radius="0.01"/></geometry></collision>
</link>WHEELS</robot>"""
WHEEL = """<link name="{0}"><inertial><mass value="0.05"/><inertia ixx="2e-5" iyy="3e-5" izz="2e-5"
ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><sphere radius="0.03"/></geometry></collision></link>
<joint name="{0}_wheel_joint" type="continuous"><parent link="box"/><child link="{0}"/>
<origin xyz="0 {1} 0"/><axis xyz="0 1 0"/></joint>"""


def test_a_robot_in_urdf_becomes_a_model_as_the_page_says(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    wheels = WHEEL.format("left", 0.08) + WHEEL.format("right", -0.08)
    Path("my_robot.urdf").write_text(URDF.replace("WHEELS", wheels))
    (block,) = (one for one in blocks(PAGES["own-robot.md"], "python") if "my_robot.urdf" in one)
    exec(block, {})
    named = {"left": ["left"], "right": ["right"]}
    env = make_env(parse_config({"robot": {"file": "my_robot.xml", "wheels": named}}))
    # The base has kept its mass.
    assert env.mj_model.body_subtreemass[env.mj_model.jnt_bodyid[0]] == pytest.approx(1.3)
    # What the message about URDF tells is what the page does.
    with pytest.raises(ConfigError, match="this is URDF") as refused:
        parse_config({"robot": {"file": "my_robot.urdf", "wheels": named}})
    told = re.findall(r"spec\.[\w.()]+\w", str(refused.value))
    assert len(told) == 4
    assert [one for one in told if one not in block] == []


def test_the_kernels_page_shows_what_its_first_block_prints(capsys):
    page = PAGES["kernels.md"]
    exec(compile(next(blocks(page, "python")), "kernels.md", "exec"), {})
    (shown,) = blocks(page, "llvm")
    assert capsys.readouterr().out.strip() == shown.strip()


def test_the_picture_of_fuse_shows_what_is_written():
    code = re.findall(
        r'<text class="code".*?>(.*)</text>', (ROOT / "docs/fuse.svg").read_text("utf-8")
    )
    source, shown = "\n".join(code[:2]), " ".join(code[2:])
    namespace = {}
    exec(source, namespace)
    lowered = fuse(namespace["step"]).lowered(jax.ShapeDtypeStruct((2,), np.float32))
    kernel = lowered.one
    jaxpr = [x.primitive.name for x in lowered.traced.jaxpr.eqns]
    assert re.findall(r"\b[b-d] = (\w+)", shown) == jaxpr
    scalars = sorted((x.index, x.op) for x in kernel.program.block.values())
    assert sorted((int(i), op) for i, op in re.findall(r"s(\d) = (\w+)", shown)) == scalars
    written = kernel_text(kernel)
    ptx = " ".join(gpu.assembled(written, 90).split())
    instructions = [x for x in code if x.startswith("%")]
    assert len(instructions) == 2
    assert all(x in written for x in instructions)
    instructions = [x for x in code if x.endswith(";")]
    assert len(instructions) == 3
    assert all(x in ptx for x in instructions)


def test_the_change_of_the_loss_on_the_kernels_page_fits_the_code():
    agents = ROOT / "jetbot_mjx/agents"
    files = agents / "fused/sample_loss.py", agents / "loss.py"
    for change, file in zip(blocks(PAGES["kernels.md"], "diff"), files, strict=True):
        kept = [line[1:] for line in change.splitlines() if not line.startswith("+")]
        assert "\n".join(kept) in file.read_text("utf-8")


def test_the_steps_to_a_task_are_those_of_the_whole_file():
    page = PAGES["own-task.md"]
    whole = own_files("own-task.md")["my_task.py"]
    lines = {line.strip() for line in whole.splitlines()}
    steps = page.partition("## 3.")[2].partition("## 7.")[0]
    shown = [line.strip() for block in blocks(steps, "python") for line in block.splitlines()]
    assert [line for line in shown if line not in lines] == []
    assert len(shown) > 40


def test_the_task_of_the_page_does_what_it_says(reader, monkeypatch):
    reader("own-task.md")
    monkeypatch.syspath_prepend(".")
    env = make_env(load_config("my_task.yaml"))
    goal = env.task.sample(jax.random.PRNGKey(0))
    robot = env.reset(jax.random.PRNGKey(0))
    assert env.observation_size == robot.obs.size == 9
    assert set(robot.metrics) == {"success", "reward/progress", "reward/collision"}
    assert set(env.task.markers(goal)) == {"goal", "pillar"}
    between = jnp.linalg.norm(goal.goal_w[:2] / 2 - goal.pillar_w[:2])
    assert between < 0.1


def test_the_environment_of_the_page_is_what_new_env_writes(tmp_path):
    write_environment_template(tmp_path / "my_env.py")
    shown = own_files("own-environment.md")
    for name in ("my_env.py", "my_env.yaml"):
        assert shown[name] == f"# {name}\n{(tmp_path / name).read_text('utf-8')}"


@pytest.mark.filterwarnings("ignore:Brax System", "ignore:Accessing")
@pytest.mark.parametrize(
    ("name", "package", "sizes"),
    [
        ("brax_pendulum", "brax", (4, 1)),
        ("playground_cartpole", "mujoco_playground", (5, 1)),
        ("gymnax_cartpole", "gymnax", (4, 2)),
    ],
)
def test_environments_of_other_libraries_are_built_as_the_page_says(name, package, sizes):
    pytest.importorskip(package)
    text = own_files("own-environment.md")[f"{name}.yaml"]
    env = make_env(parse_config(YAML(typ="safe", pure=True).load(text)))
    assert (env.observation_size, env.action_size) == sizes


def test_the_standard_tasks_are_on_the_page():
    table = PAGES["own-environment.md"].partition("## The standard tasks")[2]
    names = re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    shipped = {name: load_config(name).environment for name in shipped_configs()}
    own = [name for name, environment in shipped.items() if environment]
    assert {*names} == {name for name in own if not name.endswith("_gpu")}


def test_every_part_of_the_contract_is_on_the_page(root):
    from jetbot_mjx.envs.task import METHODS

    for name in (*METHODS, "layout"):
        assert f"| `{name}" in PAGES["own-task.md"]
