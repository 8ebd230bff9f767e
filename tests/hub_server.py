"""A Hub on loopback: the part of the Hugging Face Hub's HTTP interface that up- and downloads go through.

Repositories of models with commits on `main`, access by bearer token, private repositories, and large files
that travel by Git LFS through a storage host of their own: here the Hub is `127.0.0.1` and the storage
`localhost`, which refuses requests that carry the token. Errors have the Hub's status codes and headers.
Not there: Xet, datasets, branches, pull requests.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from hub_contents import LFS_SUFFIXES, Blob, Hub, HubError, Repository, check_metadata, metadata

REPO = r"(?P<repo>[\w.-]+/[\w.-]+)"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: _Server

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing is logged."""

    def _dispatch(self) -> None:
        hub = self.server.hub
        url = urlsplit(self.path)
        self.query = parse_qs(url.query)
        self.body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        at_storage = self.headers.get("Host", "").split(":")[0] == "localhost"
        try:
            with hub.lock:
                hub.requests.append((self.command, url.path))
                for method, pattern, name in _STORAGE_ROUTES if at_storage else _HUB_ROUTES:
                    match = re.fullmatch(pattern, unquote(url.path))
                    if match and self.command in method.split():
                        getattr(self, name)(hub, **match.groupdict())
                        return
            raise HubError(404, "Sorry, we can't find the page you are looking for.")
        except HubError as error:
            headers = {"X-Error-Message": str(error)}
            headers |= {"X-Error-Code": error.code} if error.code else {}
            headers |= {"X-Repo-Commit": error.commit} if error.commit else {}
            self._json({"error": str(error)}, error.status, headers)

    do_GET = do_HEAD = do_POST = do_PUT = _dispatch  # noqa: N815

    # --- The Hub ---

    def whoami(self, hub: Hub) -> None:
        if self.user is None:
            raise HubError(401, "Invalid username or password.")
        self._json({"type": "user", "name": self.user, "orgs": [], "auth": {"type": "access_token"}})

    def validate_yaml(self, hub: Hub) -> None:
        errors, warnings = check_metadata(self.json["content"])
        answer = {key: [{"message": text} for text in found] for key, found in
                  (("errors", errors), ("warnings", warnings))}  # fmt: skip
        self._json(answer, 400 if errors else 200)

    def create_repo(self, hub: Hub) -> None:
        if self.user is None:
            raise HubError(401, "Invalid username or password.")
        namespace = self.json.get("organization") or self.user
        if namespace != self.user:
            raise HubError(
                403, f'You don\'t have the rights to create a model under the namespace "{namespace}"'
            )
        repo = f"{namespace}/{self.json['name']}"
        answer = {"url": f"{hub.endpoint}/{repo}", "name": repo, "id": repo}
        if repo in hub.repositories:
            self._json(answer | {"error": "You already created this model repo"}, 409)
            return
        hub.create(repo, private=self.json.get("visibility") == "private" or bool(self.json.get("private")))
        self._json(answer)

    def preupload(self, hub: Hub, repo: str, revision: str) -> None:
        repository = hub.writable(repo, self.user)
        current = self._tree(repository, revision)[1]
        answers = []
        for file in self.json["files"]:
            blob = current.get(file["path"])
            answers.append({
                "path": file["path"],
                "uploadMode": "lfs" if file["path"].endswith(LFS_SUFFIXES) else "regular",
                "shouldIgnore": False,
                "oid": None if blob is None else (blob.sha256 if blob.lfs else blob.oid),
            })  # fmt: skip
        self._json({"files": answers})

    def lfs_batch(self, hub: Hub, repo: str) -> None:
        hub.writable(repo, self.user)
        objects = []
        for asked in self.json["objects"]:
            entry = {"oid": asked["oid"], "size": asked["size"]}
            if asked["oid"] not in hub.storage:
                signature = secrets.token_hex(8)
                hub.granted.add(signature)
                entry["actions"] = {
                    "upload": {"href": f"{hub.storage_endpoint}/{asked['oid']}?signature={signature}"},
                    "verify": {"href": f"{hub.endpoint}/{repo}.git/info/lfs/verify"},
                }
            objects.append(entry)
        self._json({"transfer": "basic", "objects": objects})

    def lfs_verify(self, hub: Hub, repo: str) -> None:
        hub.writable(repo, self.user)
        stored = hub.storage.get(self.json["oid"])
        if stored is None or len(stored) != self.json["size"]:
            raise HubError(404, f"No object {self.json['oid']} of {self.json['size']} bytes")
        self._json({"success": True})

    def commit(self, hub: Hub, repo: str, revision: str) -> None:
        repository = hub.writable(repo, self.user)
        self._tree(repository, revision)
        name = hub.apply(repository, [json.loads(line) for line in self.body.splitlines() if line])
        self._json({
            "success": True,
            "commitOid": name,
            "commitUrl": f"{hub.endpoint}/{repo}/commit/{name}",
            "hookOutput": "",
        })  # fmt: skip

    def model_info(self, hub: Hub, repo: str, revision: str = "main") -> None:
        repository = hub.readable(repo, self.user)
        name, files = self._tree(repository, revision)
        card = metadata(files["README.md"].content.decode()) if "README.md" in files else None
        known = {key: card[key] for key in ("library_name", "pipeline_tag") if key in (card or {})}
        self._json({
            "_id": hashlib.sha1(repo.encode()).hexdigest()[:24],
            "id": repo,
            "modelId": repo,
            "author": repo.split("/")[0],
            "sha": name,
            "private": repository.private,
            "gated": False,
            "disabled": False,
            "downloads": 0,
            "likes": 0,
            "tags": (card or {}).get("tags", []),
            "cardData": card,
            "siblings": [{"rfilename": path} for path in sorted(files)],
            **known,
        })  # fmt: skip

    def tree(self, hub: Hub, repo: str, revision: str) -> None:
        files = self._tree(hub.readable(repo, self.user), revision)[1]
        entries = []
        for path, blob in sorted(files.items()):
            entry: dict[str, Any] = {"type": "file", "path": path, "oid": blob.oid, "size": len(blob.content)}
            if blob.lfs:
                entry["lfs"] = {"oid": blob.sha256, "size": entry["size"], "pointerSize": len(blob.pointer)}
            entries.append(entry)
        self._json(entries)

    def resolve(self, hub: Hub, repo: str, revision: str, path: str) -> None:
        name, files = self._tree(hub.readable(repo, self.user), revision)
        if path not in files:
            raise HubError(404, "Entry not found", "EntryNotFound", commit=name)
        blob = files[path]
        if not blob.lfs:
            self._bytes(blob.content, {"ETag": f'"{blob.oid}"', "X-Repo-Commit": name})
            return
        signature = secrets.token_hex(8)
        hub.granted.add(signature)
        self._bytes(b"", {
            "Location": f"{hub.storage_endpoint}/{blob.sha256}?signature={signature}",
            "X-Linked-Etag": f'"{blob.sha256}"',
            "X-Linked-Size": str(len(blob.content)),
            "X-Repo-Commit": name,
        }, status=302)  # fmt: skip

    # --- The storage ---

    def _check_signature(self, hub: Hub) -> None:
        if "Authorization" in self.headers:
            raise HubError(400, "Only one auth mechanism allowed")
        if self.query.get("signature", [""])[0] not in hub.granted:
            raise HubError(403, "The request signature does not match")

    def store(self, hub: Hub, oid: str) -> None:
        self._check_signature(hub)
        if hashlib.sha256(self.body).hexdigest() != oid:
            raise HubError(400, "The content does not have the name it was to be stored under")
        hub.storage[oid] = self.body
        self._bytes(b"", {})

    def fetch(self, hub: Hub, oid: str) -> None:
        self._check_signature(hub)
        if oid not in hub.storage:
            raise HubError(404, "The specified key does not exist")
        self._bytes(hub.storage[oid], {"ETag": f'"{oid}"'})

    # --- Requests and answers ---

    @property
    def user(self) -> str | None:
        """Who asks: None without a token; a wrong token is an error."""
        given = self.headers.get("Authorization")
        if given is None:
            return None
        user = self.server.hub.tokens.get(given.removeprefix("Bearer "))
        if user is None:
            raise HubError(401, "Invalid credentials in Authorization header")
        return user

    @property
    def json(self) -> dict[str, Any]:
        """The request's content."""
        return json.loads(self.body)

    @staticmethod
    def _tree(repository: Repository, revision: str) -> tuple[str, dict[str, Blob]]:
        name = repository.head if revision == "main" else revision
        if name not in repository.commits:
            raise HubError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return name, repository.commits[name]

    def _json(self, answer: Any, status: int = 200, headers: dict[str, str] | None = None) -> None:
        headers = {"Content-Type": "application/json; charset=utf-8"} | (headers or {})
        self._bytes(json.dumps(answer).encode(), headers, status)

    def _bytes(self, content: bytes, headers: dict[str, str], status: int = 200) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)


