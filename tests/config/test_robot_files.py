"""The files of a robot's model: which they are, their hash, and what is refused."""

import os

import pytest

from jetbot_mjx.config import ConfigError, robot_files
from jetbot_mjx.config.robot_files import model_files, register

MODEL = """
<mujoco><compiler meshdir="m" texturedir="t"/><include file="parts.xml"/>
<asset><mesh name="a" file="a.stl"/><texture name="b" type="2d" file="b.png"/></asset></mujoco>
"""
PARTS = '<mujocoinclude><asset><mesh name="c" file="c.stl"/></asset></mujocoinclude>'


@pytest.fixture
def model(tmp_path):
    for name in ("m/a.stl", "m/c.stl", "t/b.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(name.encode())
    (tmp_path / "parts.xml").write_text(PARTS)
    (tmp_path / "model.xml").write_text(MODEL)
    return tmp_path / "model.xml"


def test_all_files_that_a_model_names_belong_to_it(model):
    files = model_files(register(model))
    assert set(files) == {"model.xml", "parts.xml", "m/a.stl", "m/c.stl", "t/b.png"}
    assert files["m/a.stl"] == b"m/a.stl"


def test_the_hash_is_of_all_of_them(model):
    first = register(model)
    assert register(model) == first
    (model.parent / "m" / "a.stl").write_bytes(b"another")
    assert register(model) != first
    # What a configuration was loaded with stays what it was.
    assert model_files(first)["m/a.stl"] == b"m/a.stl"
    assert model_files("0" * 64) is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('<mujoco><include file="../other.xml"/></mujoco>', "outside of the model's folder"),
        ('<mujoco><include file="none.xml"/></mujoco>', "none.xml does not exist"),
        ("<sdf/>", "<sdf> is not a MuJoCo model: its root should be <mujoco>"),
        ('<robot name="r"/>', "this is URDF, which has no motors: make MJCF of it in Python"),
        ("<mujoco>", "this is not XML: no element found"),
        (" \n", "it is empty"),
        ('<mujoco><geom pos="0 -NaN 0"/></mujoco>', "<geom pos='0 -NaN 0'> holds NaN: give a"),
        (b"\xff\xfe<\0", "this is not UTF-8 text, as MJCF is"),
        (
            '<mujoco><flexcomp file="/etc/hosts"/></mujoco>',
            "<flexcomp file='/etc/hosts'> names a file",
        ),
        (f"<mujoco>{'<a>' * 10**5}{'</a>' * 10**5}</mujoco>", "it is nested too deeply"),
        ('<mujoco><replicate count="all"/></mujoco>', "a count is no whole number"),
        (f"<mujoco>{'<geom/>' * 10**4}</mujoco>", "it stands for 10,001 elements"),
        (
            '<mujoco><replicate count="99999"><replicate count="99999"/></replicate></mujoco>',
            "it stands for 9,999,900,001 elements",
        ),
        ('<mujoco><composite count="99 99 99"/></mujoco>', "it stands for 970,300 elements"),
        (f"<mujoco>{'<attach/>' * 17}</mujoco>", "attaches 17 models: at most 10,000 and 16"),
        (
            '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/hosts">]><mujoco>&b;</mujoco>',
            "this is not XML: undefined entity &b;",
        ),
        (
            f"<!DOCTYPE a [<!ENTITY a0 '{'a' * 99}'>"
            + "".join(f"<!ENTITY a{i + 1} '{f'&a{i};' * 99}'>" for i in range(6))
            + "]><mujoco>&a6;</mujoco>",
            "this is not XML: limit on input amplification factor",
        ),
    ],
)
def test_what_is_no_model_is_refused_in_one_line(model, text, said):
    (model.parent.parent / "other.xml").write_text("<mujoco/>")
    model.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError) as error:
        register(model)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("part", ['<include file="{}"/>', '<asset><model file="{}"/></asset>'])
@pytest.mark.parametrize("name", ["model.xml", "parts.xml"])
def test_a_model_that_is_a_part_of_itself_is_refused(model, part, name):
    model.write_text(f"<mujoco>{part.format(name)}</mujoco>")
    (model.parent / "parts.xml").write_text(f"<mujoco>{part.format('model.xml')}</mujoco>")
    with pytest.raises(ConfigError, match=r"model.xml: it is a part of itself"):
        register(model)


def test_a_model_may_have_a_part_twice(model):
    (model.parent / "parts.xml").write_text("<mujoco/>")
    model.write_text('<mujoco><model file="parts.xml"/><model file="parts.xml"/></mujoco>')
    assert set(model_files(register(model))) == {"model.xml", "parts.xml"}


def test_a_part_may_be_called_nan(model):
    model.write_text('<mujoco><joint name="nan"/><velocity joint="nan"/></mujoco>')
    assert register(model)


def test_large_models_are_refused(model, monkeypatch):
    monkeypatch.setattr(robot_files, "MAX_BYTES", 100)
    with pytest.raises(ConfigError, match="more than 100: leave out what only shows"):
        register(model)


def test_folders_count_in_all_files_and_may_be_stripped_and_a_cube_has_six_sides(model):
    cube = '<texture type="cube" file="x/b.png" fileup="b.png" filedown="b.png"/>'
    mesh = '<mesh file="x/a.stl"/><model name="n" file="other.xml"/>'
    (model.parent / "parts.xml").write_text(
        '<mujocoinclude><compiler meshdir="m" texturedir="t" strippath="true"/></mujocoinclude>'
    )
    (model.parent / "other.xml").write_text("<mujoco/>")
    model.write_text(f'<mujoco><include file="parts.xml"/><asset>{cube}{mesh}</asset></mujoco>')
    names = {"model.xml", "parts.xml", "other.xml", "m/a.stl", "t/b.png"}
    assert set(model_files(register(model))) == names
    (model.parent / "t" / "side.png").write_bytes(b"")
    model.write_text(model.read_text().replace('fileup="b', 'fileup="side'))
    assert set(model_files(register(model))) == names | {"t/side.png"}


def test_what_is_no_file_is_not_waited_for(model):
    with pytest.raises(ConfigError, match="is a folder"):
        register(model.parent)
    model.unlink()
    os.mkfifo(model)
    with pytest.raises(ConfigError, match="is no regular file"):
        register(model)
