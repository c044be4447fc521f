"""Small deliberate mistakes that only hostile clients can use: see `faults`."""

from __future__ import annotations

from typing import Any

from fibaction._runtime import text as text_module
from fibaction.border.byte_budgets import ByteBudget
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.feeds.status_broadcast import StatusBroadcast, StatusCursor
from fibaction.wire.auth import AccessPolicy, Peer, Permission
from fibaction.wire.frames import MAX_FRAME, FrameReader
from fibaction.wire.link import Heartbeat
from fibaction.wire.messages import FromClient, Hello
from fibaction.wire.server.session import Session
from fibaction.wire.server.session_client import SessionClient
from fibaction.wire.server.session_goals import SessionGoals
from fibaction.wire.settings import Limits
from fibaction.words.goals import digest_of
from tests.simulation.faults import mistake


@mistake(Session, "_admits", 31, 35, 43)
def a_limit_is_not_told(real: Any, self: Session, message: Any, limit: str) -> Any:
    """Do not answer a request that is over a limit."""
    return not limit and real(self, message, limit)


@mistake(AccessPolicy, "permits", 100, 97, 38)
async def everything_is_permitted(_real: Any, self: AccessPolicy, *_: Any) -> Any:
    """Do not ask whether a client has a permission."""
    return True


@mistake(AccessPolicy, "permits", 97, 116, 210)
async def a_client_that_may_send_may_observe(
    real: Any, self: AccessPolicy, peer: Peer, action: str, what: Permission
) -> Any:
    """Confuse two permissions."""
    if what is Permission.OBSERVE:
        what = Permission.SEND
    return await real(self, peer, action, what)


@mistake(AccessPolicy, "admit", 42, 67, 106)
def a_wrong_token_is_accepted(real: Any, self: AccessPolicy, address: str, token: str) -> Any:
    """Let in a client whose token is not known."""
    return real(self, address, token) or Peer(address)


@mistake(SessionClient, "greet", 43, 18, 92)
def a_session_is_not_bound_to_its_token(real: Any, self: SessionClient, message: FromClient) -> Any:
    """Take the session of a client for its own, whatever its token is."""
    hello: Hello = real(self, message)
    self.session = self.session and digest_of(hello.session)
    return hello


@mistake(SessionGoals, "limit_for", 27, 24, 35)
def goals_have_no_limit(_real: Any, self: SessionGoals, message: Any) -> Any:
    """Follow goals without a limit."""
    return ""


@mistake(FrameReader, "__init__", 2, 9, 22)
def the_first_message_has_no_limit_of_its_own(
    real: Any,
    self: FrameReader,
    limit: int = MAX_FRAME,
    *,
    first: int | None = None,
    budget: ByteBudget | None = None,
) -> Any:
    """Read as much of a client that is unknown as of one that is known."""
    real(self, limit, budget=budget)


@mistake(FeedbackLog, "follow", 18, 24, 92)
def every_follower_holds(
    real: Any, self: FeedbackLog[Any], *, feedback: bool = True, **rest: Any
) -> Any:
    """Let an executor wait for all that follow its goal."""
    return real(self, feedback=feedback, **(rest | {"own": True}))


@mistake(text_module, "with_escapes", 12, 60, 67)
def a_line_of_the_log_is_as_the_client_wrote_it(_real: Any, text: str, _escaped: Any) -> Any:
    """Do not clean the texts of clients before they are logged."""
    return text


@mistake(StatusBroadcast, "leave", 6, 8, 10)
def a_follower_of_statuses_is_never_forgotten(
    _real: Any, self: StatusBroadcast, cursor: StatusCursor
) -> Any:
    """Keep the entry of a stream that was closed."""


@mistake(Heartbeat, "agree", 256, 63, 55)
def a_client_decides_when_it_counts_as_dead(
    real: Any, self: Heartbeat, peer_interval: float, *rest: float
) -> Any:
    """Wait for a client as long as it likes."""
    real(self, 3600.0 if peer_interval == Limits().heartbeat else peer_interval, *rest)


@mistake(ByteBudget, "give_back", 6, 14, 20)
def a_counter_of_bytes_only_grows(_real: Any, self: ByteBudget, size: int) -> Any:
    """Count the bytes of goals that wait, and never give them back."""
