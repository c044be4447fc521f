from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import anyio
import pytest
from hypothesis import given, strategies

from fibaction.wire.auth import TOKEN, AccessPolicy, Authorize, Peer, Permission, check_token

ADDRESS = "127.0.0.1:51234"
TOKENS = {"sesame": "ali", "réseau": "zoë", "longer than the others": "bob"}
ALI = Peer(ADDRESS, "ali")


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


# Who may come in


@pytest.mark.parametrize("token", ["", "sesame"])
def test_without_tokens_every_client_is_admitted_and_has_no_name(token: str) -> None:
    assert AccessPolicy().admit(ADDRESS, token) == Peer(ADDRESS, "")


@pytest.mark.parametrize(("token", "name"), TOKENS.items())
def test_a_good_token_lets_its_owner_in(token: str, name: str) -> None:
    assert AccessPolicy(TOKENS).admit(ADDRESS, token) == Peer(ADDRESS, name)


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


def test_a_token_may_belong_to_a_client_without_a_name() -> None:
    assert AccessPolicy({"sesame": ""}).admit(ADDRESS, "sesame") == Peer(ADDRESS)


def test_no_token_can_be_read_in_a_log() -> None:
    assert repr(AccessPolicy(TOKENS)) == str(AccessPolicy(TOKENS)) == "<AccessPolicy>"
    assert "sesame" not in repr(AccessPolicy(TOKENS).admit(ADDRESS, "sesame"))


# What he may do


@pytest.mark.anyio
@pytest.mark.parametrize("verb", Permission)
async def test_without_a_rule_everything_is_allowed(verb: Permission) -> None:
    assert await AccessPolicy(TOKENS).permits(ALI, "fibonacci", verb) is True


def may_only_observe(peer: Peer, action: str, verb: Permission) -> bool:
    return (peer, action, verb) == (ALI, "fibonacci", Permission.OBSERVE)


async def may_only_observe_says_another(peer: Peer, action: str, verb: Permission) -> bool:
    await anyio.lowlevel.checkpoint()
    return may_only_observe(peer, action, verb)


@pytest.mark.anyio
@pytest.mark.parametrize("authorize", [may_only_observe, may_only_observe_says_another])
@pytest.mark.parametrize(
    ("peer", "action", "verb", "allowed"),
    [
        (ALI, "fibonacci", Permission.OBSERVE, True),
        (ALI, "fibonacci", Permission.SEND, False),
        (ALI, "fibonacci", Permission.CANCEL, False),
        (ALI, "navigate", Permission.OBSERVE, False),
        (Peer(ADDRESS, "bob"), "fibonacci", Permission.OBSERVE, False),
    ],
)
async def test_a_rule_is_told_the_client_the_permission_and_the_action(
    authorize: Authorize, peer: Peer, action: str, verb: Permission, allowed: bool
) -> None:
    with anyio.fail_after(5):
        assert await AccessPolicy(authorize=authorize).permits(peer, action, verb) is allowed


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


@pytest.mark.anyio
async def test_the_error_of_a_rule_allows_nothing() -> None:
    def broken(peer: Peer, action: str, verb: Permission) -> bool:
        raise LookupError("no such table")

    with pytest.raises(LookupError, match="no such table"):
        await AccessPolicy(authorize=broken).permits(ALI, "fibonacci", Permission.SEND)


def test_a_policy_says_whether_it_asks_for_tokens() -> None:
    assert not AccessPolicy().asks_for_tokens
    assert AccessPolicy({"secret": "ann"}).asks_for_tokens


def test_only_without_a_rule_every_client_may_do_everything() -> None:
    assert AccessPolicy().is_open
    assert AccessPolicy({"secret": "ann"}).is_open  # for those who are in
    assert not AccessPolicy(authorize=lambda *_: True).is_open


def test_a_token_is_text() -> None:
    check_token("sésame")
    with pytest.raises(ValueError, match=r"^token is not valid text") as caught:
        check_token("secret \udcff")
    assert "secret" not in str(caught.value)


def test_a_token_fits_into_a_message() -> None:
    longest = "é" * (TOKEN // 2)
    check_token(longest)
    assert AccessPolicy({longest: "ann"}).admit(ADDRESS, longest) == Peer(ADDRESS, "ann")
    for wrong in (longest + "x", "x" * (TOKEN + 1)):
        with pytest.raises(ValueError, match=r"^token has 2049 bytes, and the most are 2048$"):
            check_token(wrong)
        with pytest.raises(ValueError, match="2049 bytes"):
            AccessPolicy({wrong: "ann"})
