"""What all sections of a configuration have in common."""

import pytest
from pydantic import ValidationError

from jetbot_mjx.config import Config
from jetbot_mjx.config.section import Section


class Wheels(Section):
    radius: float = 0.03
    spokes: int = 5


def test_a_section_shows_what_differs_from_the_defaults():
    assert repr(Wheels()) == "Wheels()"
    assert repr(Wheels(spokes=6)) == "Wheels(spokes=6)"


def test_a_section_cannot_be_changed_and_has_no_other_settings():
    with pytest.raises(ValidationError, match="frozen"):
        Wheels().spokes = 7
    with pytest.raises(ValidationError, match="spoke"):
        Wheels(spoke=7)
    with pytest.raises(ValidationError, match="spokes"):
        Wheels(spokes="7")


def test_every_section_of_the_configuration_is_one():
    fields = {name: getattr(Config(), name) for name in Config.model_fields}
    sections = {name for name, value in fields.items() if isinstance(value, Section)}
    assert {"robot", "task", "physics", "ppo", "evaluation", "randomization"} <= sections
