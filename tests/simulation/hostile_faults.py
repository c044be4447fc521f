"""Small deliberate mistakes that only hostile clients can use: see `faults`."""

from __future__ import annotations

from typing import Any

from fibaction._runtime import text as text_module
from fibaction.border.byte_budgets import ByteBudget
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.feeds.status_broadcast import StatusBroadcast, StatusCursor
from fibaction.wire.auth import AccessPolicy, Peer, Permission
from fibaction.wire.codec import FromClient
from fibaction.wire.frames import MAX_FRAME, FrameReader
from fibaction.wire.heartbeat import Heartbeat
from fibaction.wire.messages import Hello
from fibaction.wire.server.session import Session
from fibaction.wire.server.session_client import SessionClient
from fibaction.wire.server.session_goals import SessionGoals
from fibaction.wire.settings import Limits
from fibaction.words.goals import digest_of
from tests.simulation.faults import mistake


@mistake(Session, "_admits", 31, 35, 43)
def a_limit_is_not_told(real: Any) -> Any:
    """Do not answer a request that is over a limit."""

    def _admits(self: Session, message: Any, limit: str) -> bool:
        return not limit and real(self, message, limit)

    return _admits


@mistake(AccessPolicy, "permits", 100, 97, 38)
def everything_is_permitted(_real: Any) -> Any:
    """Do not ask whether a client has a permission."""

    async def permits(self: AccessPolicy, *_: Any) -> bool:
        return True

    return permits


@mistake(AccessPolicy, "permits", 97, 116, 210)
def a_client_that_may_send_may_observe(real: Any) -> Any:
    """Confuse two permissions."""

    async def permits(self: AccessPolicy, peer: Peer, action: str, what: Permission) -> bool:
        if what is Permission.OBSERVE:
            what = Permission.SEND
        permitted: bool = await real(self, peer, action, what)
        return permitted

    return permits


@mistake(AccessPolicy, "admit", 42, 67, 106)
def a_wrong_token_is_accepted(real: Any) -> Any:
    """Let in a client whose token is not known."""

    def admit(self: AccessPolicy, address: str, token: str) -> Peer:
        return real(self, address, token) or Peer(address)

    return admit


@mistake(SessionClient, "greet", 43, 18, 92)
def a_session_is_not_bound_to_its_token(real: Any) -> Any:
    """Take the session of a client for its own, whatever its token is."""

    def greet(self: SessionClient, message: FromClient) -> Hello:
        hello: Hello = real(self, message)
        self.session = self.session and digest_of(hello.session)
        return hello

    return greet


@mistake(SessionGoals, "limit_for", 27, 24, 35)
def goals_have_no_limit(_real: Any) -> Any:
    """Follow goals without a limit."""

    def limit_for(self: SessionGoals, message: Any) -> str:
        return ""

    return limit_for


@mistake(FrameReader, "__init__", 2, 9, 22)
def the_first_message_has_no_limit_of_its_own(real: Any) -> Any:
    """Read as much of a client that is unknown as of one that is known."""

    def __init__(
        self: FrameReader,
        limit: int = MAX_FRAME,
        *,
        first: int | None = None,
        budget: ByteBudget | None = None,
    ) -> None:
        real(self, limit, budget=budget)

    return __init__


@mistake(FeedbackLog, "follow", 18, 24, 92)
def every_follower_holds(real: Any) -> Any:
    """Let an executor wait for all that follow its goal."""

    def follow(self: FeedbackLog[Any], *, feedback: bool = True, **rest: Any) -> Any:
        return real(self, feedback=feedback, **(rest | {"own": True}))

    return follow


@mistake(text_module, "with_escapes", 12, 60, 67)
def a_line_of_the_log_is_as_the_client_wrote_it(_real: Any) -> Any:
    """Do not clean the texts of clients before they are logged."""

    def with_escapes(text: str, _escaped: Any) -> str:
        return text

    return with_escapes


@mistake(StatusBroadcast, "leave", 6, 8, 10)
def a_follower_of_statuses_is_never_forgotten(_real: Any) -> Any:
    """Keep the entry of a stream that was closed."""

    def leave(self: StatusBroadcast, cursor: StatusCursor) -> None:
        pass

    return leave


@mistake(Heartbeat, "agree", 256, 63, 55)
def a_client_decides_when_it_counts_as_dead(real: Any) -> Any:
    """Wait for a client as long as it likes."""

    def agree(self: Heartbeat, peer_interval: float, *rest: float) -> None:
        real(self, 3600.0 if peer_interval == Limits().heartbeat else peer_interval, *rest)

    return agree


@mistake(ByteBudget, "give_back", 6, 14, 20)
def a_counter_of_bytes_only_grows(_real: Any) -> Any:
    """Count the bytes of goals that wait, and never give them back."""

    def give_back(self: ByteBudget, size: int) -> None:
        pass

    return give_back
