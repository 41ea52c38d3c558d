"""`share` refuses before it works, and tells where the run is."""

import pytest

from helpers import fake_hub
from jetbot_mjx import deployment, share
from jetbot_mjx.deployment.sharing import SharedRun


@pytest.fixture
def hub(monkeypatch):
    pytest.importorskip("huggingface_hub")
    monkeypatch.setenv("HF_TOKEN", "hf_ada")
    with fake_hub.serving() as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        yield server


def test_it_shares_what_it_is_told_to(hub, trained, monkeypatch, capsys):
    given = []

    def share_run(run, name, **more):
        given.append((run, name, more))
        return SharedRun(
            name,
            "http://hub/ada/x",
            "abc",
            3,
            5_000_000,
            f"jetbot-mjx play {name}",
            {"a clip": "no OpenGL"},
        )

    monkeypatch.setattr(deployment, "share_run", share_run)
    words = [str(trained), "--to", "hf:ada/x", "--checkpoint", "2048", "--license", "mit"]
    assert share.main([*words, "--private"]) == 0
    assert given == [
        (trained, "hf:ada/x", {"which": 2048, "licence": "mit", "private": True}),
    ]
    assert capsys.readouterr().out == (
        "http://hub/ada/x: 3 files, 5.0 MB, revision abc\n  without a clip: no OpenGL\n"
        "anyone can use it: jetbot-mjx play hf:ada/x\n"
    )


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((), "the following arguments are required: --to"),
        (
            ("--to", "ada/x"),
            "argument --to: 'ada/x' is no repository: write it as in hf:ada/jetbot",
        ),
        (("--to", "hf:eve/x"), "error: hf:eve/x: your token writes for ada, not for eve"),
        (("--to", "hf:ada/x", "--license", "MIT!"), "argument --license: 'MIT!' is no licence"),
    ],
)
def test_a_mistake_is_one_line_before_any_work(words, line, hub, trained, refused):
    assert line in refused(share, trained, *words)
    assert not hub.repositories


def test_a_run_without_a_checkpoint_is_one_line(hub, here, refused):
    (here / "run").mkdir()
    (here / "run" / "config.yaml").write_text("seed: 1\n")
    assert "no checkpoint at" in refused(share, "run", "--to", "hf:ada/x")
    assert not hub.repositories
