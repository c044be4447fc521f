"""The structure of the product: how long, how wide and how crowded its parts are.

`python -m tests.tools.structure` prints everything that is over a bound, with its places.
`tests/test_structure.py` has the bounds' exceptions, which can only become fewer and smaller.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from graphlib import CycleError, TopologicalSorter
from pathlib import Path, PurePosixPath
from typing import NamedTuple, TypeAlias

from tests.tools.units import CONTRACT

ROOT = Path(__file__).resolve().parent.parent.parent
SOURCES = ("fibaction", "transports/fibaction_transports")

MOST_PARAMETERS = 8
MOST_FUNCTION_LINES = 60
MOST_MODULE_LINES = 500
LINES_TO_THINK_AT = 400
"""The length at which a module is listed, since it may have two duties by now."""
MOST_MODULES = 12
"""The most modules in a folder; `__init__` does not count."""

Function: TypeAlias = ast.FunctionDef | ast.AsyncFunctionDef


class Source(NamedTuple):
    """A module of the product."""

    path: PurePosixPath
    tree: ast.Module
    lines: int

    @classmethod
    def of(cls, path: str, text: str) -> Source:
        return cls(PurePosixPath(path), ast.parse(text), len(text.splitlines()))


class Finding(NamedTuple):
    """Something over a bound."""

    figure: int
    places: Sequence[str]


Findings: TypeAlias = dict[str, Finding]
"""The findings of a rule, by a name that survives the move of a module, where there is one."""


def product(root: Path = ROOT) -> list[Source]:
    """Read every module of the product."""
    return [
        Source.of(path.relative_to(root).as_posix(), path.read_text(encoding="utf-8"))
        for source in SOURCES
        for path in sorted((root / source).rglob("*.py"))
        if not path.is_relative_to(root / CONTRACT)
    ]


def repeated_classes(sources: Iterable[Source]) -> Findings:
    """Find the class names that occur more than once; the figure is how often."""
    places: dict[str, list[str]] = defaultdict(list)
    for source in sources:
        for node in ast.walk(source.tree):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(f"{source.path}:{node.lineno}")
    return {name: Finding(len(of), of) for name, of in places.items() if len(of) > 1}


def ambiguous_constants(sources: Iterable[Source]) -> Findings:
    """Find the constants that have several values in one folder.

    Constants are the names in capitals at the top of a module. An underscore in front does not make
    another name. The figure is the number of values; of several folders, the largest.
    """
    values: dict[tuple[str, PurePosixPath], dict[str, str]] = defaultdict(dict)
    for source in sources:
        for name, value in _constants(source.tree):
            meanings = values[name.strip("_"), source.path.parent]
            meanings.setdefault(_meaning(value), f"{source.path}:{value.lineno}")
    return _largest(
        (name, Finding(len(meanings), list(meanings.values())))
        for (name, _), meanings in values.items()
        if len(meanings) > 1
    )


def _constants(tree: ast.Module) -> Iterator[tuple[str, ast.expr]]:
    for node in tree.body:
        match node:
            case ast.Assign(targets, value):
                names = [target for target in targets if isinstance(target, ast.Name)]
            case ast.AnnAssign(ast.Name() as target, _, ast.expr() as value):
                names = [target]
            case _:
                continue
        yield from ((name.id, value) for name in names if name.id.isupper())


def _meaning(value: ast.expr) -> str:
    """Return a text that is the same for equal values, as far as the source shows it."""
    arithmetic = (ast.Constant, ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop)
    if all(isinstance(node, arithmetic) for node in ast.walk(value)):
        return repr(eval(compile(ast.Expression(value), "a constant", "eval")))
    return ast.unparse(value)


def functions(node: ast.AST, prefix: str = "") -> Iterator[tuple[str, Function]]:
    """Yield every function with its qualified name; functions inside functions, too."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, Function | ast.ClassDef):
            name = f"{prefix}{child.name}"
            if not isinstance(child, ast.ClassDef):
                yield name, child
            yield from functions(child, f"{name}.")
        else:
            yield from functions(child, prefix)


def parameters(function: Function) -> int:
    """Return the number of the parameters; `self` and `cls` do not count."""
    arguments = function.args
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return sum(argument.arg not in ("self", "cls") for argument in named)


def code_lines(function: Function) -> int:
    """Return the number of lines from `def` to the end; those of the docstring do not count."""
    assert function.end_lineno is not None
    lines = function.end_lineno - function.lineno + 1
    match function.body[0]:
        case ast.Expr(ast.Constant(str())) as docstring:
            assert docstring.end_lineno is not None
            lines -= docstring.end_lineno - docstring.lineno + 1
    return lines


def wide_functions(sources: Iterable[Source]) -> Findings:
    """Find the functions with too many parameters."""
    return _functions_over(sources, parameters, MOST_PARAMETERS)


def long_functions(sources: Iterable[Source]) -> Findings:
    """Find the functions with too many lines."""
    return _functions_over(sources, code_lines, MOST_FUNCTION_LINES)


def _functions_over(
    sources: Iterable[Source], measure: Callable[[Function], int], most: int
) -> Findings:
    return _largest(
        (name, Finding(measure(function), [f"{source.path}:{function.lineno}"]))
        for source in sources
        for name, function in functions(source.tree)
        if measure(function) > most
    )


