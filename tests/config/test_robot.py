"""The measures of a robot: those of presets, files and overrides, and which are impossible."""

import pytest
from ruamel.yaml import YAML

from jetbot_mjx.config import ConfigError, RobotConfig, load_config, parse_config
from jetbot_mjx.config.robot import SHOWN_DIFFERENCES

MINE = """
preset: real
wheel_radius: 0.04
chassis_mass: 0.9
casters: [{x: -0.1, y: 0, radius: 0.01, clearance: 0.001}]
camera: {position: [0.03, 0, 0.07]}
"""


@pytest.fixture
def mine(tmp_path):
    (tmp_path / "mine.yaml").write_text(MINE)
    config = tmp_path / "config.yaml"
    config.write_text("robot: {file: mine.yaml, chassis_mass: 1.0}")
    return config


@pytest.mark.parametrize("preset", ["isaac", "real"])
def test_the_file_of_a_shipped_robot_has_every_measure(root, preset):
    file = root / "jetbot_mjx" / "assets" / "robots" / f"{preset}.yaml"
    assert set(YAML(typ="safe").load(file)) == set(RobotConfig.model_fields) - {"preset", "file"}


def test_the_default_is_the_tutorials_robot():
    assert RobotConfig() == RobotConfig(preset="isaac") == parse_config({}).robot
    assert repr(RobotConfig()) == "RobotConfig()"
    assert RobotConfig().chassis_mass == 2.0
    assert RobotConfig(preset="real").chassis_mass == 0.634


def test_what_is_given_replaces_a_measure_of_the_preset():
    robot = RobotConfig(preset="real", wheel_radius=0.04)
    assert robot.wheel_radius == 0.04
    assert robot.chassis_mass == RobotConfig(preset="real").chassis_mass


def test_a_file_beside_the_configuration_has_measures_and_a_camera(mine):
    config = load_config(mine, ["robot.wheel_separation=0.2"])
    robot = config.robot
    assert (robot.file, robot.preset) == ("mine.yaml", "real")
    assert (robot.wheel_radius, robot.chassis_mass, robot.wheel_separation) == (0.04, 1.0, 0.2)
    assert [caster.x for caster in robot.casters] == [-0.1]
    assert robot.motor_torque == RobotConfig(preset="real").motor_torque
    assert config.camera.position == (0.03, 0.0, 0.07)


def test_the_configuration_goes_before_the_file(mine):
    mine.write_text("robot: {file: mine.yaml}\ncamera: {position: [0.01, 0, 0.05]}")
    assert load_config(mine).camera.position == (0.01, 0.0, 0.05)


def test_a_stored_configuration_has_every_measure_and_needs_no_file(mine, tmp_path):
    config = load_config(mine)
    stored = tmp_path / "elsewhere" / "config.yaml"
    stored.parent.mkdir()
    stored.write_text(config.to_yaml())
    (tmp_path / "mine.yaml").unlink()
    assert load_config(stored) == config


def test_another_robot_than_the_stored_one_has_its_own_measures(mine, tmp_path):
    stored = load_config(mine)
    changed = ["robot.wheel_radius=0.05", "robot.preset=isaac"]
    assert load_config(stored, changed).robot == RobotConfig(wheel_radius=0.05)
    (tmp_path / "other.yaml").write_text("friction: 0.5")
    other = load_config(stored, {"robot.file": str(tmp_path / "other.yaml")})
    assert other.robot == RobotConfig(file="other.yaml", friction=0.5)
    # A configuration that was written by hand keeps what it says.
    mine.write_text("robot: {preset: real, friction: 0.5}")
    assert load_config(mine, ["robot.preset=isaac"]).robot.friction == 0.5


def test_a_robot_is_called_by_its_file_or_by_what_differs(mine):
    assert load_config(mine).robot.label == "mine"
    assert RobotConfig(preset="real").label == "real"
    assert RobotConfig(wheel_radius=0.04).label == "isaac with wheel_radius = 0.04"
    measures = {"wheel_radius": 0.04, "wheel_mass": 0.1, "friction": 0.5, "armature": 0.0}
    label = RobotConfig(**measures).label
    assert label.count(" = ") == SHOWN_DIFFERENCES
    assert label.endswith(" and 1 more")


