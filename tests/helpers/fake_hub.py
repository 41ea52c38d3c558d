"""A server that speaks what `huggingface_hub` uses of the Hugging Face Hub, on this machine.

It keeps commits in memory: `hub.repositories["ada/robot"]` is a list of them, the first made by the
creation, each with all files. Files of `LARGE` bytes or more go by LFS. Whoever has the token of
`TOKENS` is its user, and writes only below the own name.
"""

import base64
import contextlib
import hashlib
import http.server
import json
import re
import threading
import urllib.parse
from typing import NamedTuple

LARGE = 10_000
TOKENS = {"hf_ada": "ada", "hf_eve": "eve"}


class Commit(NamedTuple):
    sha: str
    files: dict[str, bytes]
    message: str


class FakeHub:
    """The content of the server, and how it fails where it is asked to."""

    def __init__(self, url):
        self.url = url
        self.repositories = {}
        self.private = set()
        self.objects = {}
        self.requests = []
        self.failing = {}
        """Status to answer a request with, by a part of its method and path."""
        self.before_commit = None
        """Called when a commit arrives."""

    def commit(self, name, files, message="by hand"):
        """Make files the content of a repository."""
        commits = self.repositories.setdefault(name, [])
        text = json.dumps([name, len(commits), sorted(files)])
        commits.append(Commit(hashlib.sha1(text.encode()).hexdigest(), dict(files), message))
        return commits[-1].sha

    def find(self, name, revision):
        commits = self.repositories[name]
        if revision == "main":
            return commits[-1]
        return next((one for one in commits if one.sha == revision), None)


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def handle_any(self):
        self.body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        url = urllib.parse.urlsplit(self.path)
        path = urllib.parse.unquote(url.path)
        request = f"{self.command} {path}"
        self.hub.requests.append(request)
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        self.user = TOKENS.get(token)
        if token and self.user is None:
            message = "Invalid credentials in Authorization header"
            return self.answer(401, {"error": message}, {"X-Error-Message": message})
        for part, status in self.hub.failing.items():
            if part in request:
                if status is None:
                    # The network breaks.
                    self.close_connection = True
                    self.connection.close()
                    return None
                return self.answer(status, {"error": "asked to fail"})
        for pattern, method in _ROUTES:
            if found := re.fullmatch(pattern, request):
                return method(self, *found.groups())
        return self.answer(404, {"error": "no such route"})

    do_GET = do_POST = do_PUT = do_HEAD = handle_any

    def answer(self, status, content=b"", headers=()):
        if not isinstance(content, bytes):
            content = json.dumps(content).encode()
        self.send_response(status)
        for key, value in {"Content-Length": str(len(content)), **dict(headers)}.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def revision_of(self, name, revision):
        """The commit of a name, or None after an answer that there is none."""
        owner = name.partition("/")[0]
        hidden = name in self.hub.private and self.user != owner
        if name not in self.hub.repositories or hidden:
            self.answer(404 if self.user else 401, {}, {"X-Error-Code": "RepoNotFound"})
            return None
        commit = self.hub.find(name, revision or "main")
        if commit is None:
            self.answer(404, {}, {"X-Error-Code": "RevisionNotFound"})
        return commit

    def whoami(self):
        if self.user is None:
            return self.answer(401, {"error": "nobody"})
        return self.answer(200, {"name": self.user, "orgs": []})

    def create(self):
        asked = json.loads(self.body)
        name = f"{asked['organization']}/{asked['name']}"
        if asked["organization"] != self.user:
            return self.answer(403, {"error": "not yours"})
        url = {"url": f"{self.hub.url}/{name}"}
        if name in self.hub.repositories:
            return self.answer(409, url)
        self.hub.commit(name, {".gitattributes": b"*.bin filter=lfs\n"}, "initial commit")
        if asked.get("visibility") == "private":
            self.hub.private.add(name)
        return self.answer(200, url)

    def validate(self):
        return self.answer(200, {"errors": [], "warnings": []})

    def info(self, name, revision=None):
        if commit := self.revision_of(name, revision):
            siblings = [{"rfilename": path} for path in commit.files]
            self.answer(200, {"id": name, "sha": commit.sha, "siblings": siblings})

    def tree(self, name, revision):
        if commit := self.revision_of(name, revision):
            self.answer(200, [_entry(path, content) for path, content in commit.files.items()])

    def preupload(self, name, revision):
        if self.revision_of(name, revision):
            files = [
                {
                    "path": file["path"],
                    "uploadMode": "lfs" if file["size"] >= LARGE else "regular",
                    "shouldIgnore": False,
                }
                for file in json.loads(self.body)["files"]
            ]
            self.answer(200, {"files": files})

    def batch(self, name):
        objects = []
        for one in json.loads(self.body)["objects"]:
            upload = {"href": f"{self.hub.url}/lfs/{one['oid']}", "header": {}}
            actions = {} if one["oid"] in self.hub.objects else {"actions": {"upload": upload}}
            objects.append({**one, **actions})
        self.answer(200, {"transfer": "basic", "objects": objects})

    def put(self, oid):
        assert hashlib.sha256(self.body).hexdigest() == oid
        self.hub.objects[oid] = self.body
        self.answer(200)

    def commit(self, name, revision):
        if self.hub.before_commit is not None:
            self.hub.before_commit()
        if self.user != name.partition("/")[0]:
            return self.answer(403, {"error": "not yours"})
        before = self.revision_of(name, revision)
        files, message = dict(before.files), ""
        for line in self.body.splitlines():
            match json.loads(line):
                case {"key": "header", "value": header}:
                    message = header["summary"]
                    if header.get("parentCommit", before.sha) != before.sha:
                        return self.answer(412, {"error": "has changed"})
                case {"key": "file", "value": file}:
                    files[file["path"]] = base64.b64decode(file["content"])
                case {"key": "lfsFile", "value": file}:
                    files[file["path"]] = self.hub.objects[file["oid"]]
                case {"key": "deletedFile", "value": file}:
                    del files[file["path"]]
        sha = self.hub.commit(name, files, message)
        url = f"{self.hub.url}/{name}/commit/{sha}"
        return self.answer(200, {"commitUrl": url, "commitOid": sha})

    def resolve(self, name, revision, path):
        commit = self.revision_of(name, revision)
        if commit is None:
            return None
        if path not in commit.files:
            return self.answer(404, {}, {"X-Error-Code": "EntryNotFound"})
        content = commit.files[path]
        oid = hashlib.sha256(content).hexdigest()
        headers = {"X-Repo-Commit": commit.sha, "ETag": f'"{_git_hash(content)}"'}
        if len(content) < LARGE:
            return self.answer(200, content, headers)
        self.hub.objects[oid] = content
        headers |= {"X-Linked-ETag": f'"{oid}"', "X-Linked-Size": str(len(content))}
        # As the real one, on another host, whose answers know nothing of the repository.
        elsewhere = self.hub.url.replace("127.0.0.1", "localhost")
        return self.answer(302, b"", {**headers, "Location": f"{elsewhere}/lfs/{oid}"})

    def get(self, oid):
        self.answer(200, self.hub.objects[oid])


