"""Build ROS 2 interface packages into a virtual environment that has ROS 2 from wheels.

    VENV/bin/python build_interfaces.py PACKAGE...

A package is a folder with a `package.xml` and a `CMakeLists.txt`, as for colcon. Name a package
before those that need it. Packages are built into the environment whose Python runs this script,
and imported there like any other package. The wheels are those of the dependency group `ros`.

Exit codes: 0 all packages are built, 1 a build failed, 2 something is missing.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

PYTHONS = ((3, 11), (3, 13))
"""The first and the last CPython that both fibaction and the wheels support."""

# Absolute paths of Python's headers, and of numpy's, on the machine that built the wheels.
_PATH = re.compile(
    r'(?<=[;"])/[^;"]*/(?:(?P<headers>include)/python3\.\d+|lib/python3\.\d+/site-packages)(?=[;"/])'
)


class Machine(NamedTuple):
    """A machine, and the Python on it."""

    system: str = sys.platform
    processor: str = platform.machine()
    libc: str = platform.libc_ver()[0]
    implementation: str = platform.python_implementation()
    python: str = platform.python_version()


HERE = Machine()


def platform_problem(machine: Machine = HERE) -> str:
    """Return the reason why no wheels of ROS 2 fit a Python and machine; empty if they fit."""
    first, last = PYTHONS
    if (
        machine.system == "linux"
        and machine.processor == "x86_64"
        and machine.libc == "glibc"
        and machine.implementation == "CPython"
        and first <= tuple(map(int, machine.python.split(".")[:2])) <= last
    ):
        return ""
    return (
        "the wheels of ROS 2 are for Linux with glibc on x86_64 and CPython"
        f" {'.'.join(map(str, first))} to {'.'.join(map(str, last))}, and this is"
        f" {machine.implementation} {machine.python} on {machine.system}, {machine.processor}"
    )


def problem(prefix: Path, headers: Path, path: str) -> str:
    """Return a sentence about what is missing in the environment at `prefix`; empty if nothing is.

    `headers` is the folder of Python's headers, `path` the search path of programs.
    """
    if not (prefix / "pyvenv.cfg").is_file():
        return f"{prefix} is not a virtual environment: run this script with the Python of one"
    if not (prefix / "share" / "rosidl_default_generators").is_dir():
        return (
            f"{prefix} has no wheels of ROS 2, or not those that build interfaces:"
            " install the dependency group `ros` of fibaction's pyproject.toml there"
        )
    missing = [
        what
        for what, program in {
            "a C compiler": os.environ.get("CC", "cc"),
            "a C++ compiler": os.environ.get("CXX", "c++"),
            "make": "make",
            "cmake": "cmake",
        }.items()
        if shutil.which(program, path=path) is None
    ]
    if not (headers / "Python.h").is_file():
        missing.append(f"Python's header files in {headers}")
    if missing:
        return (
            f"missing: {', '.join(missing)};"
            " Debian and Ubuntu have all of it in the packages g++, make, cmake and python3-dev"
        )
    return ""


def problem_of(package: Path) -> str:
    """Return the reason why a folder is not an interface package; empty if it may be one."""
    for name in ("package.xml", "CMakeLists.txt"):
        if not (package / name).is_file():
            return f"{package} is not an interface package: it has no {name}"
    return ""


def mend_exports(share: Path, headers: str, packages: str) -> None:
    """Replace the paths of the machine that built the wheels in their CMake files.

    CMake rejects a target with folders that do not exist. Files that need no change are not
    written, so this can be called any number of times.
    """

    def here(match: re.Match[str]) -> str:
        if Path(match[0]).exists():
            return match[0]
        return headers if match["headers"] else packages

    for file in share.glob("*/cmake/*Export.cmake"):
        text = file.read_text(encoding="utf-8")
        mended = _PATH.sub(here, text)
        if mended != text:
            file.write_text(mended, encoding="utf-8")


def environment(prefix: Path, outside: Mapping[str, str]) -> dict[str, str]:
    """Return environment variables for a build that finds no other ROS than the wheels."""
    inside = {name: value for name, value in outside.items() if name not in _SET_BY_ROS}
    # The wheels start each Python anew with their libraries in this path. Compilers and make must
    # not load them; each Python that is started here adds them again.
    libraries = [
        folder
        for folder in outside.get("LD_LIBRARY_PATH", "").split(os.pathsep)
        if folder and not Path(folder).is_relative_to(prefix)
    ]
    inside["LD_LIBRARY_PATH"] = os.pathsep.join(libraries)
    inside["PATH"] = search_path(prefix, outside)
    inside["AMENT_PREFIX_PATH"] = inside["CMAKE_PREFIX_PATH"] = str(prefix)
    return inside


_SET_BY_ROS = {"LD_LIBRARY_PATH", "PYTHONPATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}


def search_path(prefix: Path, outside: Mapping[str, str]) -> str:
    """Return the search path of programs: the environment's own come first."""
    return os.pathsep.join((str(prefix / "bin"), outside.get("PATH", os.defpath)))


