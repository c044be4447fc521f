"""`type`: the type of an action, in the output of `ros2 action`."""

from __future__ import annotations

from fibaction.cli.process.exit_codes import ExitCode
from tests.cli.conftest import Invoke


def test_a_type_that_the_server_does_not_say(invoke: Invoke, tcp: str) -> None:
    assert invoke("type", "wait", url=tcp).output == "arm/action/Wait\n"
    assert invoke("type", "/words", "--json", url=tcp).output == '{"name":"words","type":""}\n'
    result = invoke("type", "words", url=tcp)

    assert result.exit_code == ExitCode.ABORTED
    assert result.stderr == "Error: the server of /words does not say its type\n"
