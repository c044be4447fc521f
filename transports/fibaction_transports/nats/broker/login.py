"""The login at a broker of NATS, without I/O: its INFO is read, and CONNECT is made.

Theory of operation
-------------------

A broker begins with a line INFO, which says whether it has TLS, and may have a nonce. The client
answers with CONNECT, which has the login, and PING; the broker answers with PONG or with -ERR. A
user with a password and a token are sent as they are.

If a user has a key (an nkey), the broker knows its public half, and the client signs the nonce.
A credentials file has the key and a JWT, by which an operator of NATS lets this key in. Keys are
written in base32: two bytes for the kind of key, 32 bytes of it, and a checksum.
"""

from __future__ import annotations

import base64
import binascii
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from fibaction import __version__
from fibaction.border.peer_text import excerpt
from fibaction.words.errors import AuthenticationFailed, LimitReached, TransportError
from fibaction.words.extras import MissingExtra, NeedsExtra
from fibaction_transports.nats.settings import FleetSettings

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

USER_SEED = b"\x95\x00"
"""The first bytes of the secret key of a user; in base32 it begins with SU."""
USER = b"\xa0"
"""The first byte of the public key of a user; in base32 it begins with U."""
SEED_LENGTH = 58
"""Characters of a secret key."""


class BrokerInfo(msgspec.Struct, frozen=True):
    """The INFO of a broker, as far as it matters here."""

    version: str = ""
    cluster: str = ""
    """The name of its cluster; empty if it is alone."""
    max_payload: int = 2**20
    """The bytes of the largest message that the broker takes."""
    headers: bool = False
    nonce: str = ""
    tls_required: bool = False
    tls_available: bool = False
    connect_urls: tuple[str, ...] = ()
    """The brokers of the cluster, each as `host:port`."""


def info_of(line: bytes) -> BrokerInfo:
    """Return what a broker says of itself in its first line.

    Raises:
        ValueError: It is not the INFO of a broker.
    """
    name, _, text = line.partition(b" ")
    if name != b"INFO":
        raise ValueError("the first line is not INFO")
    try:
        return msgspec.json.decode(text, type=BrokerInfo)
    except msgspec.DecodeError as exc:
        raise ValueError(f"a broken INFO: {exc}") from exc


class NatsCredentials:
    """The key of a user, and the JWT that lets it in, if it needs one."""

    def __init__(self, seed: str, jwt: str) -> None:
        """Take a secret key as NATS writes it.

        Raises:
            ValueError: It is not the secret key of a user.
            MissingExtra: The library that signs is not installed.
        """
        self._key = _key_of(seed)
        self._jwt = jwt

    @classmethod
    def read(cls, path: str) -> NatsCredentials:
        """Read a credentials file, or a file that has a secret key only.

        Raises:
            TransportError: It cannot be read or used.
        """
        try:
            words = Path(path).read_bytes().decode("ascii", "replace").split()
        except OSError as exc:
            raise TransportError(
                f"the credentials file {path} cannot be read: {exc.strerror}"
            ) from exc
        seeds = [word for word in words if len(word) == SEED_LENGTH and word.startswith("SU")]
        jwts = [word for word in words if word.startswith("eyJ") and word.count(".") == 2]
        try:
            return cls(seeds[0], jwts[0] if jwts else "")
        except MissingExtra as exc:
            raise TransportError(str(exc)) from exc
        except (IndexError, ValueError):
            raise TransportError(
                f"{path} is not a credentials file: it has no secret key of a user of NATS"
            ) from None  # it may quote the key

    def answer(self, nonce: str) -> dict[str, str]:
        """Return the fields of CONNECT that answer to a nonce."""
        signature = base64.urlsafe_b64encode(self._key.sign(nonce.encode()))
        fields = {"sig": signature.rstrip(b"=").decode()}
        if self._jwt:
            return {**fields, "jwt": self._jwt}
        public = USER + self._key.public_key().public_bytes_raw()
        return {**fields, "nkey": base64.b32encode(public + _checksum(public)).decode()}


def _key_of(seed: str) -> Ed25519PrivateKey:
    """Return a secret key.

    Raises:
        ValueError: It is not the secret key of a user.
        MissingExtra: The library that signs is not installed.
    """
    with NeedsExtra("a credentials file of NATS", "fibaction[nats]"):
        from cryptography.hazmat.primitives.asymmetric import ed25519

    raw = base64.b32decode(seed + "=" * (-len(seed) % 8))
    key, checksum = raw[:-2], raw[-2:]
    if key[:2] != USER_SEED or _checksum(key) != checksum:
        raise ValueError("not the secret key of a user")
    return ed25519.Ed25519PrivateKey.from_private_bytes(key[2:])


def _checksum(key: bytes) -> bytes:
    return binascii.crc_hqx(key, 0).to_bytes(2, "little")


def connect_command(
    settings: FleetSettings, credentials: NatsCredentials | None, info: BrokerInfo
) -> bytes:
    """Return the answer to the INFO of a broker: CONNECT with the login, and PING."""
    fields: dict[str, object] = {
        "name": "fibaction",
        "lang": "python",
        "version": __version__,
        "verbose": False,
        "pedantic": False,
        "protocol": 1,
        "headers": info.headers,
        "no_responders": info.headers,
    }
    if settings.user or settings.password:
        fields.update(user=settings.user)
        fields["pass"] = settings.password
    if settings.login_token:
        fields.update(auth_token=settings.login_token)
    if credentials is not None and info.nonce:
        fields.update(credentials.answer(info.nonce))
    return b"CONNECT %s\r\nPING\r\n" % msgspec.json.encode(fields)


def is_let_in(server: str, line: bytes) -> bool:
    """Return whether a line of a broker ends the login; False if another line has to come.

    Raises:
        AuthenticationFailed: The broker rejects the login.
        LimitReached: The broker is full.
        TransportError: The broker reports another error.
        ValueError: It is not a broker.
    """
    name, _, rest = line.partition(b" ")
    if name == b"-ERR":
        text = excerpt(rest.decode("utf-8", "replace").strip(" '"))
        if "uthorization" in text or "uthentication" in text:
            raise AuthenticationFailed(
                f"the broker {server} rejects the login: give user:password@ or token@ in front of"
                f" the host, or creds="
            )
        kind = LimitReached if text.startswith("maximum ") else TransportError
        raise kind(f"the broker {server} rejects the connection: {text}")
    if name not in (b"PONG", b"INFO", b"+OK"):
        raise ValueError("an unknown line")
    return name == b"PONG"
