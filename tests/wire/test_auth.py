from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import pytest
from hypothesis import given, strategies

from fibaction.wire.auth import TOKEN, AccessPolicy, Peer, Permission, check_token

ADDRESS = "127.0.0.1:51234"
TOKENS = {"sesame": "ali", "réseau": "zoë", "longer than the others": "bob"}
ALI = Peer(ADDRESS, "ali")


# Who may come in


@given(strategies.text() | strategies.sampled_from(["", "Sesame", "sesam", "sesame ", "ali"]))
def test_any_other_token_admits_no_client(token: str) -> None:
    assert (AccessPolicy(TOKENS).admit(ADDRESS, token) is None) == (token not in TOKENS)


@pytest.mark.parametrize("token", ["", "sesame", "longer than the others", "bad", "x" * 4000])
def test_a_token_costs_one_digest_and_one_look_up_and_time_tells_nothing(token: str) -> None:
    known = {f"token {number}": "ali" for number in range(1000)}
    policy = AccessPolicy({**TOKENS, **known})
    seen: list[bytes] = []

    class Names(dict[bytes, str]):
        def get(self, key: bytes, default: Any = None) -> Any:
            seen.append(key)
            return super().get(key, default)

    policy._names = Names(policy._names or {})
    policy.admit(ADDRESS, token)
    assert len(seen) == 1
    assert token.encode() not in seen[0] or not token
    other = AccessPolicy(TOKENS)
    other._names = Names(other._names or {})
    other.admit(ADDRESS, token)
    assert seen[0] != seen[1]  # nobody else can compute the digest


@pytest.mark.parametrize("tokens", [{}, {"": "ali"}, {"sesame": "ali", "": "bob"}])
def test_tokens_that_would_admit_no_client_or_every_client_are_rejected(
    tokens: Mapping[str, str],
) -> None:
    with pytest.raises(ValueError, match="at least one, and none empty"):
        AccessPolicy(tokens)


def test_a_token_that_no_client_could_send_is_rejected_and_not_shown() -> None:
    with pytest.raises(ValueError, match=r"^token is not valid text$") as caught:
        AccessPolicy({"sesame": "ali", "secret \udcff": "bob"})
    assert "secret" not in str(caught.value)
    assert caught.value.__suppress_context__


def test_no_token_can_be_read_in_a_log() -> None:
    assert repr(AccessPolicy(TOKENS)) == str(AccessPolicy(TOKENS)) == "<AccessPolicy>"
    assert "sesame" not in repr(AccessPolicy(TOKENS).admit(ADDRESS, "sesame"))


# What he may do


@pytest.mark.anyio
@pytest.mark.parametrize("answer", [None, 1, "no", [False]])
async def test_only_true_allows(answer: object) -> None:
    async def later(peer: Peer, action: str, verb: Permission) -> bool:
        return cast("bool", answer)

    def at_once(peer: Peer, action: str, verb: Permission) -> bool:
        return cast("bool", answer)

    for authorize in (at_once, later):
        assert (
            await AccessPolicy(authorize=authorize).permits(ALI, "fibonacci", Permission.SEND)
            is False
        )


def test_a_token_fits_into_a_message() -> None:
    longest = "é" * (TOKEN // 2)
    check_token(longest)
    assert AccessPolicy({longest: "ann"}).admit(ADDRESS, longest) == Peer(ADDRESS, "ann")
    for wrong in (longest + "x", "x" * (TOKEN + 1)):
        with pytest.raises(
            ValueError, match=r"^token has 2049 bytes, but at most 2048 are allowed$"
        ):
            check_token(wrong)
        with pytest.raises(ValueError, match="2049 bytes"):
            AccessPolicy({wrong: "ann"})
