"""The pages of the documentation, with the commands and files on them."""

import importlib.util
import re
import shlex
from pathlib import Path

from helpers.command_modules import evaluate, render, train, tune
from jetbot_mjx import (
    check_env,
    check_robot,
    export,
    list_configs,
    list_runs,
    new_env,
    new_robot,
    new_task,
    plan,
    play,
    pretrained,
    replay,
    share,
    sim2real,
)

ROOT = Path(__file__).parents[2]

DOCS = ROOT / "docs"

GENERATED = "configuration.md"


def load(path):
    """A module by its path, such as the one that writes the reference."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


reference = load(DOCS / "reference.py")

DEMO = {f"demo/{name}.html" for name in load(DOCS / "demo.py").PAGES}
"""Pages of policies, which the build writes."""

PAGES = {
    str(path.relative_to(DOCS)): reference.with_tables(path.read_text("utf-8"))
    for path in DOCS.rglob("*.md")
}

REFERENCE = reference.room_pages()
"""The pages of the rooms, which the build writes."""

ALL_PAGES = {**PAGES, **reference.generated(), **REFERENCE}


def blocks(text, language):
    """Fenced blocks, those inside lists too, as they would be written at the margin."""
    for indent, body in re.findall(
        rf"^( *)```{language}\n(.*?)^ *```$", text, flags=re.DOTALL | re.MULTILINE
    ):
        yield "".join(line.removeprefix(indent) for line in body.splitlines(keepends=True))


KEYWORDS = {"until", "do", "done", "while", "if", "then", "fi"}

COMMANDS = {
    "new_task": new_task,
    "new_env": new_env,
    "check_env": check_env,
    "new_robot": new_robot,
    "check_robot": check_robot,
    "plan": plan,
    "train": train,
    "evaluate": evaluate,
    "render": render,
    "replay": replay,
    "play": play,
    "export": export,
    "share": share,
    "sim2real": sim2real,
    "pretrained": pretrained,
    "configs": list_configs,
    "runs": list_runs,
    "tune": tune,
}


def commands(block):
    """The simple commands of a block, as lists of words."""
    for line in block.replace("\\\n", " ").splitlines():
        words = []
        lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
        lexer.wordchars += "$,:[]{}+@"
        for word in [*lexer, ";"]:
            if set(word) <= set(";&|"):
                if words:
                    yield words
                words = []
            elif words or word not in KEYWORDS:
                words.append(word)


def in_full(words):
    """A command with `jetbot-mjx train` written as `python -m jetbot_mjx.train`."""
    if "jetbot-mjx" not in words:
        return words
    at = words.index("jetbot-mjx")
    name, rest = [one.replace("-", "_") for one in words[at + 1 : at + 2]], words[at + 2 :]
    return [*words[:at], "python", "-m", ".".join(["jetbot_mjx", *name]), *rest]


def own_files(page):
    """Files that a page has its reader write: blocks that begin with a file's name."""
    found = {}
    for language in ("python", "yaml"):
        for block in blocks(PAGES[page], language):
            if name := re.match(r"# ([\w-]+\.\w+)\n", block):
                found[name[1]] = block
    return found
