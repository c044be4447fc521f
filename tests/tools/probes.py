"""Probes in modules: which lines and branches were reached, at little cost.

A tracer is called for each line that runs, of libraries and tests as well, and makes tests take
two to three times as long. A probe is a statement of its own, `__probes__[7] = True`. When a
module that is measured is imported, a probe is put before each of its statements, and into each
branch that has none. Everything else runs at full speed, on each version of Python. What is a
statement and what is a branch is decided by coverage.py's report: see
`tests/tools/own_coverage.py`.

The code of a module with its probes is kept beside its bytecode, since it takes ten times as long
to make as to load.
"""

from __future__ import annotations

import ast
import builtins
import marshal
import os
import sys
from collections.abc import Iterable, Sequence
from hashlib import sha256
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import cache_from_source
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, NamedTuple, TypeVar

NodeT = TypeVar("NodeT", bound=ast.AST)

NAME = "__probes__"
"""The name of a module's probes; a name with underscores at both ends means the same in a class."""


THIS = Path(__file__).read_bytes()
"""The text of this module: code that another version of it has made is made again."""

POSITION = ("lineno", "col_offset", "end_lineno", "end_col_offset")
"""The names of the place of a node in a tree."""


class Place(NamedTuple):
    """The place of a probe: a line, or with `target` the step from a line to another."""

    line: int
    target: int | None = None
    """The first line of the branch; -5 for every branch but the one that begins in line 5."""


class Placement(ast.NodeTransformer):
    """A placement of probes in the tree of one module."""

    def __init__(self) -> None:
        self.places: list[Place] = []

    def block(self, statements: list[ast.stmt], *branch: Place) -> list[ast.stmt]:
        """Return the statements of a block, with a probe before each, first of the branch."""
        found: list[ast.stmt] = []
        if branch:
            found.append(self._probe(statements[0], *branch))
        for statement in statements:
            found += [self._probe(statement, *map(Place, _lines(statement))), self.visit(statement)]
        return found

    def definition(self, node: Any) -> Any:
        """Put probes into a module, a class or a function, behind its docstring."""
        body: list[ast.stmt] = node.body
        kept = 1 if ast.get_docstring(node, clean=False) is not None else 0
        first = body[kept : kept + 1]
        if first and isinstance(first[0], ast.ImportFrom) and first[0].module == "__future__":
            # Nothing but the docstring may be before it.
            probe = self._probe(first[0], Place(first[0].lineno))
            node.body = [*body[:kept], *first, probe, *self.block(body[kept + 1 :])]
        else:
            node.body = [*body[:kept], *self.block(body[kept:])]
        return node

    visit_Module = visit_ClassDef = visit_FunctionDef = visit_AsyncFunctionDef = definition

    def choice(self, node: Any) -> Any:
        """Put probes into both branches of an `if` or a loop."""
        first: ast.stmt = node.body[0]
        taken, other = _branches(node.lineno, node.body)
        node.body = self.block(node.body, taken)
        if node.orelse:
            node.orelse = self.block(node.orelse, other)
        elif not (isinstance(node, ast.While) and isinstance(node.test, ast.Constant)):
            node.orelse = [self._probe(first, other)]
        return node

    visit_If = visit_For = visit_AsyncFor = visit_While = choice

    def visit_With(self, node: ast.With) -> ast.With:
        node.body = self.block(node.body)
        return node

    def visit_AsyncWith(self, node: ast.AsyncWith) -> ast.AsyncWith:
        node.body = self.block(node.body)
        return node

    def visit_Try(self, node: Any) -> Any:
        node.body = self.block(node.body)
        node.orelse = self.block(node.orelse)
        node.finalbody = self.block(node.finalbody)
        for handler in node.handlers:
            if handler.type is not None:
                handler.body = self.block(handler.body)
                handler.type = self._evaluated(handler.type, Place(handler.lineno))
            else:
                handler.body = self.block(handler.body, Place(handler.lineno))
        return node

    visit_TryStar = visit_Try

    def visit_Match(self, node: ast.Match) -> ast.Match:
        # A case is reached if it or a later one is chosen.
        at = node.cases[0].body[0]
        passed: list[Place] = []
        for case in node.cases:
            line = case.pattern.lineno
            taken, other = _branches(line, case.body)
            case.body = self.block(case.body, *passed, Place(line), taken)
            passed += [Place(line), other]
        if not _is_for_the_rest(node.cases[-1]):
            rest = ast.copy_location(ast.MatchAs(), node.cases[-1].pattern)
            node.cases.append(ast.match_case(rest, None, [self._probe(at, *passed)]))
        return node

    def generic_visit(self, node: ast.AST) -> ast.AST:
        """Leave other statements, and what is in them, as they are."""
        return node

    def _number(self, place: Place) -> int:
        self.places.append(place)
        return len(self.places) - 1

    def _probe(self, at: ast.AST, *places: Place) -> ast.stmt:
        """Return a statement that says that these places are reached."""
        # Each is written at its place here: `ast.copy_location` takes ten times as long.
        where = {name: getattr(at, name) for name in POSITION}
        targets: list[ast.expr] = [
            ast.Subscript(
                ast.Name(NAME, ast.Load(), **where),
                ast.Constant(self._number(place), **where),
                ast.Store(),
                **where,
            )
            for place in places
        ]
        return ast.Assign(targets, ast.Constant(True, **where), **where)

    def _evaluated(self, kind: ast.expr, place: Place) -> ast.expr:
        """Return an expression that says so when it runs: `__probes__.add(7) or KIND`."""
        add = ast.Attribute(ast.Name(NAME, ast.Load()), "add", ast.Load())
        call = ast.Call(add, [ast.Constant(self._number(place))], [])
        either: ast.expr = ast.BoolOp(ast.Or(), [call, kind])
        return _located(either, kind)


