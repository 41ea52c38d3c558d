"""Runs on the Hugging Face Hub, against a server of this machine that speaks what its library does.

What a stranger's repository could do is attacked here; what the code of a stranger's run could do
in `test_trust.py`.
"""

import sys
import threading
from pathlib import Path

import pytest

from helpers import fake_hub
from jetbot_mjx.errors import InvalidError, MissingPackageError, NotFoundError, UserError
from jetbot_mjx.runs import hub, run_finder
from jetbot_mjx.runs.hub import check_upload, parse_hub_name, upload_run
from jetbot_mjx.runs.run_finder import find_run

pytest.importorskip("huggingface_hub")
# Of the library, about itself.
pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")

FILES = {
    "config.yaml": b"seed: 1\n",
    "metrics.jsonl": b"",
    "checkpoints/000000000001/policy/d/ab12": b"x" * fake_hub.LARGE,
    "task/mine.py": b"raise AssertionError\n",
    "README.md": b"# A run\n",
    "page.html": b"<p>",
}
OF_A_RUN = {path: FILES[path] for path in FILES if path not in ("README.md", "page.html")}


@pytest.fixture
def server(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HF_TOKEN", raising=False)
    with fake_hub.serving() as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        yield server


@pytest.fixture
def ada(server, monkeypatch):
    """The server, for one who is logged in as ada."""
    monkeypatch.setenv("HF_TOKEN", "hf_ada")
    return server


def content(folder):
    """All below a folder, its hidden files too: the content of files, None for all else."""
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    return {
        name: path.read_bytes() if path.is_file() and not path.is_symlink() else None
        for name, path in found.items()
        if not path.is_dir() or path.is_symlink()
    }


# Names.


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("hf:ada/jetbot", ("ada/jetbot", None)),
        ("hf:Ada-1/jet.bot_2@v1.0", ("Ada-1/jet.bot_2", "v1.0")),
        ("hf:a/b@refs/pr/1", ("a/b", "refs/pr/1")),
    ],
)
def test_a_name_is_taken_apart(text, parts):
    assert parse_hub_name(text) == parts


@pytest.mark.parametrize(
    "text",
    [
        *("hf:", "hf:ada", "hf:/ada/x", "hf:ada/", "hf:ada/x/y", "hf:ada/x@", "hf:ada/x@../y"),
        *("hf:../x", "hf:ada/..", "hf:ada/.x", "hf:a--b/x", "hf:ada/x..y", "hf:ada/x.git"),
        *("hf:ada/x y", "hf:ada/ä", "hf:ada/x?a=b", "hf:ada/x#y", "hf:ada/x@-y", "hf:ada\\x/y"),
        *("hf:ada/x\n", "hf:ada/x@y\x1b[2J", "hf:" + "a" * 200 + "/x", "ada/x", "HF:ada/x"),
    ],
)
def test_a_wrong_name_is_refused_without_a_request(text, server):
    with pytest.raises(InvalidError, match="write hf:USER/NAME or hf:USER/NAME@REVISION") as caught:
        parse_hub_name(text)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 400
    assert not server.requests


# Download.


def test_a_run_is_downloaded_once_and_found_by_its_name(server):
    revision = server.commit("eve/run", FILES)
    told = []
    found = find_run("hf:eve/run", say=told.append)
    assert found == Path("runs/hub") / f"eve--run-{revision[:12]}"
    assert told == [f"hf:eve/run: revision {revision}, in {found}"]
    assert content(found) == OF_A_RUN
    assert [path.name for path in found.parent.iterdir()] == [found.name]
    server.requests.clear()
    assert find_run("hf:eve/run") == found
    assert not [one for one in server.requests if "resolve" in one]


