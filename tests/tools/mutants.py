"""Mutation tests: a module gets one small fault at a time, and its tests must fail.

    python -m tests.tools.mutants [--list] [--keep] [--where NAME] [--every N] [MODULE...]

A fault that no test notices is a survivor, and is printed. Some of them are equivalent: another
first number of a sequence, or another text that is only printed. So a module fails if its tests
find less than `LEAST` of its faults.

The faults are those of mutmut, and five kinds more. `mutmut run` itself looks into functions only,
and not into those that have a decorator: it would leave alone the table of transitions, each
property, and all that says what a message is. So its operators are used here on whole modules. A
fault is in the memory of a process of its own: nothing is written to the tree.
"""

from __future__ import annotations

import argparse
import difflib
import gc
import importlib.abc
import os
import resource
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from pathlib import Path
from tempfile import TemporaryFile
from types import ModuleType
from typing import Any, NamedTuple

import anyio.pytest_plugin
import hypothesis.stateful
import pytest
import pytest_asyncio
import trio
from hypothesis import HealthCheck, Phase, settings

from tests.tools import figures

try:
    import libcst
    from mutmut.mutation.mutators import mutation_operators
except ModuleNotFoundError as exc:
    sys.exit(f"{exc.name} is not installed: `make mutants` makes .venv-mutants, which has it")

LOADED = [anyio.pytest_plugin, hypothesis.stateful, pytest_asyncio, trio]
"""The modules that tests need, imported once instead of in each of some hundred processes."""
ROOT = Path(__file__).resolve().parents[2]
LEAST = 0.8
"""The share of a module's faults that its tests must find."""
OF_REGISTRY = ["test_registry", "test_kept_results", "test_admission", "test_life", "test_keeper"]
MODULES = {
    "words/statuses": ["words/test_statuses.py", "words/test_errors.py"],
    **{
        f"server/registry/{module}": [f"server/{file}.py" for file in OF_REGISTRY]
        for module in ("goal_record", "kept_results", "cancellation", "registry")
    },
    "server/scheduling/scheduler": ["server/test_scheduler.py", "server/test_schedule.py"],
    "server/scheduling/scheduled_goals": ["server/test_scheduler.py", "server/test_schedule.py"],
    "server/execution/turns": ["server/test_turns.py"],
    "stores/journal_rows": ["stores/test_journal_rows.py"],
    "stores/sqlite_store": ["stores/test_sqlite_store.py"],
    "wire/messages/fields": ["wire/test_messages.py"],
    "wire/messages/from_client": ["wire/test_messages.py"],
    "wire/messages/from_server": ["wire/test_messages.py"],
    "wire/messages/codec": ["wire/test_messages.py"],
}
"""The modules that are tested by default, and the tests that must notice a fault in each: the rules
that all other modules depend on, the order in which goals run, and what is kept of them."""
OF_FIELDS = {"wire/messages/fields", "wire/messages/from_client", "wire/messages/from_server"}
"""The modules in which the types of fields are checked at run time."""

LIMITED = {
    **dict.fromkeys(["ID", "Stamp", "Status", "Count", "FrameSize"], "int"),
    "GoalBytes": "bytes",
    "Seconds": "float",
}
"""The types of fields that have limits, and what they are without them."""

SECONDS_PER_TEST = 60  # many times what the slowest test takes; one with a fault may never end
SECONDS_PER_MUTANT = 60  # of a processor, for what does not even stop for that
MEMORY = 2**31  # a loop without an end may fill a list
FAILED = 3  # pytest's number for an error of its own
NO_TESTS = 5  # and if it finds none

settings.register_profile(
    "mutants",
    # The same examples each time, so that it is not chance which mutants survive, and none is made
    # smaller, since it will not be read.
    derandomize=True,
    database=None,
    phases=[Phase.explicit, Phase.generate],
    max_examples=50,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)


class Fault(NamedTuple):
    """A fault of a mutant, as shown to people."""

    where: str
    """The function or class with the fault; empty for the module itself."""
    before: str
    after: str
    """The lines that differ, without and with the fault."""

    def __str__(self) -> str:
        return f"in {self.where or 'the module'}:\n  - {self.before}\n  + {self.after}"


class Mutant(NamedTuple):
    """A module with one fault in it."""

    fault: Fault
    code: str


# Mutations of a node, in addition to those of mutmut


def without_a_statement(node: libcst.CSTNode) -> Iterator[libcst.CSTNode]:
    """Leave out a call, a `del`, or an assignment to a target that already has a value."""
    said = node.value if isinstance(node, libcst.Expr) else node
    if isinstance(said, libcst.Assign) and isinstance(said.targets[0].target, libcst.Name):
        return  # the code that follows would fail without it
    if isinstance(said, libcst.Call | libcst.Del | libcst.Assign | libcst.AugAssign):
        yield libcst.Pass()