def test_moments_that_are_not_given_are_of_homogeneous_bodies():
    robot = RobotConfig(
        wheel_mass=2.0,
        wheel_radius=0.1,
        wheel_width=0.06,
        chassis_mass=3.0,
        chassis_size=(0.3, 0.2, 0.1),
    )
    assert robot.moments_of_wheel == pytest.approx((0.0056, 0.01, 0.0056))
    assert robot.moments_of_chassis == pytest.approx((0.0125, 0.025, 0.0325))


REFUSED = {
    "millimetres": ({"wheel_radius": 32.5}, "robot.wheel_radius = 32.5 is wrong: it should be"),
    "no mass": ({"chassis_mass": 0}, "robot.chassis_mass = 0 is wrong: it should be"),
    "not a number": ({"friction": float("nan")}, "robot.friction = nan is wrong"),
    "a word": ({"motor_torque": "strong"}, "robot.motor_torque = 'strong' is wrong: it should be"),
    "unknown": ({"wheel_radus": 0.03}, "robot.wheel_radus = 0.03 is unknown: did you mean"),
    "two numbers": ({"chassis_com": [0, 0]}, "robot.chassis_com = [0, 0] is wrong: it lacks items"),
    "no caster": ({"casters": []}, "robot.casters = [] is wrong: it should have at least 1 item"),
    "a wheel in the air": (
        {"casters": [{"x": -0.08, "y": 0, "radius": 0.01, "clearance": -0.003}]},
        "robot.casters.0.clearance = -0.003 is wrong: it should be greater than or equal to 0",
    ),
    "a caster without a place": (
        {"casters": [{"radius": 0.01}]},
        "robot.casters.0.x",
    ),
    "moments of no body": (
        {"chassis_inertia": [1e-3, 1e-3, 5e-3]},
        "robot.chassis_inertia: [0.001, 0.001, 0.005] is of no body",
    ),
    "too far ahead": (
        {"preset": "real", "chassis_com": [0.02, 0, 0]},
        "ahead of the axle, and it tips over: add a front caster there",
    ),
    "too far back": ({"chassis_com": [-0.2, 0, 0]}, "behind the axle, and it tips over"),
    "beside its wheels": ({"chassis_com": [-0.02, 0.1, 0]}, "is outside of its wheels"),
}


@pytest.mark.parametrize(("robot", "said"), REFUSED.values(), ids=list(REFUSED))
def test_impossible_measures_are_refused_in_one_line(robot, said):
    with pytest.raises(ConfigError) as error:
        parse_config({"robot": robot})
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wheel_radius: 33", "mine.yaml: robot.wheel_radius = 33 is wrong"),
        ("wheel_radus: 0.03", "mine.yaml: robot.wheel_radus = 0.03 is unknown"),
        ("file: other.yaml", "mine.yaml: file = 'other.yaml': it is one itself"),
        ("robot: {preset: real}", "mine.yaml: it has a section robot, as a configuration has"),
        ("camera: 3", "camera = 3 is not a section"),
        ("- 1", "holds [1]: write `key: value` lines"),
        (None, "mine.yaml does not exist"),
    ],
)
def test_a_file_that_is_none_of_a_robot_is_refused_in_one_line(mine, text, said):
    file = mine.with_name("mine.yaml")
    file.write_text(text) if text else file.unlink()
    with pytest.raises(ConfigError) as error:
        load_config(mine)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("file", ["robot.mjb", "robot.usd", "robot", "robot.sdf"])
def test_other_files_than_measures_and_models_are_refused(tmp_path, file):
    (tmp_path / file).write_bytes(b"\xff\0")
    with pytest.raises(ConfigError, match=r"NAME.yaml, or a MuJoCo model, NAME.xml"):
        parse_config({"robot": {"file": str(tmp_path / file)}})