def test_a_revision_is_what_it_is_called_and_stays_without_a_network(server):
    old = server.commit("eve/run", FILES)
    new = server.commit("eve/run", FILES | {"config.yaml": b"seed: 2\n"})
    assert (find_run(f"hf:eve/run@{old}") / "config.yaml").read_bytes() == b"seed: 1\n"
    assert (find_run("hf:eve/run@main") / "config.yaml").read_bytes() == b"seed: 2\n"
    server.failing["/"] = None
    assert find_run(f"hf:eve/run@{new}").name == f"eve--run-{new[:12]}"


def test_only_the_prefix_asks_the_hub(server):
    Path("eve").mkdir()
    assert find_run("eve/run") == Path("eve/run")
    assert find_run("./hf:eve/run") == Path("./hf:eve/run")
    assert not server.requests
    # And it does so whatever lies here.
    Path("hf:eve/run").mkdir(parents=True)
    with pytest.raises(NotFoundError, match="no such repository"):
        find_run("hf:eve/run")


def test_a_private_run_is_read_with_a_token_only(server, monkeypatch):
    server.commit("ada/run", FILES)
    server.private.add("ada/run")
    with pytest.raises(NotFoundError, match=r"no such repository at .* you to read: .*HF_TOKEN"):
        find_run("hf:ada/run")
    monkeypatch.setenv("HF_TOKEN", "hf_eve")
    with pytest.raises(NotFoundError, match="no such repository"):
        find_run("hf:ada/run")
    monkeypatch.setenv("HF_TOKEN", "hf_ada")
    assert find_run("hf:ada/run").is_dir()


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [
        ("hf:eve/nothing", NotFoundError, "there is no such repository at http://127.0.0.1:"),
        ("hf:eve/run@v9", NotFoundError, "^hf:eve/run@v9: there is no such revision$"),
        ("hf:eve/other", NotFoundError, r"^hf:eve/other: it holds no run of jetbot_mjx \(no conf"),
    ],
)
def test_what_is_not_there_is_one_line(name, kind, message, server):
    server.commit("eve/run", FILES)
    server.commit("eve/other", {"model.safetensors": b"x", "sub/config.yaml": b"x"})
    with pytest.raises(kind, match=message):
        find_run(name)
    assert not Path("runs").exists()


def test_a_token_that_is_none_is_one_line(server, monkeypatch):
    server.commit("eve/run", FILES)
    monkeypatch.setenv("HF_TOKEN", "hf_bad")
    with pytest.raises(UserError, match=r"refuses your token \(401\): set HF_TOKEN"):
        find_run("hf:eve/run")


