"""What cannot be done is one sentence at each verb: on stderr, with an exit code that tells why."""

from __future__ import annotations

import inspect
import shlex
from pathlib import Path
from string import Template

import pytest

from fibaction.cli.arguments.options import URL
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import overview
from fibaction_transports.tcp import TcpTransport
from tests.cli.conftest import Invoke
from tests.cli.test_top import sys_with_terminals

FILES = Path(__file__).parent.parent / "action_files"
TOO_LATE = "--watch shows all goals: leave out the options that choose or"

WRONG = {
    # The group
    "send_gaol": "Did you mean 'send_goal'?",
    "-c robot1 -u tcp://b list": "the server is given twice: by --connection and by --url",
    "-u 127.0.0.1:7400 list": "URL: write it like tcp://",
    "-u nonsense://x list": "no transport for nonsense:// is installed",
    "-u tcp://127.0.0.1:port list": "port",
    "-u tcp://127.0.0.1:7400?nonsense=1 list": "nonsense",
    # Goals
    "send_goal fibonacci 'order: x'": 'goal.order must be a whole number, not "x"',
    "send_goal fibonacci": "goal.order is missing",
    "send_goal fibonacci arduinobot_msgs/Fibonacci": "goal.order is missing",
    "send_goal fibonacci arduinobot_msgs.action.Fibonacci": "goal.order is missing",
    "send_goal fibonacci arduinobot_msgs::action::Fibonacci": "goal.order is missing",
    "send_goal fibonacci /arduinobot_msgs/action/Fibonacci": "goal.order is missing",
    "send_goal fibonacci /arduinobot_msgs/action/Fibonacci ''": "goal.order is missing",
    "send_goal fibonacci Fibonacci ''": "goal.order is missing",
    "send_goal fibonacci arduinobot_msgs.Fibonacci ''": "goal.order is missing",
    "send_goal fibonacci x/action/Y 'order: 1'": "is of the type arduinobot_msgs/action/Fibonacci,",
    "send_goal fibonacci 'order: 99999999999999999999'": "the goal cannot be encoded: ",
    "send_goal fibonacci a/action/B 'order: 1' more": "or write each field as FIELD=VALUE",
    "send_goal fibonacci order=1 order=2": "the field order is given twice",
    "send_goal fibonacci order=1 order.a=2": "the field order.a is given twice",
    "send_goal fibonacci order:=[1": "the goal is not valid YAML (line 1, column ",
    "send_goal fibonacci ordr=1": 'goal has no field "ordr"; did you mean order?',
    "send_goal fibonacci 'order: 1' --stdin": "the goal is given twice",
    "send_goal fibonacci --goal-file /nowhere": "/nowhere: No such file",
    "send_goal fibonacci 'order: 1' --detach -f": "--detach does not wait for feedback",
    "send_goal fibonacci 'order: 1' -t 0": "0 is not in the range",
    "send_goal fibonacci 'order: 1' -t nan": "'nan' is not a number",
    "cancel": "no goal is named: give a GOAL_ID, --all or --before STAMP",
    "cancel wait aa --all": "there is more than NAME and GOAL_ID",
    "cancel wait aa bb": "there is more than NAME and GOAL_ID",
    "cancel --all --before 1": "--all and --before cannot be combined",
    "cancel --before 0": "a stamp of 0 means all goals",
    "cancel --before soon": "'soon' is not a time: it is as in 2026-01-31T12:00:00Z, or 10m",
    "cancel wait": "unlike 'wait'; --all means all",
    "cancel dddd": "there is no goal dddd at any server",
    f"cancel wait {'01' * 16}": f"goal {'01' * 16} is unknown",
    "goals --since soon": "'soon' is not a time: it is as in 2026-01-31T12:00:00Z, or 10m for",
    "goals --since 1m --until 1h": "--since is later than --until: no goal is between",
    "goals --sort size": "'size' is not one of 'accepted', 'began', 'ended', 'waited', 'ran'",
    "goals --label order": "'order' is not a label: it is KEY=VALUE, as in order=17",
    "goals --label parent=17": "'parent' is not the key of a label: it has a meaning of its",
    "goals --json --csv": "--json and --csv cannot be combined",
    "goals --watch --past": TOO_LATE,
    "goals --watch --since 1m": TOO_LATE,
    "goals --watch --csv": "--watch prints no CSV: use --json",
    "goals --watch wait stubborn": "--watch shows one action, or all: give one NAME or",
    "goals --watch --store goals.db": "--store lists what is in the file now: leave out --watch",
    "echo wait --csv --json": "--json and --csv cannot be combined",
    "pause": "name the actions, or give --all for all of them",
    "pause fibonacci --all": "name the actions, or give --all for all of them",
    "resume": "name the actions, or give --all for all of them",
    "resume fibonacci --all": "name the actions, or give --all for all of them",
    # Servers
    "serve robot:make tcp://0.0.0.0:0": "append ?insecure=true to the URL",
    "serve robot:make unix://a robot:count": "write a list of the servers in the module",
    "serve robot:make --sync normal": "--sync is a setting of --store FILE",
    "serve robot:make --history 7": "--history is a setting of --store FILE; in",
    "serve robot:make unix://$FOLDER/a --metrics here": "an address for metrics is like 127.0.0.1:",
    "serve robot:make unix://$FOLDER/a --record no/a": "cannot record to $FOLDER/no/a: No such",
    "serve robot:server inproc://robot": "inproc://robot is for clients in the process of the",
    "-u inproc://robot serve robot:server": "inproc://robot is for clients in the process of the",
    "serve robot:server inproc://one inproc://two --reload": "inproc://one is for clients in the",
    "serve robt:server --reload": "there is no module 'robt'; did you mean robot?",
    "serve sys:server --reload": "the module 'sys' has no folder that could change",
    "serve robot --reload": "'robot' is not written as module:server; did you mean robot:server?",
    "bridge a://b a://b": "FROM_URL and TO_URL are the same: a bridge needs two",
    "bridge a=tcp://x b=tcp://y unix:///never count": "are for a bridge with one FROM_URL",
    "bridge a=$NOBODY b=$NOBODY nats://127.0.0.1:1/a?worker=b": "to it has one FROM_URL",
    "bridge morse:// unix:///never": "no transport for morse://",
    "bridge tcp://x inproc://robot": "inproc://robot is for clients in the process",
    "bridge inproc://robot tcp://x wait": "inproc://robot is for clients in the process",
    "bridge tcp://x unix:///never --rename pick": "a rename is like OLD=NEW, for example",
    "bridge tcp://x unix:///never --rename pick=2x": "a rename is like OLD=NEW, for example",
    "bridge tcp://x unix:///never --rename =x": "a rename is like OLD=NEW, for example",
    "bridge tcp://x unix:///never --rename a=b --rename /a=c": "the action /a is renamed twice",
    "bridge tcp://x unix:///never --into 2x": "a namespace is like /robot1",
    "bridge tcp://x unix:///never pick --rename a=b": "/a is renamed, and is not among those to",
    "bridge tcp://x unix:///never pick wait --rename pick=wait": "both be served as /wait: give",
    "bridge $TCP unix:///never --rename fibonacci=wait": "/fibonacci and /wait cannot both be",
    "console a=tcp://x a=tcp://y": "two servers have the name a: give one another name",
    "console a=tcp://x today.jsonl": "today.jsonl is not a URL, nor NAME=URL",
    "console a=tcp://x inproc://x": "inproc://x",
    "console inproc://robot": "inproc://robot is for clients in the process",
    "console today.jsonl": "cannot be read: No such file or directory; name a file, or a URL as in",
    "console robot.py": "is not a recording of fibaction, or is empty",
    "mcp $TCP --http 0.0.0.0:0": "use mcp+https://, or",
    "mcp $TCP --http no.invalid:0": "use mcp+https",
    "mcp $TCP --http 8090": "--http is like :8090 or 127.0.0.1:8090, not '8090'",
    "mcp $TCP --cert a.pem": "are settings of --http",
    "mcp $TCP --allow ''": "cannot be empty",
    "mcp $TCP --patience 0": "0.0 is not in the range",
    "mcp robot": "'robot' is not a URL, nor NAME=URL",
    "mcp tcp://h:1?token=s3cret tcp://h:2": "need names, which become part of the tools: left=tcp:",
    "mcp a=tcp://h:1 a=tcp://h:2": "two servers have the name a",
    "mcp inproc://robot": "inproc://robot is for clients in the process",
    # Others
    "ping inproc://x": "inproc://x is for clients in the process",
    "record inproc://robot a.jsonl": "inproc://robot is for clients in the process",
    "show robot.py": "robot.py is not a recording of fibaction, or is empty",
    "replay robot.py": "robot.py ",
    "export robot.py a.mcap": "robot.py has no servers: is it a recording of fibaction?",
    "store given_up tcp://a?token=s3cret": "tcp://a is one server: give the file of its",
    "store rerun goals.db x": "unlike 'x'",
    "topic list -u tcp://127.0.0.1:1": "has actions only: topics, services and parameters are at",
    "workers -u tcp://a": "tcp://a is one server, and not a fleet with workers: give the URL of a",
    "gen": "give one FILE, or --from-robot",
    "gen $FILES/plain/Count.action a.action": "give one FILE, or --from-robot",
    "gen $FILES/plain/Count.action": ":8: expected 'other_msgs/Gripper' on the search path",
    "gen Missing.action": "Missing.action: No such file or directory",
    "gen $FILES/robot_msgs/action/PickUp.action -o /nowhere/a.py": "/nowhere/a.py: No such file",
    "gen $FILES/plain/Count.action -s $FILES -n '2 much'": "an action's name is like `arm/pick_up`",
    "gen $FILES/plain/Count.action -s nowhere": "Directory 'nowhere' does not exist",
    "gen a.srv --ts": "--ts, --name and --type are for .action files",
    "gen my_msgs/msg/No": "my_msgs/msg/No",
    "gen Missing.msg": "Missing.msg: No such file or directory",
    "gen --ts no.action": "no.action: No such file or directory",
    "gen --ts no:server": "there is no module 'no' in ",
    "gen --ts robot:server -n a": "--name, --type and --search are for .action files",
    "gen --ts robot:server -o /nowhere/a.ts": "/nowhere/a.ts: No such file",
    "gen --from-robot --ts": "--ts, --name, --type and --search are not for --from-robot",
    "gen --from-robot -s .": "name the folders of interface files in FIBACTION_SEARCH",
    "gen --from-robot -u inproc://a": "inproc://a is for clients in the process of the",
}
"""Lines after `fibaction` that nothing can be made of, each with the sentence, or parts of it."""