_ID = r"([\w.-]+/[\w.-]+)"
_ROUTES = [
    ("GET /api/whoami-v2", _Handler.whoami),
    ("POST /api/repos/create", _Handler.create),
    ("POST /api/validate-yaml", _Handler.validate),
    (f"GET /api/models/{_ID}", _Handler.info),
    (f"GET /api/models/{_ID}/revision/(.+)", _Handler.info),
    (f"GET /api/models/{_ID}/tree/([^/]+)", _Handler.tree),
    (f"POST /api/models/{_ID}/preupload/(.+)", _Handler.preupload),
    (rf"POST /{_ID}\.git/info/lfs/objects/batch", _Handler.batch),
    ("PUT /lfs/([0-9a-f]+)", _Handler.put),
    ("(?:GET|HEAD) /lfs/([0-9a-f]+)", _Handler.get),
    (f"POST /api/models/{_ID}/commit/(.+)", _Handler.commit),
    (f"(?:GET|HEAD) /{_ID}/resolve/([^/]+)/(.+)", _Handler.resolve),
]


def _git_hash(content):
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def _entry(path, content):
    entry = {"type": "file", "path": path, "size": len(content), "oid": _git_hash(content)}
    if len(content) >= LARGE:
        oid = hashlib.sha256(content).hexdigest()
        entry["lfs"] = {"oid": oid, "size": len(content), "pointerSize": 134}
    return entry


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request, client_address):
        """Say nothing of clients that leave."""


@contextlib.contextmanager
def serving():
    """Serve an empty Hub while the context lasts."""
    handler = type("Handler", (_Handler,), {})
    server = _Server(("127.0.0.1", 0), handler)
    handler.hub = FakeHub(f"http://127.0.0.1:{server.server_port}")
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield handler.hub
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
