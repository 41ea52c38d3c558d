"""The import of a class of one's own, and what is said where it fails."""

import sys

import pytest

from jetbot_mjx.config import task_modules
from jetbot_mjx.envs import own_class
from jetbot_mjx.envs.own_class import import_class
from jetbot_mjx.errors import InvalidError, MissingPackageError

FILES = {
    "own_sound.py": "class Env:\n    class Inner:\n        pass\n",
    "own_needy.py": "import own_absent_package\n",
    "own_half.py": "class Env(:\n",
    "own_edited.py": "from own_words import WORD\n\n\nclass Env:\n    word, number = WORD, 1\n",
    "own_words.py": "WORD = 'first'\n",
    "own_package/__init__.py": "",
    "own_package/inside.py": "class Env:\n    pass\n",
}


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """The current folder, with some modules; what they leave in the process is undone."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    monkeypatch.setattr(task_modules, "TASK_FOLDERS", {})
    monkeypatch.setattr(own_class, "_imported", {})
    yield
    for name in [name for name in sys.modules if name.startswith("own_")]:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("own_sound:Env", "Env"),
        ("own_sound:Env.Inner", "Env.Inner"),
        ("own_package.inside:Env", "Env"),
        ("collections:OrderedDict", "OrderedDict"),
    ],
)
def test_a_class_is_found(name, found):
    assert import_class("environment", name).__qualname__ == found


@pytest.mark.parametrize(
    ("file", "text", "found"),
    [
        ("own_edited.py", "class Env:\n    word, number = 'none', 2\n", ("none", 2)),
        ("own_words.py", "WORD = 'another'\n", ("another", 1)),
    ],
)
def test_a_file_that_was_edited_is_imported_again(file, text, found, tmp_path):
    first = import_class("environment", "own_edited:Env")
    assert import_class("environment", "own_edited:Env") is first
    (tmp_path / file).write_text(text, encoding="utf-8")
    edited = import_class("environment", "own_edited:Env")
    assert (edited.word, edited.number) == found
    assert (first.word, first.number) == ("first", 1)


def test_what_was_edited_into_a_mistake_is_told_and_mended_again(tmp_path):
    import_class("environment", "own_sound:Env")
    (tmp_path / "own_sound.py").write_text("class Env(:\n", encoding="utf-8")
    with pytest.raises(InvalidError, match=r"own_sound\.py, line 1, is not valid Python"):
        import_class("environment", "own_sound:Env")
    (tmp_path / "own_sound.py").write_text("class Env:\n    mended = 1\n", encoding="utf-8")
    assert import_class("environment", "own_sound:Env").mended == 1


@pytest.mark.parametrize(
    ("name", "error", "told"),
    [
        ("own_sound:env", InvalidError, "own_sound has no 'env': did you mean 'Env'[?]$"),
        ("own_sound:Env.Other", InvalidError, "Env has no 'Other'$"),
        ("own_half:Env", InvalidError, r"own_half.py, line 1, is not valid Python: "),
        (
            "own_soud:Env",
            MissingPackageError,
            "there is no own_soud.py beside the YAML file or in the current folder, and no such"
            " package: did you mean own_sound:Env[?]$",
        ),
        ("own_package.nothing:Env", MissingPackageError, "there is no own_package/nothing.py"),
        (
            "own_needy:Env",
            MissingPackageError,
            "own_needy imports 'own_absent_package', which is not installed: install it$",
        ),
    ],
)
def test_what_cannot_be_imported_is_one_line(name, error, told):
    with pytest.raises(error, match=f"^environment = '{name}'.*{told}") as caught:
        import_class("environment", name)
    assert "\n" not in str(caught.value)