def with_the_other_branch(node: libcst.CSTNode) -> Iterator[libcst.CSTNode]:
    """Negate a condition without an operator; mutmut negates those with one."""
    if isinstance(node, libcst.If) and isinstance(
        node.test, libcst.Name | libcst.Attribute | libcst.Call
    ):
        if getattr(node.test, "value", "") == "TYPE_CHECKING":
            return
        yield node.with_changes(test=libcst.UnaryOperation(libcst.Not(), node.test))


def without_an_entry(node: libcst.CSTNode) -> Iterator[libcst.CSTNode]:
    """Leave out an entry of a table, or an error of an `except` clause."""
    if isinstance(node, libcst.Dict | libcst.Set | libcst.List | libcst.Tuple):
        for place in range(len(node.elements)):
            others = (*node.elements[:place], *node.elements[place + 1 :])
            yield node.with_changes(elements=others)


def with_half_a_union(node: libcst.CSTNode) -> Iterator[libcst.CSTNode]:
    """Leave out one of two types."""
    if isinstance(node, libcst.BinaryOperation) and isinstance(node.operator, libcst.BitOr):
        yield node.left
        yield node.right


def without_limits(node: libcst.CSTNode) -> Iterator[libcst.CSTNode]:
    """Remove the limits of a type."""
    if isinstance(node, libcst.Name) and node.value in LIMITED:
        yield libcst.Name(LIMITED[node.value])


Operator = Callable[[Any], Iterator[libcst.CSTNode]]
OPERATORS: list[tuple[type, Operator]] = [
    *mutation_operators,
    (libcst.CSTNode, without_a_statement),
    (libcst.CSTNode, with_the_other_branch),
    (libcst.CSTNode, without_an_entry),
]
OPERATORS_ON_TYPES: list[tuple[type, Operator]] = [
    *((kind, operator) for kind, operator in mutation_operators if kind is not libcst.CSTNode),
    (libcst.CSTNode, with_half_a_union),
    (libcst.CSTNode, without_limits),
]


def faults(
    node: libcst.CSTNode, where: tuple[str, ...] = (), *, fields: bool, in_type: bool = False
) -> Iterator[tuple[tuple[str, ...], libcst.CSTNode, libcst.CSTNode]]:
    """Yield places, nodes and their mutations; `fields` includes the types of fields."""
    if isinstance(node, libcst.Annotation):
        if not fields:
            return
        in_type = True
    if isinstance(node, libcst.Call) and getattr(node.func, "value", "") == "TypeVar":
        return  # the name of a type variable is for people
    if isinstance(node, libcst.ClassDef) and any(
        getattr(base.value, "value", "") == "Enum" for base in node.bases
    ):
        return  # members are compared with each other, and their values only printed
    for kind, operator in OPERATORS_ON_TYPES if in_type else OPERATORS:
        if isinstance(node, kind):
            for other in operator(node):
                yield where, node, other
    if isinstance(node, libcst.FunctionDef | libcst.ClassDef):
        where = (*where, node.name.value)
    # What a function takes and gives is for the reader everywhere, what is in a class is not.
    fields = fields and not isinstance(node, libcst.FunctionDef)
    for child in node.children:
        yield from faults(child, where, fields=fields, in_type=in_type)


def mutants(name: str, where: str) -> Iterator[Mutant]:
    """Return the mutants of a module, or of a name in it, each once."""
    source = source_of(name).read_text()
    module = libcst.parse_module(source)
    seen = {source}
    for place, node, other in faults(module, fields=name in OF_FIELDS):
        code = module.deep_replace(node, other).code
        if code not in seen and is_python(code):
            seen.add(code)
            if ".".join(place).startswith(where):
                yield Mutant(Fault(".".join(place), *differences(source, code)), code)


def is_python(code: str) -> bool:
    try:
        compile(code, "mutant", "exec")
    except SyntaxError:
        return False
    return True


def differences(source: str, code: str) -> tuple[str, str]:
    """Return the lines that are in only one of the two."""
    lines = list(difflib.ndiff(source.splitlines(), code.splitlines()))
    before = " ".join(line[2:].strip() for line in lines if line.startswith("- "))
    after = " ".join(line[2:].strip() for line in lines if line.startswith("+ "))
    return before, after


# Running the tests of one


class Instead(importlib.abc.InspectLoader, importlib.abc.MetaPathFinder):
    """A finder that imports a module from given code."""

    def __init__(self, name: str, code: str) -> None:
        self.name = name
        self.code = code

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return spec_from_loader(fullname, self) if fullname == self.name else None

    def get_source(self, fullname: str) -> str:
        return self.code


def source_of(name: str) -> Path:
    return ROOT / "fibaction" / f"{name}.py"


def tests_of(name: str) -> list[Path]:
    return [ROOT / "tests" / path for path in MODULES[name]]


def run_tests(name: str, code: str) -> tuple[int, str]:
    """Return the exit code of pytest with that code of the module, and its output.

    The number is negative if a signal ended it.
    """
    with TemporaryFile() as printed:
        process = os.fork()
        if not process:
            os.dup2(printed.fileno(), 1)
            os.dup2(printed.fileno(), 2)
            result = FAILED
            try:
                result = run_tests_here(name, code)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(result)  # nothing of what the first process has to do when it ends
        _, status = os.waitpid(process, 0)
        printed.seek(0)
        return os.waitstatus_to_exitcode(status), printed.read().decode(errors="replace")


