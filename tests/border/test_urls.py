from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractAsyncContextManager
from importlib.metadata import Distribution, EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import pytest

from fibaction.border.abc import Connection, Endpoint, Transport
from fibaction.border.urls import (
    GROUP,
    check_settings,
    transport_class,
    transport_for,
    without_settings,
)
from fibaction.words.errors import TransportError
from tests.support.fibonacci import FIBONACCI


class PigeonTransport(Transport):
    """What a third party might bring; it keeps the URL that it was made from."""

    def __init__(self, url: str = "", speed: int = 0) -> None:
        self.url = url
        self.speed = speed

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> PigeonTransport:
        return cls(url, **settings)

    def serve(self, *endpoints: Endpoint) -> AbstractAsyncContextManager[str]:
        raise NotImplementedError

    def connect(self) -> AbstractAsyncContextManager[Connection]:
        raise NotImplementedError


HERE = f"{__name__}:PigeonTransport"
Install = Callable[[EntryPoints], None]


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Makes these the entry points of all packages that are installed."""
    transport_class.cache_clear()

    def install(installed: EntryPoints) -> None:
        def entry_points(**wanted: Any) -> EntryPoints:
            return installed.select(**wanted)

        monkeypatch.setattr("importlib.metadata.entry_points", entry_points)

    yield install
    transport_class.cache_clear()


def entry(name: str, value: str, group: str = GROUP) -> EntryPoint:
    return EntryPoint(name=name, value=value, group=group)


def package(folder: Path, name: str, entry_points: str) -> EntryPoints:
    """The entry points of a package as if it were installed in a folder."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)
    (installed,) = Distribution.discover(path=[str(folder)])
    return EntryPoints(installed.entry_points)


def test_a_transport_that_is_installed_later_is_found_and_then_kept(install: Install) -> None:
    install(EntryPoints())
    with pytest.raises(TransportError, match="no transport for pigeon://"):
        transport_for("pigeon://loft")
    install(EntryPoints([entry("pigeon", HERE)]))
    assert isinstance(transport_for("pigeon://loft"), PigeonTransport)
    install(EntryPoints())
    assert isinstance(transport_for("pigeon://loft"), PigeonTransport)


def test_an_unknown_scheme_is_rejected_and_the_known_ones_are_told(install: Install) -> None:
    install(EntryPoints([entry("pigeon", HERE), entry("crow", HERE), entry("crow", HERE)]))
    with pytest.raises(TransportError) as caught:
        transport_for("raven://tower")
    assert str(caught.value) == (
        "no transport for raven:// is installed; installed are crow://, pigeon://"
    )
    with pytest.raises(TransportError, match=r"did you mean crow://\? Installed are crow://, pig"):
        transport_for("corw://tower")


@pytest.mark.parametrize("text", ["", "127.0.0.1:7400", "pigeon:loft", "pigeon:/loft"])
def test_text_without_a_scheme_is_no_url(install: Install, text: str) -> None:
    install(EntryPoints([entry("pigeon", HERE)]))
    with pytest.raises(TransportError) as caught:
        transport_for(text)
    assert str(caught.value) == f"{text!r} is not a URL: write it like tcp://127.0.0.1:7400"


def test_a_missing_module_is_named_with_the_package_that_needs_it(
    install: Install, tmp_path: Path
) -> None:
    install(package(tmp_path, "pigeon-post", f"[{GROUP}]\npigeon = no_such_module.pigeon:Pigeon\n"))
    with pytest.raises(TransportError) as caught:
        transport_for("pigeon://loft")
    assert str(caught.value) == (
        "pigeon:// needs the module 'no_such_module', which is not installed: install it,"
        " or the extra of 'pigeon-post' that brings it"
    )
    assert isinstance(caught.value.__cause__, ModuleNotFoundError)


