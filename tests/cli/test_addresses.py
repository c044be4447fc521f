"""Named addresses, from the configuration file."""

from __future__ import annotations

from pathlib import Path

import pytest

from fibaction.cli.arguments.options import address_of, addresses, config_file
from fibaction.cli.process.exit_codes import ExitCode, Failure
from tests.cli.conftest import Invoke


@pytest.fixture
def config(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The configuration file, which is not there yet."""
    monkeypatch.setenv("FIBACTION_CONFIG", str(tmp_path / "config.toml"))
    return tmp_path / "config.toml"


def test_a_server_is_reached_by_its_name(
    config: Path, invoke: Invoke, tcp: str, nobody: str
) -> None:
    config.write_text(f'[addresses]\nrobot1 = "{tcp}"\n')

    assert invoke("-c", "robot1", "list", "-c", url=nobody).output == "6\n"
    assert invoke("--connection", "robot1", "list", "-c", url=None).output == "6\n"
    assert invoke("-c", "robot2", "list", "-c", "-u", tcp, url=None).output == "6\n"


def test_an_unknown_name_is_one_sentence(config: Path, invoke: Invoke) -> None:
    result = invoke("-c", "robot1", "list")

    assert result.exit_code == ExitCode.USAGE
    assert result.stderr == (
        f"Error: {config} has no address 'robot1': write it below [addresses] as"
        ' robot1 = "tcp://robot1:7400"\n'
    )
    config.write_text('[addresses]\nrobot1 = "tcp://a"\narm = "tcp://b"\n')
    with pytest.raises(Failure, match="has no address 'robt1'; did you mean robot1"):
        address_of("robt1")
    with pytest.raises(Failure, match=r"has no address 'x'; it has arm, robot1$"):
        address_of("x")


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"robot1 =", "is not TOML: "),
        (b"\xff", "is not TOML: "),
        (b"a = " + b"[" * 9_999, "is nested too deeply"),
        (b"addresses = 3", 'has a URL for each name, such as robot = "tcp://robot:7400"'),
        (b"[addresses]\nrobot1 = 3", "has a URL for each name"),
    ],
)
def test_a_file_of_another_form_is_one_sentence(config: Path, content: bytes, text: str) -> None:
    config.write_bytes(content)
    with pytest.raises(Failure) as caught:
        addresses()
    assert caught.value.message.startswith(str(config))
    assert text in caught.value.message


def test_a_file_that_cannot_be_read_is_one_sentence(config: Path) -> None:
    config.mkdir()
    with pytest.raises(Failure, match=r": Is a directory$"):
        addresses()


def test_the_file_is_where_other_programs_have_theirs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("FIBACTION_CONFIG", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert config_file() == tmp_path / "fibaction" / "config.toml"
    assert addresses() == {}
    monkeypatch.delenv("XDG_CONFIG_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert config_file() == tmp_path / ".config" / "fibaction" / "config.toml"