def run_tests_here(name: str, code: str) -> int:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS_PER_MUTANT, SECONDS_PER_MUTANT))
    module = "fibaction." + name.replace("/", ".")
    sys.meta_path.insert(0, Instead(module, code))
    return pytest.main(
        [
            *("-x", "-q", "-p", "no:cacheprovider", "--hypothesis-profile=mutants"),
            *("-W", "ignore::pytest.PytestAssertRewriteWarning"),  # of what was imported before
            *(f"--timeout={SECONDS_PER_TEST}", *map(str, tests_of(name))),
        ]
    )


def survives(name: str, fault: Fault, code: str) -> bool:
    """Return whether no test fails with the fault; a fault may also end pytest itself."""
    result, printed = run_tests(name, code)
    if result == NO_TESTS:
        sys.exit(f"{printed}\npytest ended with {result}, for the mutant of {name} {fault}")
    return result == 0


def check_that_it_works(name: str) -> None:
    """Check that the tests pass without a fault, and fail with a module that cannot be imported."""
    code, printed = run_tests(name, source_of(name).read_text())
    if code:
        sys.exit(f"{printed}\nthe tests of {name} fail as they are")
    code, printed = run_tests(name, "raise ImportError('this is a mutant')")
    if not code or "this is a mutant" not in printed:
        sys.exit(f"{printed}\nthe tests of {name} do not use the module that they are given")


# The figures


class Figures(NamedTuple):
    """How many mutants of a module were tried, and how many a test found."""

    mutants: int
    found: int


def look_into(name: str, where: str = "", every: int = 1) -> Figures:
    """Try each mutant of a module, or every fifth for example; print the survivors."""
    gc.freeze()  # what is here is here to stay: pytest collects garbage at each end
    check_that_it_works(name)
    began = time.monotonic()
    tried = list(mutants(name, where))[::every]
    if not tried:
        sys.exit(f"there is nothing to try in {where or 'the module'} of {name}")
    survivors = 0
    for number, (fault, code) in enumerate(tried):
        if sys.stdout.isatty():
            print(f"{name}: {number} of {len(tried)}", end="\r", flush=True)
        if survives(name, fault, code):
            survivors += 1
            print(f"{name}: a mutant survives {fault}", flush=True)
    minutes = (time.monotonic() - began) / 60
    print(f"{name}: {len(tried)} mutants, {survivors} survive; {minutes:.1f} minutes", flush=True)
    return Figures(len(tried), len(tried) - survivors)


def keep(found: dict[str, Figures]) -> None:
    """Write the figures of modules into the docs, beside those of other modules."""
    modules = figures.read()[figures.MUTANTS]["modules"]
    modules |= {name: one._asdict() for name, one in found.items()}
    in_order = {name: modules[name] for name in MODULES if name in modules}
    figures.keep({"name": figures.MUTANTS, "command": "make mutants", "modules": in_order})


def module(name: str) -> str:
    """Return the name of a module in `MODULES`.

    Raises:
        argparse.ArgumentTypeError: It is not one of them, or it or its tests have moved.
    """
    if name not in MODULES:
        raise argparse.ArgumentTypeError(f"{name} is not one of {', '.join(MODULES)}")
    for path in (source_of(name), *tests_of(name)):
        if not path.exists():
            raise argparse.ArgumentTypeError(f"there is no {path.relative_to(ROOT)}")
    return name


def main() -> int:
    """Test the given modules, or those in `MODULES`."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.mutants",
        description="Would the tests notice a small fault in a module? Each is tried in turn.",
    )
    parser.add_argument(
        "modules",
        nargs="*",
        type=module,
        default=list(MODULES),
        metavar="MODULE",
        help=f"one of {', '.join(MODULES)}; all if none is named",
    )
    parser.add_argument(
        "--where", default="", metavar="NAME", help="only in functions and classes called so"
    )
    parser.add_argument(
        "--every", type=int, default=1, metavar="N", help="try one of so many mutants"
    )
    parser.add_argument("--list", action="store_true", help="only say what would be tried")
    parser.add_argument(
        "--keep", action="store_true", help="write the figures into docs/shown_to_hold.md"
    )
    options = parser.parse_args()
    if options.keep and options.where:
        parser.error("--keep is for whole modules: leave --where out")
    os.chdir(ROOT)
    if options.list:
        for name in options.modules:
            for mutant in mutants(name, options.where):
                print(f"{name}: {mutant.fault}")
        return 0
    results = {name: look_into(name, options.where, options.every) for name in options.modules}
    if options.keep:
        keep(results)
    failed = [name for name, one in results.items() if one.found < LEAST * one.mutants]
    if failed:
        print(f"the tests find less than {LEAST:.0%} of the faults of {', '.join(failed)}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