_HUB_ROUTES = (
    ("GET", "/api/whoami-v2", "whoami"),
    ("POST", "/api/validate-yaml", "validate_yaml"),
    ("POST", "/api/repos/create", "create_repo"),
    ("POST", f"/api/models/{REPO}/preupload/(?P<revision>[^/]+)", "preupload"),
    ("POST", f"/api/models/{REPO}/commit/(?P<revision>[^/]+)", "commit"),
    ("GET", f"/api/models/{REPO}/revision/(?P<revision>[^/]+)", "model_info"),
    ("GET", f"/api/models/{REPO}/tree/(?P<revision>[^/]+)", "tree"),
    ("GET", f"/api/models/{REPO}", "model_info"),
    ("POST", f"/{REPO}\\.git/info/lfs/objects/batch", "lfs_batch"),
    ("POST", f"/{REPO}\\.git/info/lfs/verify", "lfs_verify"),
    ("GET HEAD", f"/{REPO}/resolve/(?P<revision>[^/]+)/(?P<path>.+)", "resolve"),
)
_STORAGE_ROUTES = (
    ("PUT", "/(?P<oid>[0-9a-f]{64})", "store"),
    ("GET HEAD", "/(?P<oid>[0-9a-f]{64})", "fetch"),
)


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, hub: Hub) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.hub = hub
        hub.endpoint = f"http://127.0.0.1:{self.server_port}"
        hub.storage_endpoint = f"http://localhost:{self.server_port}"


@contextmanager
def serve(tokens: dict[str, str]) -> Iterator[Hub]:
    """Serves a new, empty Hub at `hub.endpoint` until the block ends."""
    hub = Hub(tokens)
    server = _Server(hub)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
