"""The login at a broker, without a broker."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from fibaction import AuthenticationFailed, LimitReached, TransportError
from fibaction_transports.nats.broker.login import (
    BrokerInfo,
    NatsCredentials,
    connect_command,
    info_of,
    is_let_in,
)
from fibaction_transports.nats.settings import FleetSettings
from tests.support.nats_keys import bytes_of

# As the documentation of NATS has them.
SEED = "SUACSSL3UAHUDXKFSNVUZRF5UHPMWZ6BFDTJ7M6USDXIEDNPPQYYYCU3VY"
PUBLIC = "UDXU4RCSJNZOIQHZNWXHXORDPRTGNJAHAHFRGZNEEJCPQTT2M7NLCNF4"
ACCOUNT_SEED = "SAAJDFIJTW4V2ZZ3R624KS3MD7V7QRBNW3SWGOZF673WZFKVYS3X3S46CA"
NO_LOGIN = {"name", "lang", "version", "verbose", "pedantic", "protocol", "headers"}


def fields_of(
    settings: FleetSettings, credentials: NatsCredentials | None = None, **info: Any
) -> dict[str, Any]:
    """The login that a client sends."""
    sent = connect_command(settings, credentials, BrokerInfo(**info))
    assert sent.startswith(b"CONNECT {")
    assert sent.endswith(b"}\r\nPING\r\n")
    fields: dict[str, Any] = msgspec.json.decode(sent.split(b"\r\n")[0].removeprefix(b"CONNECT "))
    return {name: value for name, value in fields.items() if name not in NO_LOGIN}


def check_signature(public: str, signature: str, nonce: bytes) -> None:
    key = Ed25519PublicKey.from_public_bytes(bytes_of(public)[1:33])
    key.verify(bytes_of(signature, is_url=True), nonce)


# What a broker says


@pytest.mark.parametrize(
    "line",
    [b"", b"HTTP/1.1 200 OK", b"INFO", b"INFO x", b'INFO {"max_payload": "x"}', b"INFO \xff"],
)
def test_a_first_line_of_something_else_is_an_error(line: bytes) -> None:
    with pytest.raises(ValueError, match="INFO"):
        info_of(line)


@pytest.mark.parametrize(
    ("said", "kind", "text"),
    [
        ("'Authorization Violation'", AuthenticationFailed, "rejects the login: give user:"),
        ("'User Authentication Expired'", AuthenticationFailed, "rejects the login: give user:"),
        ("'maximum connections exceeded'", LimitReached, "connection: maximum connections exceed"),
        ("'\x1b[2JParser Error'", TransportError, "rejects the connection: \\x1b[2JParser Error"),
    ],
)
def test_an_error_of_a_broker_is_one_sentence(
    said: str, kind: type[TransportError], text: str
) -> None:
    with pytest.raises(TransportError) as caught:
        is_let_in("host:1", f"-ERR {said}".encode())
    assert type(caught.value) is kind
    assert str(caught.value).startswith("the broker host:1 rejects the ")
    assert text in str(caught.value)


# What the client answers


def test_a_key_signs_the_nonce_of_a_broker() -> None:
    credentials = NatsCredentials(SEED, "")
    fields = fields_of(FleetSettings("f"), credentials, nonce="once")
    assert fields["nkey"] == PUBLIC
    check_signature(PUBLIC, fields["sig"], b"once")
    with pytest.raises(InvalidSignature):
        check_signature(PUBLIC, fields["sig"], b"twice")
    assert SEED not in str(fields)
    assert SEED not in repr(credentials)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no key",
        SEED[:-1],
        SEED[:-1] + "A",
        SEED.lower(),
        "SU" + "1" * 56,
        ACCOUNT_SEED,
        "SU" + "\x00" * 56,
    ],
)
def test_a_file_without_the_key_of_a_user_is_one_sentence(tmp_path: Path, text: str) -> None:
    path = tmp_path / "my.creds"
    path.write_text(text)
    with pytest.raises(TransportError) as caught:
        NatsCredentials.read(str(path))
    assert str(caught.value) == (
        f"{path} is not a credentials file: it has no secret key of a user of NATS"
    )
    assert caught.value.__cause__ is None


def test_a_key_is_not_used_at_a_broker_without_a_nonce() -> None:
    assert set(fields_of(FleetSettings("f"), NatsCredentials(SEED, ""))) == {"no_responders"}