def commands(package: Path, prefix: Path, folder: Path) -> Iterator[list[str]]:
    """Yield the commands that build a package in a folder, and install it at `prefix`."""
    yield [
        *("cmake", "-S", str(package), "-B", str(folder), "-DBUILD_TESTING=OFF"),
        f"-DCMAKE_INSTALL_PREFIX={prefix}",
        f"-DPython3_EXECUTABLE={prefix / 'bin' / 'python'}",
    ]
    jobs = len(os.sched_getaffinity(0))
    yield ["cmake", "--build", str(folder), "--target", "install", "--parallel", str(jobs)]


def build(package: Path, prefix: Path) -> bool:
    """Build one package. If that fails, print the output of the build, and return False."""
    with TemporaryDirectory() as folder:
        if not run_all(commands(package, prefix, Path(folder)), package, prefix):
            return False
    print(f"{package} is built, and installed in {prefix}")
    return True


def run_all(steps: Iterator[list[str]], package: Path, prefix: Path) -> bool:
    """Run the commands that build a package. If one fails, print its output, and return False."""
    variables = environment(prefix, os.environ)
    for command in steps:
        run = subprocess.run(
            command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        if run.returncode:
            reason = unnamed(package, run.stdout) or "see above"
            print(f"{run.stdout}\n{package} could not be built: {reason}")
            return False
    return True


def unnamed(package: Path, output: str) -> str:
    """Return a sentence if the build failed for a package that CMakeLists.txt does not name.

    The output of the build has only a `KeyError` with the name of the package.
    """
    for needed in re.findall(r"^KeyError: '([a-z][a-z0-9_]*)'$", output, re.MULTILINE):
        for file in sorted(package.rglob("*")):
            if file.suffix not in (".action", ".msg", ".srv"):
                continue
            lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
            for number, line in enumerate(lines, 1):
                if used := re.match(rf"\s*{needed}/\w+", line):
                    return (
                        f"{file.relative_to(package)} uses {used[0].strip()} in line {number}, and"
                        f" CMakeLists.txt does not name its package: add find_package({needed}"
                        f" REQUIRED), and {needed} behind DEPENDENCIES"
                    )
    return ""


def main(packages: list[Path]) -> str | int:
    """Build packages into the environment of this Python; return an error or an exit code."""
    prefix = Path(sys.prefix)
    paths = sysconfig.get_paths()
    headers = Path(paths["include"])
    wrong = platform_problem() or problem(prefix, headers, search_path(prefix, os.environ))
    for package in packages:
        wrong = wrong or problem_of(package)
    if wrong:
        return wrong
    mend_exports(prefix / "share", paths["include"], paths["platlib"])
    return 0 if all(build(package, prefix) for package in packages) else 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("packages", type=Path, metavar="PACKAGE", nargs="*")
    parser.add_argument(
        "--platform", action="store_true", help="only print why no wheels fit this machine, if so"
    )
    arguments = parser.parse_args()
    if arguments.platform:
        print(platform_problem())
    elif not arguments.packages:
        parser.error("which packages?")
    else:
        end = main([package.resolve() for package in arguments.packages])
        if isinstance(end, str):
            parser.exit(2, f"error: {end}\n")
        sys.exit(end)
