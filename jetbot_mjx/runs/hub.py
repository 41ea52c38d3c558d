"""Download runs from the Hugging Face Hub, and upload them: `hf:USER/NAME[@REVISION]`.

The library `huggingface_hub`, which the extra `hub` installs, makes all requests; `HF_ENDPOINT`
names another server, and `HF_TOKEN` or `hf auth login` gives the token.

A downloaded run is a stranger's. Only the files that a run consists of are fetched, by paths that
stay inside of its folder, as regular files; none of them is executed, and whether code that the run
names may run is decided as for any other run, in `trust`. The folder appears when it is complete.
"""

import contextlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jetbot_mjx.config import FOLDER as ROBOT
from jetbot_mjx.errors import InvalidError, NotFoundError, UserError, clipped, requires_extra
from jetbot_mjx.runs import task_code
from jetbot_mjx.runs.durable import make_folders, move, sync_tree
from jetbot_mjx.runs.metrics import METRICS
from jetbot_mjx.runs.run_dir import CONFIG, writing_to

if TYPE_CHECKING:
    from huggingface_hub import HfApi

PREFIX = "hf:"
"""What the name of a run on the Hub begins with."""

RUN_FILES = (CONFIG, "versions.json", METRICS)
RUN_FOLDERS = ("checkpoints", task_code.FOLDER, ROBOT)
"""What a run consists of: all that is downloaded. An upload holds more, for people to look at."""

SHOWN = ("README.md", "page.html", "clip.mp4", "clip.gif", "policy", "evaluations")
"""What an upload holds beside the run."""

_PART = r"[A-Za-z0-9](?:[\w.-]{0,94}[A-Za-z0-9])?"
_NAME = re.compile(rf"{PREFIX}({_PART}/{_PART})(?:@(\w[\w./-]{{0,254}}))?", re.ASCII)
_COMMIT = re.compile("[0-9a-f]{40}")
_MOST_FILES, _MOST_BYTES = 10_000, 4 * 1024**3
_AT_ONCE = 8  # downloads


class HubName(NamedTuple):
    """A `HubName` names a repository on the Hub."""

    repository: str
    """`USER/NAME`."""
    revision: str | None
    """A branch, a tag or a commit; None: the newest."""


def parse_hub_name(text: str) -> HubName:
    """Take a name apart.

    Raises:
      InvalidError: it is no name of a repository on the Hub.
    """
    found = _NAME.fullmatch(text)
    if not found or ".." in text or "--" in found[1] or found[1].endswith(".git"):
        raise InvalidError(
            f"{clipped(text)}: write {PREFIX}USER/NAME or {PREFIX}USER/NAME@REVISION, of letters,"
            " digits, '-', '_' and '.'"
        )
    return HubName(found[1], found[2])


def download_run(name: str, folder: Path, say: Callable[[str], None] | None = None) -> Path:
    """Download a run, unless its revision is there already.

    Args:
      name: `hf:USER/NAME`, with `@REVISION` after it for another one than the newest.
      folder: the folder of downloaded runs.
      say: a function that prints one line for the user: which revision it is, and where.

    Returns:
      The run folder, whose name ends with the revision.

    Raises:
      InvalidError: the name is none.
      NotFoundError: there is no such repository or revision, or it holds no run.
      UserError: `huggingface_hub` is not installed, the Hub refuses or cannot be reached, a path in
        the repository leaves the folder, or the folder cannot be written.
    """
    repository, revision = parse_hub_name(name)

    def place(commit: str) -> Path:
        return folder / f"{repository.replace('/', '--')}-{commit[:12]}"

    if not (revision and _COMMIT.fullmatch(revision) and place(revision).is_dir()):
        with _connected(name, to="read") as hub:
            revision = hub.repo_info(repository, revision=revision).sha or ""
            if not _COMMIT.fullmatch(revision):
                raise UserError(f"{name}: the server names no commit, but {clipped(revision)!r}")
            if not place(revision).is_dir():
                _fetch(hub, name, HubName(repository, revision), place(revision))
    if say is not None:
        say(f"{name}: revision {revision}, in {place(revision)}")
    return place(revision)


