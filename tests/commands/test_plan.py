"""The plan: what fits, as a table, and an exit code."""

import re

import jax
import pytest

from jetbot_mjx import plan
from jetbot_mjx.config import load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.training import memory


@pytest.fixture(scope="module")
def smoke(root):
    return root / "configs" / "smoke.yaml"


def said(capsys, *arguments):
    code = plan.main([str(argument) for argument in arguments])
    return code, capsys.readouterr().out


def test_the_table_tells_what_fits_and_marks_the_configuration(smoke, capsys):
    code, out = said(capsys, "--config", smoke, "--memory", "0.2")
    assert code == 0
    lines = out.splitlines()
    devices = rf"{jax.device_count()} x {re.escape(jax.devices()[0].device_kind)}"
    assert re.match(rf"GiB on each of {devices}, which has 0\.2;", lines[0])
    assert [line.split()[1] for line in lines if line.startswith(">")] == ["128"]
    assert [line.endswith("does not fit") for line in lines[2:-1]][-2:] == [False, True]
    largest = int(lines[-3].split()[0].replace(",", ""))
    assert lines[-1].startswith("the largest of these that fits: ")
    settings = re.findall(r"--set (\S+)", lines[-1])
    assert settings[0] == f"ppo.num_envs={largest}"
    assert load_config(smoke, [*settings, "checkpoint_interval=1e9"]).ppo.num_envs == largest


def test_a_configuration_that_does_not_fit_gives_1(smoke, capsys):
    code, out = said(capsys, "--config", smoke, "--memory", "0.001")
    assert code == plan.TOO_LARGE == 1
    assert "none of them fits" in out


def test_a_device_that_does_not_tell_its_memory_is_asked_about(smoke, monkeypatch):
    monkeypatch.setattr(memory, "device_memory", lambda: None)
    with pytest.raises(UserError, match="give --memory GIB"):
        memory.plan_memory(load_config(smoke))


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "1e308", "much"])
def test_an_invalid_memory_size_is_refused(smoke, capsys, value):
    with pytest.raises(SystemExit) as caught:
        plan.main(["--config", str(smoke), "--memory", value])
    assert caught.value.code == 2
    assert "argument --memory: " in capsys.readouterr().err
