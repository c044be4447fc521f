"""Every message of the protocol with its bytes, in the order of the tags.

The format is pinned by this table: `tests/wire/test_messages.py` checks the code against it.
"""

from __future__ import annotations

from fibaction.types.action import ActionInfo
from fibaction.wire.messages import (
    Actions,
    AskLog,
    AskPeers,
    AskPlaces,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Close,
    Credit,
    Done,
    Ended,
    Failed,
    Feedback,
    FeedbackBatch,
    Finished,
    Follow,
    Following,
    FromClient,
    FromServer,
    GoalChanged,
    Goodbye,
    Hello,
    ListActions,
    Logged,
    Operate,
    Operated,
    Peers,
    Ping,
    Places,
    Received,
    Rejected,
    Rerun,
    RunsAgain,
    SendGoal,
    StatusChanged,
    Watching,
    WatchStatus,
    Welcome,
    Why,
)
from fibaction.words.goals import GoalID
from fibaction.words.intake import IntakeMode, ScheduleInfo
from fibaction.words.statuses import GoalStatus

GOAL_ID = GoalID(bytes(range(16)))
STAMP = 1_700_000_000_000_000_000
PARENT = (bytes(range(16)), "pick")
GOAL = bytes.fromhex("81a56f726465720a")
"""`{"order": 10}` in msgpack, like all payloads."""
FEEDBACK = bytes.fromhex("81b07061727469616c5f73657175656e636593000101")
"""`{"partial_sequence": [0, 1, 1]}`."""
RESULT = bytes.fromhex("81a873657175656e63659400010102")
"""`{"sequence": [0, 1, 1, 2]}`."""
INFO = ActionInfo(
    "fibonacci",
    "example_interfaces/action/Fibonacci",
    goal={"type": "object"},
    feedback={"type": "object"},
    result={"type": "object"},
)