def _fetch(hub: "HfApi", name: str, source: HubName, folder: Path) -> None:
    """Download a revision of a run to a folder, which appears when it is complete."""
    from huggingface_hub.hf_api import RepoFile

    sizes = {
        entry.path: entry.size
        for entry in hub.list_repo_tree(source.repository, recursive=True, revision=source.revision)
        if isinstance(entry, RepoFile) and _is_of_a_run(entry.path)
    }
    if CONFIG not in sizes:
        raise NotFoundError(f"{name}: it holds no run of jetbot_mjx (no {CONFIG})")
    for path in sizes:
        if not _is_safe(path):
            raise UserError(f"{name}: nothing was downloaded: it holds the path {clipped(path)!r}")
    if len(sizes) > _MOST_FILES or sum(sizes.values()) > _MOST_BYTES:
        raise UserError(
            f"{name}: nothing was downloaded: {len(sizes):,} files of"
            f" {sum(sizes.values()) / 1e9:.1f} GB are more than a run has"
        )
    with writing_to(folder):
        make_folders(folder.parent)
        temporary = tempfile.mkdtemp(prefix=".unfinished-", dir=folder.parent)
    run, pool = Path(temporary) / "run", ThreadPoolExecutor(_AT_ONCE)

    def fetch(path: str) -> None:
        hub.hf_hub_download(source.repository, path, revision=source.revision, local_dir=run)

    try:
        for _ in pool.map(fetch, sizes):
            pass
        # The library keeps notes there.
        shutil.rmtree(run / ".cache")
        with writing_to(folder):
            sync_tree(run)
            try:
                move(run, folder)
            except OSError:
                # Another process may have been quicker.
                if not folder.is_dir():
                    raise
    finally:
        pool.shutdown(cancel_futures=True)
        shutil.rmtree(temporary, ignore_errors=True)


def _is_of_a_run(path: str) -> bool:
    top, inside, _ = path.partition("/")
    return top in (RUN_FOLDERS if inside else RUN_FILES)


def _is_safe(path: str) -> bool:
    """Return whether a path of a repository names a file below a folder on every system."""
    parts = path.split("/")
    return path.isprintable() and not any(
        part.strip(". ") == "" or re.search(r'[\\:*?"<>|]', part) for part in parts
    )


class Uploaded(NamedTuple):
    """An `Uploaded` says what is on the Hub now."""

    url: str
    """Address of the repository's page."""
    revision: str


def check_upload(name: str) -> None:
    """Raise an error, before long work, if a run could not be uploaded to a repository.

    Raises:
      UserError: as for `upload_run`.
    """
    repository = _upload_target(name)
    with _connected(name, to="write") as hub:
        me, owner = hub.whoami(), repository.partition("/")[0]
        mine = [me["name"], *(one["name"] for one in me.get("orgs", ()))]
        if owner not in mine:
            raise UserError(f"{name}: your token writes for {', '.join(mine)}, not for {owner}")
        if hub.repo_exists(repository):
            _check_owned(name, hub, repository)


def upload_run(
    name: str, files: Mapping[str, Path | bytes], message: str, *, private: bool = False
) -> Uploaded:
    """Make files the content of a repository, by one commit.

    What an earlier upload left there and this one lacks is deleted by the same commit. A repository
    that does not exist is created before; if the process ends before the commit, it stays empty.

    Args:
      name: `hf:USER/NAME`.
      files: the files, or their content, by their path in the repository.
      message: the message of the commit.
      private: whether a repository that is created is private.

    Returns:
      Where it is.

    Raises:
      UserError: `huggingface_hub` is not installed, the name is wrong, the repository holds
        something else, somebody changed it meanwhile, or the Hub refuses or cannot be reached.
    """
    repository = _upload_target(name)
    with _connected(name, to="write") as hub:
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        url = hub.create_repo(repository, private=private or None, exist_ok=True)
        paths, parent = _check_owned(name, hub, repository)
        old = [path for path in paths if _is_ours(path) and path not in files]
        commit = hub.create_commit(
            repository,
            [
                *(CommitOperationDelete(path) for path in old),
                *(CommitOperationAdd(path, content) for path, content in files.items()),
            ],
            commit_message=message,
            parent_commit=parent,
        )
    return Uploaded(str(url), commit.oid)


