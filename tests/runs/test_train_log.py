"""The log of a training's messages."""

import os

from jetbot_mjx.runs.train_log import TRAIN_LOG, log_message


def test_messages_are_appended_with_the_time(tmp_path):
    log_message(tmp_path, "one\ntwo")
    log_message(tmp_path, "three")
    lines = (tmp_path / TRAIN_LOG).read_text("utf-8").splitlines()
    assert [line[21:] for line in lines] == ["one", "two", "three"]


def test_a_named_pipe_in_its_place_does_not_block(tmp_path):
    os.mkfifo(tmp_path / TRAIN_LOG)
    log_message(tmp_path, "nobody reads this")
