"""`fibaction.border.http_access`: which requests are let in."""

from __future__ import annotations

import socket

import pytest

from fibaction.border.http_access import HttpRules, Refused, bearer_in, headers_in, rules


def made(
    *, hosts: tuple[str, ...] = (), origins: tuple[str, ...] = (), has_tls: bool = False
) -> HttpRules:
    return rules("Robot", "/", hosts=hosts, origins=origins, has_tls=has_tls)


def status(found: HttpRules, host: str, origin: str | None = None, target: str = "/") -> int:
    headers = {"host": host} | ({} if origin is None else {"origin": origin})
    try:
        found.check(target, headers)
    except Refused as exc:
        return exc.status
    return 101


@pytest.mark.parametrize(
    "host",
    [
        "robot",
        "ROBOT:8080",
        "localhost:8080",
        "127.0.0.1:8080",
        "192.168.1.7",
        "[::1]:8080",
        socket.gethostname(),
        f"{socket.gethostname()}.local:80",
    ],
)
def test_addresses_and_names_of_the_machine_are_its_own(host: str) -> None:
    assert status(made(), host) == 101


@pytest.mark.parametrize("host", ["evil.example", "robot.evil.example", "", "[", "127.0.0.1.evil"])
def test_another_host_is_misdirected_unless_it_is_named_or_the_certificate_shows_it(
    host: str,
) -> None:
    assert status(made(), host) == 421
    assert status(made(hosts=("*",)), host) == (421 if host == "[" else 101)
    assert status(made(hosts=("Evil.example",)), "evil.example:80") == 101
    assert status(made(has_tls=True), "evil.example") == 101


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        (None, 101),
        ("http://robot:8080", 101),
        ("https://ROBOT:8080", 101),
        ("http://robot", 403),
        ("http://robot:9090", 403),
        ("http://evil.example", 403),
        ("http://evil.example#http://robot:8080", 403),
        ("null", 403),
        ("", 403),
    ],
)
def test_only_pages_of_the_address_served_may_use_it(origin: str | None, expected: int) -> None:
    assert status(made(), "robot:8080", origin) == expected


def test_a_page_that_came_without_tls_may_not_use_a_server_that_speaks_it() -> None:
    found = made(has_tls=True)
    assert status(found, "robot:8443", "https://robot:8443") == 101
    assert status(found, "robot:8443", "http://robot:8443") == 403
    named = made(origins=("http://robot:8443",), has_tls=True)
    assert status(named, "robot:8443", "http://robot:8443") == 101


def test_other_pages_may_be_named() -> None:
    named = made(origins=("https://Console.example", "null"))
    assert status(named, "robot", "https://console.example") == 101
    assert status(named, "robot", "null") == 101
    assert status(named, "robot", "http://console.example") == 403
    assert status(made(origins=("*",)), "robot", "http://evil.example") == 101


@pytest.mark.parametrize("target", ["/other", "//", "/../", "*", "http://robot/"])
def test_another_path_does_not_exist(target: str) -> None:
    assert status(made(), "robot", target=target) == 404


def test_what_is_behind_a_question_mark_does_not_matter() -> None:
    assert status(made(), "robot", target="/?token=x") == 101


# Headers, and the token in them


def test_a_header_that_comes_twice_has_both_values_so_a_second_host_fits_no_rule() -> None:
    headers = headers_in([(b"Host", b"localhost"), (b"ACCEPT", b"a"), (b"host", b"evil.example")])
    assert headers == {"host": "localhost, evil.example", "accept": "a"}
    with pytest.raises(Refused):
        made().check("/", headers)


@pytest.mark.parametrize(
    ("value", "token"),
    [
        ("Bearer s3cret", "s3cret"),
        ("bearer  s3cret ", "s3cret"),
        ("Bearer s\xc3\xa9cret", "s\xe9cret"),  # UTF-8, which HTTP reads as Latin-1
        ("Bearer \xe9", "\ufffd"),
        ("Basic s3cret", ""),
        ("Bearer", ""),
        ("", ""),
    ],
)
def test_the_token_is_what_follows_bearer(value: str, token: str) -> None:
    assert bearer_in({"authorization": value}) == token
    assert bearer_in({}) == ""