def test_a_missing_extra_is_named_with_the_scheme(
    install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pigeon_loft.py").write_text(
        "from fibaction.words.extras import NeedsExtra\n\n"
        "with NeedsExtra('pigeon_loft', 'pigeon-post[wings]'):\n    import no_such_wings\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    install(EntryPoints([entry("pigeon", "pigeon_loft:Pigeon")]))
    with pytest.raises(TransportError) as caught:
        transport_for("pigeon://loft")
    assert str(caught.value) == "pigeon:// needs no_such_wings: pip install 'pigeon-post[wings]'"


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("raise ImportError('pigeons fly on Linux only')", "pigeons fly on Linux only"),
        ("", "PigeonTransport"),
    ],
    ids=["refuses to be imported", "lacks the class"],
)
def test_a_module_that_is_installed_but_wrong_is_a_transport_error(
    install: Install, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, source: str, text: str
) -> None:
    name = f"wrong_pigeon_{len(source)}"  # because Python remembers what it has imported
    (tmp_path / f"{name}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    install(EntryPoints([entry("pigeon", f"{name}:PigeonTransport")]))
    with pytest.raises(TransportError, match=text):
        transport_for("pigeon://loft")


def test_what_a_transport_says_that_cannot_be_imported_is_not_changed(
    install: Install, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "pigeon_without_a_loft.py").write_text(
        "from fibaction import TransportError\nraise TransportError('build a loft first')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    install(EntryPoints([entry("pigeon", "pigeon_without_a_loft:PigeonTransport")]))
    with pytest.raises(TransportError, match=r"^build a loft first$"):
        transport_for("pigeon://loft")


def test_settings_go_to_the_transports_constructor(install: Install) -> None:
    install(EntryPoints([entry("pigeon", HERE)]))
    transport = transport_for("pigeon://loft", speed=3)
    assert isinstance(transport, PigeonTransport)
    assert (transport.url, transport.speed) == ("pigeon://loft", 3)
    with pytest.raises(TypeError, match="colour"):
        transport_for("pigeon://loft", colour="grey")


def test_a_transport_that_is_made_already_takes_no_settings() -> None:
    with pytest.raises(TypeError, match="speed: these belong into the transport's constructor"):
        transport_for(PigeonTransport(), speed=3)


@pytest.mark.parametrize("where", [FIBONACCI, None, Path("robot.sock"), b"tcp://robot"])
def test_what_is_neither_a_url_nor_a_transport_is_no_address(where: Any) -> None:
    with pytest.raises(TypeError) as caught:
        transport_for(where, speed=3)
    assert str(caught.value) == (
        f"an address is a URL such as 'tcp://127.0.0.1:7400', or a transport, and not {where!r}"
    )


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("tcp://robot:7400?token=secret&window=1", "tcp://robot:7400"),
        ("ros2://", "ros2://"),
        ("tcp://me:secret@robot:7400?window=1", "tcp://robot:7400"),
        ("tls://secret@robot", "tls://robot"),
        ("unix:///run/me@home.sock", "unix:///run/me@home.sock"),
        ("robot:7400?token=secret", "robot:7400"),
    ],
)
def test_a_url_is_shown_without_anything_secret(url: str, shown: str) -> None:
    assert without_settings(url) == shown


@pytest.mark.parametrize(
    ("name", "known", "sentence"),
    [
        (
            "hartbeat",
            ["heartbeat", "grace"],
            (
                "x has no setting 'hartbeat': did you mean 'heartbeat'?"
                " Its settings are heartbeat, grace"
            ),
        ),
        (
            "speed",
            ["heartbeat", "grace"],
            "x has no setting 'speed'; its settings are heartbeat, grace",
        ),
        ("speed", [], "x has no setting 'speed'; it has no settings"),
    ],
)
def test_a_setting_that_a_transport_does_not_have_is_told_with_those_it_has(
    name: str, known: list[str], sentence: str
) -> None:
    with pytest.raises(TypeError) as caught:
        check_settings("x", [*known, name], known)
    assert str(caught.value) == sentence
