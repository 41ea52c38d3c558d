"""Run folders written by hand, with what a list of runs reads."""

import json

from jetbot_mjx.config import parse_config


def make_run(folder, *lines, **settings):
    """Write a run whose lines are (environment steps, time [s], success rate)."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(parse_config(settings).to_yaml())
    text = "".join(
        json.dumps({"env_steps": steps, "timestamp": when, "eval/success_rate": rate}) + "\n"
        for steps, when, rate in lines
    )
    (folder / "metrics.jsonl").write_text(text)
    return folder
