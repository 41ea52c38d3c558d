"""The tables of a search: values as YAML writes them."""

from jetbot_mjx.tuning.results import entrants_table
from jetbot_mjx.tuning.search import Entrant


def test_values_in_the_table_can_be_copied_into_a_configuration():
    values = {
        "ppo.desired_kl": None,
        "ppo.normalize_observations": True,
        "ppo.network.value_hidden_layer_sizes": (64, 64),
        "ppo.learning_rate": 0.00123456,
        "ppo.activation": "tanh",
    }
    row = entrants_table([Entrant("as given", values, (0.5,), (0.5,), (1.0,))]).splitlines()[-1]
    assert row.endswith(
        " | desired_kl null, normalize_observations true, value_hidden_layer_sizes [64, 64],"
        " learning_rate 0.001235, activation tanh |"
    )