GOLDEN: list[tuple[FromClient | FromServer, str]] = [
    (
        Ping(),
        "9100",
    ),
    (
        Goodbye("the client has what it wanted"),
        "9301bd74686520636c69656e742068617320776861742069742077616e74656400",
    ),
    (
        Hello(1, 1.0, "secret", bytes(range(16, 32)), 65536, True),
        "971001cb3ff0000000000000a6736563726574c410101112131415161718191a1b1c1d1e1fce00010000c3",
    ),
    (
        SendGoal(1, "fibonacci", GOAL_ID, GOAL, 64, 5.0, {"traceparent": "00-0af7-b7ad-01"}, True),
        (
            "991101a96669626f6e61636369c410000102030405060708090a0b0c0d0e0fc40881a56f72646572"
            "0a40cb401400000000000081ab7472616365706172656e74af30302d306166372d623761642d3031"
            "c3"
        ),
    ),
    (
        Follow(2, "fibonacci", GOAL_ID, 3, True, 64, 2),
        "981202a96669626f6e61636369c410000102030405060708090a0b0c0d0e0f03c34002",
    ),
    (
        CancelGoals(3, "fibonacci", GOAL_ID, None),
        "951303a96669626f6e61636369c410000102030405060708090a0b0c0d0e0fc0",
    ),
    (
        WatchStatus(4, "fibonacci", 64),
        "971404a96669626f6e6163636940c0c0c0",
    ),
    (
        AwaitServer(5, "fibonacci"),
        "931505a96669626f6e61636369",
    ),
    (
        ListActions(6),
        "921606",
    ),
    (
        Credit(1, 32),
        "93170120",
    ),
    (
        Close(1),
        "921801",
    ),
    (
        Received(1),
        "921901",
    ),
    (
        AskPeers(7, "fibonacci"),
        "931a07a96669626f6e61636369",
    ),
    (
        AskPlaces(8, "fibonacci", 100),
        "941b08a96669626f6e6163636964",
    ),
    (
        Operate(9, "fibonacci", IntakeMode.HOLD, "swap", "ann"),
        "971c09a96669626f6e61636369a4686f6c64a473776170a3616e6ea0",
    ),
    (
        Rerun(10, "fibonacci", GOAL_ID),
        "941d0aa96669626f6e61636369c410000102030405060708090a0b0c0d0e0f",
    ),
    (
        AskLog(11, "fibonacci", GOAL_ID),
        "941e0ba96669626f6e61636369c410000102030405060708090a0b0c0d0e0f",
    ),
    (
        Welcome(1, 1.0, 65536, 15.0, 30, "7.8.9"),
        "972001cb3ff0000000000000ce00010000cb402e0000000000001ea5372e382e39",
    ),
    (
        Following(1, STAMP, GoalStatus.ABORTED, False, 0, 1, GOAL, PARENT, {"order": "17"}, RESULT),
        (
            "9b2101cf17979cfe362a000006c20001c40881a56f726465720a92c410000102030405060708090a"
            "0b0c0d0e0fa47069636b81a56f72646572a23137c40f81a873657175656e63659400010102"
        ),
    ),
    (
        Rejected(1, "the order is negative", 4),
        "942201b5746865206f72646572206973206e6567617469766504",
    ),
    (
        Failed(2, Why.SERVER_NOT_FOUND, "it is not served"),
        "94230202b06974206973206e6f7420736572766564",
    ),
    (
        Feedback(1, 1, FEEDBACK, STAMP),
        "95240101c41681b07061727469616c5f73657175656e636593000101cf17979cfe362a0000",
    ),
    (
        StatusChanged(1, GoalStatus.EXECUTING),
        "93250102",
    ),
    (
        Ended(1, GoalStatus.SUCCEEDED, RESULT, "", 9, STAMP + 5),
        "97260104c40f81a873657175656e63659400010102a009cf17979cfe362a0005",
    ),
    (
        CancelAnswered(3, 0, [(GOAL_ID, STAMP, GoalStatus.CANCELING)], ""),
        "952703009193c410000102030405060708090a0b0c0d0e0fcf17979cfe362a000003a0",
    ),
    (
        GoalChanged(4, GOAL_ID, STAMP, GoalStatus.ACCEPTED, 0, 0, "arm", 2, 5, 1, PARENT),
        (
            "dc00112804c410000102030405060708090a0b0c0d0e0fcf17979cfe362a0000010000a361726d02"
            "050192c410000102030405060708090a0b0c0d0e0fa47069636bc0c0a0c0a0"
        ),
    ),
    (
        Done(5),
        "922905",
    ),
    (
        Finished(4),
        "922a04",
    ),
    (
        Actions(6, [INFO]),
        (
            "932b069185a46e616d65a96669626f6e61636369a9747970655f6e616d65d9236578616d706c655f"
            "696e74657266616365732f616374696f6e2f4669626f6e61636369a4676f616c81a474797065a66f"
            "626a656374a8666565646261636b81a474797065a66f626a656374a6726573756c7481a474797065"
            "a66f626a656374"
        ),
    ),
    (
        Watching(4, 2),
        "932c0402",
    ),
    (
        Peers(7, ["10.0.0.7:51234"]),
        "932d0791ae31302e302e302e373a3531323334",
    ),
    (
        Places(8, [(GOAL_ID, 2, 5)]),
        "932e089193c410000102030405060708090a0b0c0d0e0f0205",
    ),
    (
        Operated(
            9,
            IntakeMode.HOLD,
            [(IntakeMode.HOLD, "swap", "ann", STAMP)],
            ScheduleInfo(concurrency=1, queue=9),
        ),
        (
            "962f09a4686f6c649194a4686f6c64a473776170a3616e6ecf17979cfe362a0000"
            "82ab636f6e63757272656e637901a5717565756509c3"
        ),
    ),
    (
        FeedbackBatch(1, 2, [FEEDBACK, FEEDBACK], [STAMP, STAMP + 5]),
        (
            "9530010292"
            "c41681b07061727469616c5f73657175656e636593000101"
            "c41681b07061727469616c5f73657175656e636593000101"
            "92cf17979cfe362a0000cf17979cfe362a0005"
        ),
    ),
    (
        RunsAgain(10, GOAL_ID),
        "93310ac410000102030405060708090a0b0c0d0e0f",
    ),
    (
        Logged(11, [(1_700_000_000_000_000_000, "INFO", "arm", "grips")]),
        "93320b9194cf17979cfe362a0000a4494e464fa361726da56772697073",
    ),
]
