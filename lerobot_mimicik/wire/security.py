"""Who may talk to a server: addresses that need no keys, and CURVE keys for all others.

A key pair is two text files as ZeroMQ's own tools write them: NAME.key may be given to anybody,
NAME.key_secret stays where it is. Both sides prove theirs, and everything between them is encrypted.
"""

from __future__ import annotations

import ipaddress
import os
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

import zmq
import zmq.auth

ZAP_DOMAIN = "mimicik"
_TCP = re.compile(r"tcp://(?P<host>\[[0-9a-fA-F:.]+\]|[^:;\[\]/]+):(?P<port>\d+|\*)")


@dataclass(frozen=True)
class ServerKeys:
    """Paths: the server's secret key file, and the folder of the public keys (*.key) of allowed clients."""

    secret_key: str
    allowed_keys: str


@dataclass(frozen=True)
class ClientKeys:
    """Paths: the client's secret key file, and the server's public key file."""

    secret_key: str
    server_key: str


def is_local(address: str) -> bool:
    """Whether only this computer can reach a server bound to `address`.

    Raises:
        ValueError: If it is no `tcp://HOST:PORT` and no `ipc://PATH`.
    """
    if address.startswith("ipc://") and len(address) > len("ipc://"):
        return True
    match = _TCP.fullmatch(address)
    if match is None:
        raise ValueError(f"The address {address!r} is neither tcp://HOST:PORT nor ipc://PATH.")
    try:
        return ipaddress.ip_address(match["host"].strip("[]")).is_loopback
    except ValueError:
        # A name, an interface or *: what it stands for is not known here, so it counts as the network.
        return False


def make_keys(folder: str | Path, name: str) -> tuple[Path, Path]:
    """Write a new key pair NAME.key and NAME.key_secret (readable by its owner only); returns both paths.

    Raises:
        FileExistsError: If either exists: a key that is in use is not overwritten.
        ValueError: If `name` is no file name.
    """
    if not re.fullmatch(r"[\w.-]+", name):
        raise ValueError(f"The key's name {name!r} is no file name of letters, digits, '.', '-' and '_'.")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    public, secret = folder / f"{name}.key", folder / f"{name}.key_secret"
    for path in (public, secret):
        if path.exists():
            raise FileExistsError(f"{path} exists; choose another name or folder, or remove it.")
    # In a folder that only its owner can enter, so that the secret is at no moment readable by others.
    with tempfile.TemporaryDirectory(dir=folder) as private:
        new_public, new_secret = zmq.auth.create_certificates(private, name)
        os.chmod(new_secret, 0o600)
        os.rename(new_secret, secret)
        os.rename(new_public, public)
    return public, secret


def secure_server(socket: zmq.Socket, keys: ServerKeys) -> None:
    """Make `socket` take CURVE connections only. Whom it lets in an authenticator of `ZAP_DOMAIN` decides.

    Raises:
        FileNotFoundError: If the key file does not exist.
        ValueError: If it is no secret key.
    """
    socket.curve_publickey, socket.curve_secretkey = _secret_pair(keys.secret_key)
    socket.curve_server = True
    # Nobody gets in while there is no authenticator; without these two everybody would.
    socket.zap_domain = ZAP_DOMAIN.encode()
    socket.zap_enforce_domain = 1


def check_allowed(folder: str) -> None:
    """See that `folder` holds public keys, all of them readable.

    Raises:
        FileNotFoundError: If it does not exist or holds no *.key.
        ValueError: If a file in it is no public key.
    """
    paths = sorted(Path(folder).glob("*.key"))
    if not paths:
        raise FileNotFoundError(f"{folder} holds no public key (*.key) of a client: nobody could connect.")
    for path in paths:
        _load(path)


def secure_client(socket: zmq.Socket, keys: ClientKeys) -> None:
    """Make `socket` prove its own key and connect only to the server of that public key.

    Raises:
        FileNotFoundError: If a key file does not exist.
        ValueError: If one is not what it should be.
    """
    socket.curve_publickey, socket.curve_secretkey = _secret_pair(keys.secret_key)
    socket.curve_serverkey, _ = _load(Path(keys.server_key))


def _secret_pair(path: str) -> tuple[bytes, bytes]:
    public, secret = _load(Path(path))
    if secret is None:
        raise ValueError(f"{path} holds no secret key; expected a NAME.key_secret file.")
    return public, secret


def _load(path: Path) -> tuple[bytes, bytes | None]:
    if not path.is_file():
        raise FileNotFoundError(
            f"The key file {path} does not exist; `mimicik serve --make_keys=DIR` makes one."
        )
    public, secret = zmq.auth.load_certificate(path)
    if len(public) != 40 or (secret is not None and len(secret) != 40):
        raise ValueError(f"{path} holds no CURVE key of 40 characters.")
    return public, secret