UNREACHABLE = {
    "-u unix:///nowhere/socket list": "/nowhere/socket",
    "bridge $NOBODY unix:///never": "start the server, or name the actions to wait for",
    "bridge $TCP unix:///never --rename fibonaci=x": "/fibonaci is not served; did you mean /fib",
    "console $NOBODY": "no server listens at $NOBODY ",
    "gen --ts tcp://127.0.0.1:1": "no server listens at tcp://127.0.0.1:1 ",
    "store rerun tcp://127.0.0.1:1 91c7": "no server listens at tcp://127.0.0.1:1 ",
}
"""Lines that name a server or an action that is not there."""

STORE = {
    "goals --store none.db": "cannot read the goals in none.db: there is no such file",
    "goals --store robot.py": ": it is not a store of goals; use another file",
    "serve robot:make unix://$FOLDER/a --store no/a.db": "is no folder $FOLDER/no; make it first",
    "store backup none.db": "cannot back up the goals in none.db: there is no such file",
    "store backup no/none.db": "cannot back up the goals in no/none.db: there is no such file",
    "store backup robot.py a.db": ": it is not a store of goals; use another file",
    "store backup .": "cannot back up the goals in .: it is not a file",
    "store rerun none.db 91c7": "there is no such file",
}
"""Lines that name a file that keeps no goals."""