def test_without_a_network_is_one_line(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(UserError, match=r"^hf:eve/run: http://127.0.0.1:9 cannot be reached: "):
        find_run("hf:eve/run")


def test_where_requests_are_forbidden_is_one_line(monkeypatch, tmp_path):
    from huggingface_hub import constants

    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HF_ENDPOINT", raising=False)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(UserError, match=r"^hf:eve/run: Cannot reach .*: offline mode is enabled"):
        find_run("hf:eve/run")


def test_without_the_library_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    match = (
        r"hf:eve/run needs huggingface_hub, which is not installed: pip install 'jetbot_mjx\[hub"
    )
    with pytest.raises(MissingPackageError, match=match):
        find_run("hf:eve/run")


@pytest.mark.parametrize("status", [None, 403, 404])
def test_a_download_that_breaks_leaves_nothing(status, server):
    server.commit("eve/run", FILES)
    server.failing["resolve/"] = status
    with pytest.raises(UserError) as caught:
        find_run("hf:eve/run")
    assert str(caught.value).startswith("hf:eve/run")
    assert list(Path("runs/hub").iterdir()) == []
    del server.failing["resolve/"]
    assert content(find_run("hf:eve/run")) == OF_A_RUN


def test_a_folder_that_cannot_be_written_is_one_line(server):
    server.commit("eve/run", FILES)
    Path("runs").write_text("a file")
    with pytest.raises(UserError, match=r"runs/hub/eve--run-.* cannot be written: Not a direct"):
        find_run("hf:eve/run")


def test_two_at_once_get_one_complete_run(server):
    revision = server.commit("eve/run", FILES | {f"robot/{x}.stl": b"x" for x in range(20)})
    found = []
    threads = [
        threading.Thread(target=lambda: found.append(find_run("hf:eve/run"))) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [Path("runs/hub") / f"eve--run-{revision[:12]}"] * 4
    assert len(content(found[0])) == len(OF_A_RUN) + 20
    assert [path.name for path in Path("runs/hub").iterdir()] == [found[0].name]


# A stranger's repository.


@pytest.mark.parametrize(
    "path",
    [
        *("task/../../evil.py", "task/../evil.py", "checkpoints/..", "robot/./x", "task//etc/x"),
        *("task/..\\..\\evil.py", "task/C:\\evil", "task/c:evil", "robot/x\x1b[2J", "robot/x\ny"),
        *("task/...", "task/ ", "robot/a|b", "task/"),
    ],
)
def test_a_path_that_could_leave_the_folder_downloads_nothing(path, server):
    server.commit("eve/run", FILES | {path: b"evil"})
    with pytest.raises(UserError, match="nothing was downloaded: it holds the path") as caught:
        find_run("hf:eve/run")
    assert str(caught.value).isprintable()
    assert content(Path.cwd()) == {}


@pytest.mark.parametrize(
    "path",
    [
        *("/etc/passwd", "../evil.py", "evil.py", ".git/hooks/pre-commit", "videos/../../x"),
        *(
            "policy/policy.py",
            "evaluations/1/report.html",
            ".lock",
            "set_aside/x",
            "nan_dumps/0.npz",
        ),
        *("config.yaml/x", "CONFIG.YAML", "wandb.json"),
    ],
)
def test_what_is_not_of_a_run_is_not_downloaded(path, server):
    server.commit("eve/run", FILES | {path: b"evil"})
    assert content(find_run("hf:eve/run")) == OF_A_RUN


def test_a_link_in_a_repository_is_a_file_here(server):
    # The Hub serves the target of a link as the content of a file.
    server.commit("eve/run", FILES | {"checkpoints/1": b"../../../secret"})
    Path("secret").write_text("mine")
    assert content(find_run("hf:eve/run"))["checkpoints/1"] == b"../../../secret"


def test_more_than_a_run_has_is_not_downloaded(server, monkeypatch):
    server.commit("eve/run", FILES)
    monkeypatch.setattr(hub, "_MOST_BYTES", 5_000)
    with pytest.raises(UserError, match=r"nothing was downloaded: 4 files of 0\.0 GB are more"):
        find_run("hf:eve/run")
    monkeypatch.setattr(hub, "_MOST_FILES", 3)
    with pytest.raises(UserError, match="are more than a run has"):
        find_run("hf:eve/run")


def test_a_commit_that_is_none_names_no_folder(server, monkeypatch):
    server.commit("eve/run", FILES)
    server.repositories["eve/run"][-1] = server.find("eve/run", "main")._replace(sha="../../evil")
    with pytest.raises(UserError, match=r"the server names no commit, but '\.\./\.\./evil'"):
        find_run("hf:eve/run")


def test_a_downloaded_run_is_not_the_latest(server):
    server.commit("eve/run", FILES)
    find_run("hf:eve/run")
    assert run_finder.scan_runs() == ([], [])


# Upload.


def upload(**more):
    return upload_run("hf:ada/run", {**FILES, **more}, "after 1 step")


def test_an_upload_is_one_commit_that_another_user_downloads(ada, monkeypatch, tmp_path):
    (tmp_path / "file").write_bytes(b"y" * fake_hub.LARGE)
    uploaded = upload(**{"policy/recording.npz": tmp_path / "file"})
    created, commit = ada.repositories["ada/run"]
    assert uploaded == (f"{ada.url}/ada/run", commit.sha)
    assert commit.message == "after 1 step"
    file = {"policy/recording.npz": b"y" * fake_hub.LARGE}
    assert commit.files == created.files | FILES | file
    assert not ada.private
    # Both ways of the library were taken.
    assert [one for one in ada.requests if one.startswith("PUT /lfs/")]
    monkeypatch.setenv("HF_TOKEN", "hf_eve")
    assert content(find_run("hf:ada/run")) == OF_A_RUN


def test_a_new_repository_is_private_if_asked(ada):
    upload_run("hf:ada/run", FILES, "x", private=True)
    assert ada.private == {"ada/run"}


def test_an_upload_replaces_the_one_before_and_nothing_else(ada):
    upload(**{"checkpoints/000000000002/x": b"2", "evaluations/1/report.md": b"old"})
    before = ada.repositories["ada/run"][-1].files
    ada.commit("ada/run", before | {"thesis.tex": b"mine", "checkpoints.md": b"mine"})
    upload()
    after = ada.repositories["ada/run"][-1].files
    kept = {
        "thesis.tex": b"mine",
        "checkpoints.md": b"mine",
        ".gitattributes": b"*.bin filter=lfs\n",
    }
    assert after == FILES | kept


def test_a_repository_with_something_else_is_left_alone(ada):
    ada.commit("ada/run", {"README.md": b"# LLM", "model.safetensors": b"x"})
    for call in (upload, lambda: check_upload("hf:ada/run")):
        with pytest.raises(UserError, match=r"^hf:ada/run holds something else than a run: ch"):
            call()
    assert len(ada.repositories["ada/run"]) == 1


@pytest.mark.parametrize(
    ("part", "status"),
    [
        *[("PUT /lfs", 403), ("info/lfs", 404), ("models/ada/run/preupload", 403)],
        # A network that breaks; requests before are repeated for half a minute.
        *[("models/ada/run/commit", 403), ("models/ada/run/commit", None)],
    ],
)
def test_an_upload_that_breaks_changes_nothing(part, status, ada):
    upload()
    commits = list(ada.repositories["ada/run"])
    ada.failing[part] = status
    with pytest.raises(UserError) as caught:
        upload(**{"robot/new.stl": b"z" * fake_hub.LARGE})
    assert str(caught.value).startswith("hf:ada/run: ")
    assert ada.repositories["ada/run"] == commits


def test_two_uploads_at_once_do_not_mix(ada):
    upload()

    def other():
        ada.before_commit = None
        ada.commit("ada/run", FILES | {"config.yaml": b"seed: 2\n"})

    ada.before_commit = other
    with pytest.raises(UserError, match=r"somebody changed it meanwhile \(412\): share again"):
        upload()
    assert ada.repositories["ada/run"][-1].files["config.yaml"] == b"seed: 2\n"


@pytest.mark.parametrize(
    ("token", "name", "message"),
    [
        (None, "hf:ada/run", r"^hf:ada/run: you are not logged in at http://.*: set HF_TOKEN"),
        (
            "hf_bad",
            "hf:ada/run",
            r"^hf:ada/run: http://.* refuses your token \(401\): set HF_TOKEN",
        ),
        ("hf_ada", "hf:eve/run", "^hf:eve/run: your token writes for ada, not for eve$"),
        ("hf_ada", "hf:ada/run@v1", "^hf:ada/run@v1: a run is shared without @"),
        ("hf_ada", "ada/run", "^ada/run: write hf:USER/NAME"),
    ],
)
def test_an_upload_that_could_not_be_is_refused_before_the_work(
    token, name, message, server, monkeypatch
):
    if token:
        monkeypatch.setenv("HF_TOKEN", token)
    with pytest.raises(UserError, match=message):
        check_upload(name)
    assert not server.repositories


def test_the_library_shows_its_bars_again_afterwards(server):
    from huggingface_hub import utils

    server.commit("eve/run", FILES)
    before = utils.are_progress_bars_disabled()
    find_run("hf:eve/run")
    assert utils.are_progress_bars_disabled() == before