def _located(node: NodeT, at: ast.AST) -> NodeT:
    """Give a new node, and all that is new in it, the position of another."""
    for each in ast.walk(node):
        if "lineno" not in vars(each):
            ast.copy_location(each, at)
    return node


def _branches(line: int, body: list[ast.stmt]) -> tuple[Place, Place]:
    """Return the branch that leads from a line into this block, and the one that does not."""
    return Place(line, _first_line(body[0])), Place(line, -_first_line(body[0]))


def _is_for_the_rest(case: ast.match_case) -> bool:
    """Does this case take all that the cases before it have left?"""
    pattern = case.pattern
    return isinstance(pattern, ast.MatchAs) and pattern.pattern is None and case.guard is None


def _lines(node: Any) -> list[int]:
    """Return the lines that coverage.py counts for a statement: of its decorators and its own."""
    return [*(each.lineno for each in getattr(node, "decorator_list", [])), node.lineno]


def _first_line(node: Any) -> int:
    return _lines(node)[0]


def _code(path: str) -> tuple[list[Place], CodeType]:
    """Return the probes of a module and its code with them, which is made once for each text."""
    source = Path(path).read_bytes()
    kept = Path(cache_from_source(path, optimization="probes"))
    mark = sha256(b"\0".join([THIS, path.encode(), source])).digest()
    data = kept.read_bytes() if kept.exists() else b""
    if data.startswith(mark):
        found, code = marshal.loads(data[len(mark) :])
        return [Place(*each) for each in found], code
    placement = Placement()
    code = compile(placement.visit(ast.parse(source, path)), path, "exec", dont_inherit=True)
    if not sys.dont_write_bytecode:
        kept.parent.mkdir(exist_ok=True)
        # Other processes may write or read the same file now.
        own = kept.with_suffix(f".{os.getpid()}")
        own.write_bytes(mark + marshal.dumps(([*map(tuple, placement.places)], code)))
        own.replace(kept)
    return placement.places, code


class Reached(list[bool]):
    """Which probes of a module were reached."""

    def add(self, number: int) -> None:
        """Say that this probe was reached."""
        self[number] = True


class Probes(MetaPathFinder):
    """The probes of all modules of the packages, which are put in when a module is imported."""

    def __init__(self, *packages: str) -> None:
        self._packages = packages
        self._places: dict[str, list[Place]] = {}
        self._reached: dict[str, Reached] = {}
        sys.meta_path.insert(0, self)

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname.partition(".")[0] not in self._packages:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path, self)
        return spec

    def prepare(self, paths: Iterable[str]) -> None:
        """Make the code of these modules, so that it is there for this process and for others."""
        if not sys.dont_write_bytecode:
            for path in paths:
                _code(path)

    def code(self, path: str) -> CodeType:
        """Return the code of a module, with its probes."""
        self._places[path], code = _code(path)
        self._reached.setdefault(path, Reached([False] * len(self._places[path])))
        return code

    def reached(self, path: str) -> Reached:
        """Return which probes of a module were reached."""
        return self._reached[path]

    def take(self) -> dict[str, set[Place]]:
        """Return the places that were reached in each module, and begin anew."""
        found: dict[str, set[Place]] = {}
        for path, reached in self._reached.items():
            if True in reached:
                places = self._places[path]
                found[path] = {place for place, is_ in zip(places, reached, strict=True) if is_}
                reached[:] = [False] * len(reached)
        return found


class _Loader(SourceFileLoader):
    def __init__(self, name: str, path: str, probes: Probes) -> None:
        super().__init__(name, path)
        self._probes = probes

    def get_code(self, fullname: str) -> CodeType:
        code = self._probes.code(self.path)
        # For `runpy`, which runs the code in a namespace of its own.
        vars(builtins)[NAME] = self._probes.reached(self.path)
        return code

    def exec_module(self, module: ModuleType) -> None:
        code = self.get_code(module.__name__)
        vars(module)[NAME] = self._probes.reached(self.path)
        exec(code, vars(module))