def _upload_target(name: str) -> str:
    repository, revision = parse_hub_name(name)
    if revision is not None:
        raise InvalidError(f"{name}: a run is shared without @: its revision is that of the commit")
    return repository


def _check_owned(name: str, hub: "HfApi", repository: str) -> tuple[list[str], str | None]:
    """Return the paths and the commit of a repository that is empty or an upload of a run."""
    info = hub.model_info(repository)
    paths = [one.rfilename for one in info.siblings or ()]
    is_empty = not [path for path in paths if path not in (".gitattributes", "README.md")]
    if not is_empty and not {CONFIG, METRICS}.intersection(paths):
        raise UserError(f"{name} holds something else than a run: choose another name")
    return paths, info.sha


def _is_ours(path: str) -> bool:
    return _is_of_a_run(path) or path.partition("/")[0] in SHOWN


@contextlib.contextmanager
def _connected(name: str, *, to: str) -> Iterator["HfApi"]:
    """Yield the library's functions, and convert its errors to one line each.

    Args:
      name: the name of the repository, for the messages.
      to: what the token must allow, `read` or `write`, for the messages.

    Raises:
      NotFoundError: there is no such repository or revision.
      UserError: the library is not installed, the Hub refuses or cannot be reached.
    """
    try:
        with requires_extra("hub", name):
            import huggingface_hub
            from huggingface_hub import constants, errors, utils
    except ValueError as error:
        raise UserError(f"{name}: HF_ENDPOINT = {_endpoint()!r} is no address: {error}") from None
    endpoint = _endpoint() or constants.ENDPOINT
    bars = not utils.are_progress_bars_disabled()
    log_in = f"set HF_TOKEN to a token that may {to} it, or say `hf auth login`"
    utils.disable_progress_bars()
    try:
        yield huggingface_hub.HfApi(endpoint=endpoint, library_name="jetbot_mjx")
    except UserError:
        # Some of them are `OSError`s too.
        raise
    except errors.LocalTokenNotFoundError:
        raise UserError(f"{name}: you are not logged in at {endpoint}: {log_in}") from None
    except errors.RevisionNotFoundError:
        raise NotFoundError(f"{name}: there is no such revision") from None
    except errors.RepositoryNotFoundError:
        why = f"there is no such repository at {endpoint} for you to read"
        raise NotFoundError(f"{name}: {why}: check the name; if it is right, {log_in}") from None
    except errors.HfHubHTTPError as error:
        raise UserError(f"{name}: {_answer(error, endpoint, log_in)}") from None
    except errors.HTTPError as error:  # pyright: ignore[reportPrivateImportUsage]
        raise UserError(f"{name}: {endpoint} cannot be reached: {_short(error)}") from None
    # The library raises these as well: for a card that the Hub refuses, no network, a full disk.
    except (OSError, ValueError, RuntimeError) as error:
        raise UserError(f"{name}: {_short(error.__cause__ or error)}") from None
    finally:
        if bars:
            utils.enable_progress_bars()


def _endpoint() -> str:
    return os.environ.get("HF_ENDPOINT", "")


def _answer(error: "Exception", endpoint: str, log_in: str) -> str:
    """Return what a server's refusal means."""
    status = error.response.status_code  # pyright: ignore[reportAttributeAccessIssue]
    if status in (401, 403):
        return f"{endpoint} refuses your token ({status}): {log_in}"
    if status in (409, 412):
        return f"somebody changed it meanwhile ({status}): share again"
    return f"{endpoint} answered {status}: {_short(error)}"


def _short(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return clipped(text or type(error).__name__, 200)