REACHING = [
    *("list", "info x", "type x", "find x", "send_goal x", "goals", "goals -w", "cancel --all"),
    *("attach 5f", "echo x"),
]
"""Verbs that connect to a server, but for `top`, which needs a terminal."""
NAMING = [
    *("type {}", "send_goal {}", "goals {}", "goals -w {}", "info {}", "echo {}"),
    *("cancel --all {}", "cancel {} aa", "attach aa {}"),
]
"""Verbs that take the name of an action."""
WITH_NAMESPACE = [
    *("list", "goals", "goals -w", "top", "bridge $TCP unix:///never", "attach 12ab"),
    *("cancel 12ab", "cancel --all"),
]
"""Verbs that take a namespace."""
NOBODY = "no server listens at $NOBODY ... or name another with --url or FIBACTION_URL"
INPROC = "inproc://robot is for clients in the process of the server: between processes, use tcp"
NO_NAMESPACE = "a namespace is like /robot1 or /robot1/arm, unlike '/robot 1'"
NEAR = "there is no action in the namespace /amr; did you mean /arm?"

WRONG |= {f"-u inproc://robot {verb}": INPROC for verb in (*REACHING, "top")}
WRONG |= {f"{verb} --url inproc://robot": INPROC for verb in (*REACHING, "top")}
WRONG |= {f"{verb} -n '/robot 1'": NO_NAMESPACE for verb in WITH_NAMESPACE}
UNREACHABLE |= {f"{verb} -u $NOBODY": NOBODY for verb in REACHING}
UNREACHABLE |= {verb.format("fibonaci"): "/fibonaci is not served; did you" for verb in NAMING}
UNREACHABLE |= {f"{verb} -n /amr": NEAR for verb in WITH_NAMESPACE}
UNREACHABLE |= {f"{verb} --namespace=/amr": NEAR for verb in WITH_NAMESPACE}
ALL = {
    ExitCode.USAGE: WRONG,
    ExitCode.UNREACHABLE: UNREACHABLE,
    ExitCode.STORE: STORE,
}


