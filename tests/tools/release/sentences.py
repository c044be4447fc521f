"""The sentences of the pages about an installation, before and after the first release."""

from __future__ import annotations

from typing import NamedTuple


class Sentence(NamedTuple):
    """A passage of a page, before the first release and after it."""

    page: str
    before: str
    after: str


SENTENCES = [
    Sentence(
        "README.md",
        "fibaction is not published yet, so you install it from a clone, into a virtual"
        " environment:\n",
        "Install fibaction into a virtual environment:\n",
    ),
    Sentence(
        "README.md",
        "$ pip install '.[cli]'    # or '.' without the command line\n"
        "$ make demo               # watch Fibonacci goals over TCP: feedback, a cancel half-way, a"
        " result\n```\n",
        "$ pip install 'fibaction[cli]'    # or fibaction without the command line\n```\n\n"
        "In a clone of the repository, `make demo` shows Fibonacci goals over TCP: feedback, a"
        " cancel half-way, a result.\n",
    ),
    Sentence(
        "docs/installing.md",
        "fibaction is not published yet, so you install it from a clone, into a virtual"
        " environment:\n",
        "You install it into a virtual environment:\n",
    ),
    Sentence(
        "docs/installing.md",
        "$ pip install '.[cli]'    # or '.' without the command line\n",
        "$ pip install 'fibaction[cli]'    # or fibaction without the command line\n",
    ),
    Sentence(
        "docs/installing.md",
        "`pip install '.[cli,web]'`",
        "`pip install 'fibaction[cli,web]'`",
    ),
    Sentence(
        "README.md",
        "For example, start a server in one terminal:\n",
        "For example, start a server in one terminal, in a clone of the repository:\n",
    ),
    Sentence(
        "docs/index.md",
        "fibaction is not published yet, so you install it from a clone, in a virtual environment:"
        " `python3 -m venv .venv`, `. .venv/bin/activate`, and `pip install ~/fibaction` if your"
        " clone is in `~/fibaction`.\n",
        "Install it in a virtual environment: `python3 -m venv .venv`, `. .venv/bin/activate`, and"
        " `pip install fibaction`.\n",
    ),
    Sentence(
        "docs/first_action.md",
        "fibaction is not published yet, so you install it from a clone; this page assumes that"
        " your clone is in `~/fibaction`.\n",
        "Make a folder, and install fibaction in a virtual environment:\n",
    ),
    Sentence(
        "docs/first_action.md",
        '$ . .venv/bin/activate\n$ pip install "$HOME/fibaction[cli]"\n',
        '$ . .venv/bin/activate\n$ pip install "fibaction[cli]"\n',
    ),
    Sentence(
        "docs/first_action.md",
        '$ . .venv-with-ros/bin/activate\n$ pip install "$HOME/fibaction[cli]"\n',
        '$ . .venv-with-ros/bin/activate\n$ pip install "fibaction[cli]"\n',
    ),
    Sentence(
        "docs/first_action.md",
        "If you have no ROS, your clone can make an environment with ROS 2 from wheels,",
        "If you have no ROS, a clone of fibaction's repository, here in `~/fibaction`, can make an"
        " environment with ROS 2 from wheels,",
    ),
    Sentence(
        "docs/cli.md",
        '```console\n$ pip install "$HOME/fibaction[cli]"\n```\n\n'
        "fibaction is not published yet; this page assumes that you have cloned it to"
        " `~/fibaction`.\n"
        "The examples on this page talk to `python ~/fibaction/examples/fibonacci_server.py"
        " --period 0.2`.\n",
        '```console\n$ pip install "fibaction[cli]"\n```\n\n'
        "The examples on this page talk to `python ~/fibaction/examples/fibonacci_server.py"
        " --period 0.2`, with a clone of fibaction's repository in `~/fibaction`.\n",
    ),
    Sentence(
        "docs/cli.md",
        '$ pip install "$HOME/fibaction[tui]"\n',
        '$ pip install "fibaction[tui]"\n',
    ),
    Sentence(
        "docs/tutorial.md",
        "You need Python 3.11 or later, and fibaction from a clone.\n"
        "For example, if your clone is in `~/fibaction`, run `pip install ~/fibaction`.\n",
        "You need Python 3.11 or later, and fibaction: run `pip install fibaction`.\n",
    ),
    Sentence(
        "docs/howto/colcon.md",
        "It is not published yet, so you install it from a clone; this page assumes that your clone"
        " is in `~/fibaction`.\n",
        "This page takes its example from a clone of fibaction's repository in `~/fibaction`.\n",
    ),
    Sentence(
        "docs/howto/colcon.md",
        '$ python -m pip install "$HOME/fibaction[cli]"\n',
        '$ python -m pip install "fibaction[cli]"\n',
    ),
    Sentence(
        "docs/howto/colcon.md",
        "Once fibaction is published, give rosdep the rule of the repository:\n",
        "Give it the rule of the repository:\n",
    ),
    Sentence(
        "docs/howto/colcon.md",
        "With a virtual environment, and until then, leave fibaction out:",
        "With a virtual environment, leave fibaction out:",
    ),
    Sentence(
        "docs/howto/colcon.md",
        "COPY fibaction /fibaction\nRUN pip install --break-system-packages /fibaction\n",
        "RUN pip install --break-system-packages fibaction\n",
    ),
    Sentence(
        "docs/installing.md",
        "In PowerShell, from your clone:\n",
        "In PowerShell:\n",
    ),
    Sentence(
        "docs/installing.md",
        'PS> pip install ".[cli]"\n',
        'PS> pip install "fibaction[cli]"\n',
    ),
    Sentence(
        "docs/howto/fleet.md",
        "$ pip install '.[broker,cli]'\n",
        "$ pip install 'fibaction[broker,cli]'\n",
    ),
]


def pages() -> set[str]:
    """Return the pages that have such passages."""
    return {sentence.page for sentence in SENTENCES}


def published(page: str, text: str) -> str:
    """Return a page as it is after the first release; a page that is so already is left as it is.

    Raises:
        ValueError: A passage is in the page neither as it was nor as it will be.
    """
    for sentence in SENTENCES:
        if sentence.page != page:
            continue
        if text.count(sentence.before) == 1:
            text = text.replace(sentence.before, sentence.after)
        elif sentence.after not in text:
            first = sentence.before.splitlines()[0]
            raise ValueError(f"{page} has not this passage any more, or twice: {first}")
    return text
