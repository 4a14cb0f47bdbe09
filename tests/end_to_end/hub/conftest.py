"""A stand-in for a hub: a web server with the routes that huggingface_hub takes to upload and to download.

It asks for every file within the commit; a real hub wants large ones in its own storage first.
"""

import base64
import hashlib
import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
import yaml

LICENCES = {"apache-2.0", "cc-by-sa-4.0", "mit"}


@dataclass
class Repository:
    """One state after another, each a file's content by path."""

    private: bool
    commits: list[dict[str, bytes]] = field(default_factory=lambda: [{".gitattributes": b"*.onnx filter=lfs\n"}])
    tags: dict[str, int] = field(default_factory=dict)

    def hold(self, folder: Path) -> None:
        """Add a state with a model's folder, as a push does."""
        paths = (path for path in folder.rglob("*") if path.is_file())
        self.commits.append({path.relative_to(folder.parent).as_posix(): path.read_bytes() for path in paths})

    def sha(self, number: int) -> str:
        return f"{number:040x}"

    def number(self, revision: str) -> int | None:
        """The state that a branch, tag or commit names."""
        last = len(self.commits) - 1
        if revision in ("main", None):
            return last
        return self.tags.get(revision, next((n for n in range(last + 1) if self.sha(n) == revision), None))


class Hub(ThreadingHTTPServer):
    """Repositories in memory; who shows the token may do everything."""

    token = "hf_secret"

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server_port}"
        self.repositories: dict[str, Repository] = {}
        self.downloads: list[str] = []
        self.is_broken = False
        self.new = Repository
        self.before_commit: Callable[[], None] = lambda: None


class Handler(BaseHTTPRequestHandler):
    server: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None: ...

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path)
        if self.server.is_broken:
            return self.reply(500, {"error": "out of order"})
        parts = path.strip("/").split("/")
        if parts[:2] == ["api", "models"]:
            name, rest = "/".join(parts[2:4]), parts[4:]
        else:
            name, rest = "/".join(parts[:2]), parts[2:]
        repository = self.server.repositories.get(name)
        if repository is None or (repository.private and not self.is_known()):
            return self.reply(401, {"error": "Repository not found"}, {"X-Error-Code": "RepoNotFound"})
        number = repository.number(rest[1] if len(rest) > 1 else "main")
        if number is None:
            return self.reply(404, {"error": "Invalid rev id"}, {"X-Error-Code": "RevisionNotFound"})
        files, sha = repository.commits[number], repository.sha(number)
        if rest[:1] == ["resolve"]:
            return self.send_file("/".join(rest[2:]), files, sha)
        if rest[:1] == ["tree"]:
            entries = [{"type": "file", "path": name} | description(data) for name, data in files.items()]
            return self.reply(200, entries)
        siblings = [{"rfilename": name} for name in files]
        return self.reply(200, {"id": name, "sha": sha, "private": repository.private, "siblings": siblings})

    def send_file(self, path: str, files: dict[str, bytes], sha: str) -> None:
        if path not in files:
            return self.reply(404, {"error": "Entry not found"}, {"X-Error-Code": "EntryNotFound"})
        if self.command == "GET":
            self.server.downloads.append(path)
        etag = hashlib.sha256(files[path]).hexdigest()
        return self.reply(200, files[path], {"X-Repo-Commit": sha, "ETag": f'"{etag}"'})

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"] or 0)) or b"{}"
        path = unquote(urlsplit(self.path).path)
        if path == "/api/validate-yaml":
            return self.validate(json.loads(body)["content"])
        if not self.is_known():
            return self.reply(401, {"error": "Invalid username or password."})
        if path == "/api/repos/create":
            asked = json.loads(body)
            name = f"{asked['organization']}/{asked['name']}"
            private = asked.get("visibility") == "private" or asked.get("private", False)
            self.server.repositories[name] = Repository(private)
            return self.reply(200, {"url": f"{self.server.address}/{name}"})
        if "/preupload/" in path:
            return self.preupload(json.loads(body)["files"])
        if "/commit/" in path:
            return self.commit("/".join(path.split("/")[3:5]), [json.loads(line) for line in body.splitlines()])
        return self.reply(404, {"error": f"no route {path}"})

    def validate(self, card: str) -> None:
        data = yaml.safe_load(card.split("---\n")[1])
        errors = []
        if data.get("license") not in LICENCES | {None}:
            errors = [{"message": '"license" must be one of ' + ", ".join(sorted(LICENCES))}]
        self.reply(400 if errors else 200, {"errors": errors, "warnings": []})

    def preupload(self, files: list[dict[str, Any]]) -> None:
        answers = [{"path": file["path"], "uploadMode": "regular", "shouldIgnore": False} for file in files]
        self.reply(200, {"files": answers})

    def commit(self, name: str, lines: list[dict[str, Any]]) -> None:
        self.server.before_commit()
        repository = self.server.repositories[name]
        head, *operations = lines
        if head["value"].get("parentCommit") != repository.sha(len(repository.commits) - 1):
            return self.reply(412, {"error": "A commit has happened since. Please refresh and try again."})
        files = dict(repository.commits[-1])
        for operation in operations:
            value = operation["value"]
            files[value["path"]] = base64.b64decode(value["content"])
        repository.commits.append(files)
        sha = repository.sha(len(repository.commits) - 1)
        return self.reply(200, {"commitOid": sha, "commitUrl": f"{self.server.address}/{name}/commit/{sha}"})

    def is_known(self) -> bool:
        return self.headers["Authorization"] == f"Bearer {self.server.token}"

    def reply(self, status: int, content: Any, headers: dict[str, str] | None = None) -> None:
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(data))} | (headers or {})).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)


def description(data: bytes) -> dict[str, Any]:
    return {"size": len(data), "oid": hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()}


@pytest.fixture
def hub() -> Iterator[Hub]:
    server = Hub()
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()
