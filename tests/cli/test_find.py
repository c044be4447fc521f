"""`find`: the actions of a type, in the output of `ros2 action`."""

from __future__ import annotations

from tests.cli.conftest import Invoke


def test_find_as_json_has_the_names_that_the_servers_gave(invoke: Invoke, tcp: str) -> None:
    assert invoke("find", "--json", "arm/action/Wait", url=tcp).output == (
        '{"name":"wait","type":"arm/action/Wait"}\n'
    )
    assert invoke("find", "-c", "arm/action/Wait", url=tcp).output == "1\n"
    for name in ("arm/action/Wait", "/arm/action/Wait", "arm/Wait", "Wait"):
        assert invoke("find", name, url=tcp).output == "/wait\n"


def test_an_unknown_type_has_no_actions_and_that_is_not_an_error(invoke: Invoke, tcp: str) -> None:
    result = invoke("find", "no/action/Such", url=tcp)

    assert (result.exit_code, result.output) == (0, "")
