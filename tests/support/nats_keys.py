"""Keys of NATS and what they sign: users, and an operator with an account, as `nsc` makes them."""

from __future__ import annotations

import base64
import binascii
import json
import time
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

OPERATOR, ACCOUNT, USER = 14 << 3, 0, 20 << 3
"""The first bytes of public keys; those of secret keys are made of them."""
SEED = 18 << 3


class Key:
    """A key, with its secret and its public half as NATS writes them."""

    def __init__(self, kind: int) -> None:
        self._key = Ed25519PrivateKey.generate()
        self.seed = _written(
            bytes([SEED | kind >> 5, (kind & 31) << 3]) + self._key.private_bytes_raw()
        )
        self.public = _written(bytes([kind]) + self._key.public_key().public_bytes_raw())

    def jwt(self, subject: Key, kind: str, **claims: Any) -> str:
        """Return a JWT about a key, signed by this one."""
        header = {"typ": "JWT", "alg": "ed25519-nkey"}
        body = {
            "jti": subject.public,
            "iat": int(time.time()),
            "iss": self.public,
            "sub": subject.public,
            "name": kind,
            "nats": {"type": kind, "version": 2, **claims},
        }
        text = b".".join(_url(json.dumps(part).encode()) for part in (header, body))
        return b".".join((text, _url(self._key.sign(text)))).decode()


def _written(raw: bytes) -> str:
    return (
        base64.b32encode(raw + binascii.crc_hqx(raw, 0).to_bytes(2, "little")).decode().strip("=")
    )


def bytes_of(text: str, *, is_url: bool = False) -> bytes:
    """Return what is written in base32, or in the base64 of URLs."""
    if is_url:
        return base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))
    return base64.b32decode(text + "=" * (-len(text) % 8))


def _url(data: bytes) -> bytes:
    return base64.urlsafe_b64encode(data).rstrip(b"=")


LIMITS = {
    **dict.fromkeys(("subs", "data", "payload", "imports", "exports", "conn", "leaf"), -1),
    **dict.fromkeys(("mem_storage", "disk_storage", "streams", "consumer"), -1),
    "wildcards": True,
}


class Operator:
    """An operator with a system account, and one account whose users it lets in."""

    def __init__(self) -> None:
        self._operator, self._account, self._system = Key(OPERATOR), Key(ACCOUNT), Key(ACCOUNT)

    @property
    def config(self) -> str:
        """The part of a configuration of nats-server that trusts the operator."""
        operator = self._operator.jwt(
            self._operator, "operator", system_account=self._system.public
        )
        system = self._operator.jwt(self._system, "account", limits={"conn": -1, "subs": -1})
        account = self._operator.jwt(self._account, "account", limits=LIMITS)
        return (
            f"operator: {operator}\nsystem_account: {self._system.public}\nresolver: MEMORY\n"
            f"resolver_preload: {{{self._account.public}: {account}\n"
            f"{self._system.public}: {system}}}"
        )

    def write_credentials(self, path: Path) -> Key:
        """Write the credentials file of a new user, and return its key."""
        user = Key(USER)
        limits = {"subs": -1, "data": -1, "payload": -1}
        jwt = self._account.jwt(user, "user", pub={}, sub={}, **limits)
        rule = "*" * 65
        path.write_text(
            f"-----BEGIN NATS USER JWT-----\n{jwt}\n------END NATS USER JWT------\n\n"
            f"{rule[:31]} IMPORTANT {rule[:31]}\n"
            "NKEY Seed printed below can be used to sign and prove identity.\n"
            "NKEYs are sensitive and should be treated as secrets.\n\n"
            f"-----BEGIN USER NKEY SEED-----\n{user.seed}\n------END USER NKEY SEED------\n\n"
            f"{rule}\n"
        )
        return user