@pytest.fixture(autouse=True)
def in_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """`top` finds a terminal, which it does not come to use."""
    monkeypatch.setattr(overview, "sys", sys_with_terminals())


def test_the_url_is_that_of_the_verb_or_of_the_group_or_of_the_environment(
    invoke: Invoke, tcp: str, nobody: str
) -> None:
    assert invoke("list", "-c", url=tcp).output == "6\n"
    assert invoke("-u", tcp, "list", "-c", url=nobody).output == "6\n"
    assert invoke("-u", nobody, "list", "-c", "--url", tcp).output == "6\n"


def test_without_a_url_it_is_the_default_of_the_tcp_transport(invoke: Invoke) -> None:
    settings = inspect.signature(TcpTransport).parameters

    assert f"tcp://{settings['host'].default}:{settings['port'].default}" == URL
    assert f"default: {URL}" in " ".join(invoke("--help").output.split())


@pytest.mark.parametrize(
    ("line", "text", "code"),
    [(line, text, code) for code, lines in ALL.items() for line, text in lines.items()],
)
def test_what_cannot_be_done_is_one_sentence(
    folder: Path, invoke: Invoke, tcp: str, nobody: str, line: str, text: str, code: ExitCode
) -> None:
    places = {"TCP": tcp, "NOBODY": nobody, "FOLDER": str(folder), "FILES": str(FILES)}
    words = shlex.split(Template(line).substitute(places))
    result = invoke(*words, url=tcp, env={"AMENT_PREFIX_PATH": None})

    assert (result.exit_code, result.stdout) == (code, "")
    *usage, last = result.stderr.splitlines()
    assert last.startswith("Error: ")
    assert all(part in last for part in Template(text).substitute(places).split(" ... "))
    assert not usage or usage[0].startswith("Usage: fibaction ")
    assert "s3cret" not in last
    assert "Python" not in last
    assert {path.name for path in folder.iterdir()} <= {"robot.py", "__pycache__"}
