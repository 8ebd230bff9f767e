"""What a Hub on loopback holds: repositories with commits, large files, who may read and write, checks.

`hub_server` makes it available over HTTP.
"""

from __future__ import annotations

import base64
import hashlib
import re
import threading
from dataclasses import dataclass, field
from typing import Any

import yaml

LFS_SUFFIXES = (".safetensors", ".bin", ".pt", ".parquet")
_LICENCES = {"apache-2.0", "mit", "bsd-3-clause", "cc-by-4.0", "cc0-1.0", "openrail", "other", "unknown"}
_REPO_ID = re.compile(r"[\w.-]+(/[\w.-]+)?")
_FRONT_MATTER = re.compile(r"---\s*\n(.*?)\n---\s*(\n|$)", re.DOTALL)


@dataclass(frozen=True)
class Blob:
    """A file's content, in Git or, with `lfs`, in the storage with a pointer in Git."""

    content: bytes
    lfs: bool

    @property
    def sha256(self) -> str:
        """The object's name in the storage."""
        return hashlib.sha256(self.content).hexdigest()

    @property
    def pointer(self) -> bytes:
        """What Git holds of a large file."""
        return (
            f"version https://git-lfs.github.com/spec/v1\noid sha256:{self.sha256}\n"
            f"size {len(self.content)}\n"
        ).encode()

    @property
    def oid(self) -> str:
        """The blob's name in Git."""
        data = self.pointer if self.lfs else self.content
        return hashlib.sha1(f"blob {len(data)}\0".encode() + data).hexdigest()


@dataclass
class Repository:
    """A model repository: the tree at each commit, the newest last."""

    private: bool = False
    commits: dict[str, dict[str, Blob]] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)

    def commit(self, files: dict[str, Blob], message: str) -> str:
        """Adds a commit whose tree is `files` and returns its name."""
        parent = self.head if self.commits else ""
        tree = "".join(f"{path} {blob.oid}\n" for path, blob in sorted(files.items()))
        name = hashlib.sha1(f"{parent}\n{message}\n{tree}".encode()).hexdigest()
        self.commits[name] = dict(files)
        self.messages.append(message)
        return name

    @property
    def head(self) -> str:
        """Name of the newest commit."""
        return next(reversed(self.commits))

    @property
    def files(self) -> dict[str, Blob]:
        """The tree of the newest commit."""
        return self.commits[self.head]


class HubError(Exception):
    """An answer that is an error: status, message and the Hub's error code."""

    def __init__(self, status: int, message: str, code: str | None = None, commit: str | None = None) -> None:
        super().__init__(message)
        self.status, self.code, self.commit = status, code, commit


class Hub:
    """What the server holds. `tokens` maps an access token to the user it belongs to."""

    def __init__(self, tokens: dict[str, str]) -> None:
        self.tokens = tokens
        self.repositories: dict[str, Repository] = {}
        self.storage: dict[str, bytes] = {}
        self.granted: set[str] = set()
        self.requests: list[tuple[str, str]] = []
        self.endpoint = self.storage_endpoint = ""
        self.lock = threading.Lock()

    def create(self, repo: str, private: bool) -> None:
        """Makes an empty repository."""
        self.repositories[repo] = Repository(private)
        attributes = "".join(f"*{suffix} filter=lfs diff=lfs merge=lfs -text\n" for suffix in LFS_SUFFIXES)
        self.repositories[repo].commit({".gitattributes": Blob(attributes.encode(), False)}, "initial commit")

    def readable(self, repo: str, user: str | None) -> Repository:
        """A repository that a user may read; a private one looks to others as if it did not exist."""
        found = self.repositories.get(repo)
        if found is None or (found.private and user != repo.split("/")[0]):
            if user is None:
                raise HubError(401, "Invalid username or password.")
            raise HubError(404, "Repository not found", "RepoNotFound")
        return found

    def writable(self, repo: str, user: str | None) -> Repository:
        """A repository that a user may change."""
        found = self.readable(repo, user)
        if user is None:
            raise HubError(401, "Invalid username or password.")
        if user != repo.split("/")[0]:
            raise HubError(403, "Forbidden: pass `create_pr=1` as a query parameter to create a Pull Request")
        return found

    def apply(self, repository: Repository, lines: list[dict[str, Any]]) -> str:
        """Applies the operations of a commit request and returns the commit's name."""
        files, header = dict(repository.files), {}
        for line in lines:
            key, value = line["key"], line["value"]
            if key == "header":
                header = value
            elif key == "file":
                files[value["path"]] = Blob(base64.b64decode(value["content"]), lfs=False)
            elif key == "lfsFile":
                if value["oid"] not in self.storage:
                    raise HubError(
                        400, f"LFS pointer of {value['path']} points to a file that does not exist"
                    )
                files[value["path"]] = Blob(self.storage[value["oid"]], lfs=True)
            elif key == "deletedFile":
                if files.pop(value["path"], None) is None:
                    raise HubError(
                        404, f"A file with this name doesn't exist: {value['path']}", "EntryNotFound"
                    )
            else:
                raise HubError(400, f"Invalid operation {key!r}")
        if not header.get("summary"):
            raise HubError(400, "A commit needs a summary")
        if "README.md" in files:
            errors = check_metadata(files["README.md"].content.decode())[0]
            if errors:
                raise HubError(400, f"Invalid metadata in README.md: {errors[0]}")
        return repository.commit(files, header["summary"])


def metadata(readme: str) -> Any:
    """The YAML in front of a README, None without one."""
    front = _FRONT_MATTER.match(readme)
    return yaml.safe_load(front.group(1)) if front else None


def check_metadata(readme: str) -> tuple[list[str], list[str]]:
    """What the Hub finds wrong with a README's metadata: errors, and warnings."""
    try:
        found = metadata(readme)
    except yaml.YAMLError as error:
        return [f"invalid YAML: {error}"], []
    if not found:
        return [], ["empty or missing yaml metadata in repo card"]
    if not isinstance(found, dict):
        return ["the metadata must be a mapping"], []
    errors = []
    if found.get("license") not in (None, *_LICENCES):
        errors.append(f'"license" must be one of {sorted(_LICENCES)}')
    for key in ("library_name", "pipeline_tag", "model_name"):
        if not isinstance(found.get(key, ""), str):
            errors.append(f'"{key}" must be a string')
    tags = found.get("tags", [])
    if not isinstance(tags, list) or not all(isinstance(tag, str) for tag in tags):
        errors.append('"tags" must be a list of strings')
    datasets = found.get("datasets", [])
    datasets = [datasets] if isinstance(datasets, str) else datasets
    errors += [
        f'"datasets": {name!r} is no repository id'
        for name in datasets
        if not isinstance(name, str) or not _REPO_ID.fullmatch(name)
    ]
    return errors, []
