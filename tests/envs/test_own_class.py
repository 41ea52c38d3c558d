"""The class that a configuration names is imported, and what is wrong with its name is told."""

import sys

import pytest

from jetbot_mjx.envs.own_class import import_class
from jetbot_mjx.errors import UserError


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The current folder, with two modules; none is imported when the test ends."""
    (tmp_path / "of_mine.py").write_text("class Outer:\n    class Inner:\n        pass\n")
    (tmp_path / "of_theirs.py").write_text("import not_installed_anywhere\n")
    (tmp_path / "half_mine.py").write_text("class Half(:\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    for name in ("of_mine", "of_theirs", "half_mine"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("name", ["Outer", "Outer.Inner"])
def test_a_class_is_found_in_the_current_folder(home, name):
    assert import_class("environment", f"of_mine:{name}").__qualname__ == name


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("of_mine.Outer", "is wrong: write package.module:Class, perhaps of_mine:Outer"),
        (":Outer", "is wrong: write package.module:Class"),
        (".of_mine:Outer", "is wrong: write package.module:Class"),
        ("of_mine:", "is wrong: write package.module:Class"),
        ("of_mine.py:Outer", "names a file: write the module, of_mine:Outer"),
        ("of_mime:Outer", "there is no of_mime.py beside the YAML file or in the current folder"),
        ("of_mime:Outer", "and no such package: did you mean of_mine:Outer?"),
        ("of_theirs:Their", "of_theirs imports 'not_installed_anywhere', which is not installed"),
        ("half_mine:Half", "half_mine.py, line 1, is not valid Python: invalid syntax"),
        ("of_mine:Outre", "of_mine has no 'Outre': did you mean 'Outer'?"),
        ("of_mine:Outer.Iner", "Outer has no 'Iner': did you mean 'Inner'?"),
    ],
)
def test_a_wrong_name_is_told(home, name, told):
    with pytest.raises(UserError) as caught:
        import_class("task.name", name)
    assert str(caught.value).startswith(f"task.name = {name!r}")
    assert told in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