def long_modules(sources: Iterable[Source], most: int = MOST_MODULE_LINES) -> Findings:
    """Find the modules with more lines than `most`."""
    return {
        str(source.path): Finding(source.lines, [str(source.path)])
        for source in sources
        if source.lines > most
    }


def crowded_folders(sources: Iterable[Source]) -> Findings:
    """Find the folders with too many modules; those of folders inside do not count."""
    modules: dict[str, list[str]] = defaultdict(list)
    for source in sources:
        if source.path.stem != "__init__":
            modules[str(source.path.parent)].append(source.path.stem)
    return {
        folder: Finding(len(names), [folder])
        for folder, names in modules.items()
        if len(names) > MOST_MODULES
    }


def outside_wiring(sources: Iterable[Source]) -> Findings:
    """Find the callbacks that are set as an attribute of another object: `other.on_end = ...`.

    A partner that comes by the constructor shows in its signature. The figure is how often the
    attribute is set.
    """
    places: dict[str, list[str]] = defaultdict(list)
    for source in sources:
        for node in ast.walk(source.tree):
            match node:
                case ast.Attribute(owner, name, ast.Store()):
                    is_own = isinstance(owner, ast.Name) and owner.id in ("self", "cls")
                    if name.startswith(("on_", "find_")) and not is_own:
                        places[name].append(f"{source.path}:{node.lineno}")
    return {name: Finding(len(of), of) for name, of in places.items()}


def repeated_modules(sources: Iterable[Source]) -> Findings:
    """Find the names that several modules or packages of one folder have.

    An underscore in front does not make another name: `_text` beside `text` is found.
    """
    paths = {source.path for source in sources}
    there = {path for path in paths if path.stem != "__init__"}
    there |= {path.parent for path in paths if path.stem == "__init__"}
    places: dict[str, list[str]] = defaultdict(list)
    for path in sorted(there):
        places[str(path.with_name(path.stem.strip("_")))].append(str(path))
    return {name: Finding(len(of), of) for name, of in places.items() if len(of) > 1}


def circles(sources: Iterable[Source]) -> Findings:
    """Find a circle of modules that import each other, be it for their types only.

    `__init__` does not count: what it hands on, it imports from all around.
    """
    modules = {
        ".".join(source.path.with_suffix("").parts).removeprefix("transports."): source
        for source in sources
        if source.path.stem != "__init__"
    }
    graph = {
        name: {imported for imported in _imports(source.tree) if imported in modules}
        for name, source in modules.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as exc:
        _, circle = exc.args
        return {min(circle): Finding(len(circle) - 1, circle)}
    return {}


def _imports(tree: ast.Module) -> Iterator[str]:
    """Yield the names that may be those of imported modules."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names):
                yield from (alias.name for alias in names)
            case ast.ImportFrom(module=str(module), names=names):
                yield module
                yield from (f"{module}.{alias.name}" for alias in names)


def _largest(found: Iterable[tuple[str, Finding]]) -> Findings:
    """Return the finding with the largest figure for each name."""
    largest: Findings = {}
    for name, finding in found:
        if name not in largest or finding.figure > largest[name].figure:
            largest[name] = finding
    return largest


def complaints(found: Findings, allowed: Mapping[str, int]) -> list[str]:
    """Compare a rule's findings with its exceptions, which can only become fewer and smaller.

    Args:
        found: The findings of today.
        allowed: The largest figure of each exception.

    Returns:
        A sentence for each finding that is not allowed, and for each exception that is not needed.
    """
    sentences = []
    for name in sorted({*found, *allowed}):
        if name not in found:
            sentences.append(f"{name} needs no exception now: remove it from the table")
        elif name not in allowed:
            figure, places = found[name]
            sentences.append(f"{name} has {figure}, at {', '.join(places)}: see the rule")
        elif (figure := found[name].figure) > allowed[name]:
            places = found[name].places
            sentences.append(
                f"{name} has {figure}, at {', '.join(places)}: its exception is {allowed[name]}"
            )
        elif figure < allowed[name]:
            sentences.append(f"{name} has {figure} now: lower its exception from {allowed[name]}")
    return sentences


RULES: dict[str, Callable[[Iterable[Source]], Findings]] = {
    "class names that occur more than once": repeated_classes,
    "constants with several values in a folder": ambiguous_constants,
    "names of several modules in a folder": repeated_modules,
    "functions with too many parameters": wide_functions,
    "functions with too many lines": long_functions,
    "modules with too many lines": long_modules,
    "modules that may have two duties": partial(long_modules, most=LINES_TO_THINK_AT),
    "folders with too many modules": crowded_folders,
    "callbacks that are set from outside": outside_wiring,
    "modules that import each other in a circle": circles,
}


def main() -> None:
    """Print the findings of each rule."""
    sources = product()
    for title, rule in RULES.items():
        print(f"{title}:")
        for name, (figure, places) in sorted(rule(sources).items()):
            print(f"  {name}: {figure}  # {', '.join(places)}")


if __name__ == "__main__":
    main()
