"""A process from which is taken what Windows does not have, so that Linux can try it out.

    from tests.support.without_unix import take_away
    take_away()

It comes first in the process. What remains of Unix is what Python itself is built on: the selector
of the event loop, and the paths of files.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
from asyncio import unix_events  # noqa: TID251  # it is what is changed
from asyncio.selector_events import BaseSelectorEventLoop  # noqa: TID251  # as above
from contextlib import suppress
from types import ModuleType
from typing import Any, cast

from tests.support.hidden_modules import hide

MODULES = ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty", "uvloop")
OF_OS = (
    "fork",
    "forkpty",
    "getuid",
    "geteuid",
    "getgid",
    "getegid",
    "killpg",
    "getpgid",
    "setsid",
    "getloadavg",
    "openpty",
    "mkfifo",
    "chown",
    "fchmod",
)
OF_LOOP = (
    "add_signal_handler",
    "add_reader",
    "add_writer",
    "create_unix_connection",
    "create_unix_server",
)
OF_SIGNAL = (
    "SIGALRM",
    "SIGHUP",
    "SIGUSR1",
    "SIGUSR2",
    "SIGKILL",
    "SIGSTOP",
    "SIGCONT",
    "SIGQUIT",
    "SIGTSTP",
    "SIGWINCH",
    "SIGCHLD",
    "SIGPIPE",
    "setitimer",
    "getitimer",
    "ITIMER_REAL",
    "alarm",
    "pause",
    "pthread_kill",
    "pthread_sigmask",
    "sigwait",
)


def _not_there(*_: object) -> Any:
    raise NotImplementedError


def _run_forever(loop: Any) -> None:
    """Run as the event loop of Windows, which each signal wakes."""
    with suppress(ValueError):  # not in the main thread
        signal.set_wakeup_fd(loop._csock.fileno())
    try:
        BaseSelectorEventLoop.run_forever(loop)
    finally:
        with suppress(ValueError):
            signal.set_wakeup_fd(-1)


def _msvcrt(fcntl: ModuleType) -> ModuleType:
    """The module of Windows in place of `fcntl`."""
    module: Any = ModuleType("msvcrt")
    module.LK_NBLCK = 2
    module.locking = lambda file, _mode, _size: fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return cast("ModuleType", module)


def take_away() -> None:
    """Take away what Windows does not have."""
    import fcntl

    pair, family = socket.socketpair, socket.AF_UNIX
    socket.socketpair = lambda *_: pair(family)
    sys.modules["msvcrt"] = _msvcrt(fcntl)
    loop: Any = unix_events._UnixSelectorEventLoop
    for name in OF_LOOP:
        setattr(loop, name, _not_there)
    loop.run_forever = _run_forever
    late = [name for name in MODULES if name in sys.modules]
    for name in late:  # Python's own modules have imported it, and keep it
        del sys.modules[name]
    hide(*MODULES)
    for module, names in ((os, OF_OS), (signal, OF_SIGNAL), (socket, ("AF_UNIX",))):
        for name in names:
            if hasattr(module, name):
                delattr(module, name)
