"""The script that builds ROS 2 interfaces: what it finds, mends and says.

`make test-ros` builds with it.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

from ros2.build_interfaces import (
    Machine,
    environment,
    mend_exports,
    platform_problem,
    problem,
    problem_of,
    run_all,
)

EXAMPLES = Path(__file__).parents[1] / "examples"
SCRIPT = EXAMPLES / "ros2" / "build_interfaces.py"


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    """What the script looks for in a virtual environment, as empty files."""
    for name in ("pyvenv.cfg", "include/Python.h", "bin/cc", "bin/c++", "bin/make", "bin/cmake"):
        file = tmp_path / "venv" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch(mode=0o755)
    (tmp_path / "venv" / "share" / "rosidl_default_generators").mkdir(parents=True)
    return tmp_path / "venv"


@pytest.fixture(autouse=True)
def no_compilers_of_the_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("CXX", raising=False)


def problem_in(prefix: Path) -> str:
    return problem(prefix, prefix / "include", str(prefix / "bin"))


# What is missing


def test_nothing_is_said_of_an_environment_that_has_it_all(prefix: Path) -> None:
    assert problem_in(prefix) == ""


@pytest.mark.parametrize(
    ("without", "said"),
    [
        ("pyvenv.cfg", "is not a virtual environment"),
        ("share/rosidl_default_generators", "install the dependency group `ros`"),
        ("bin/cc", "missing: a C compiler;"),
        ("bin/c++", "missing: a C++ compiler;"),
        ("bin/make", "missing: make;"),
        ("bin/cmake", "missing: cmake;"),
        ("include/Python.h", "missing: Python's header files in "),
    ],
)
def test_what_is_missing_is_said(prefix: Path, without: str, said: str) -> None:
    (prefix / without).rename(prefix / "elsewhere")

    assert said in problem_in(prefix)


@pytest.mark.parametrize("name", ["package.xml", "CMakeLists.txt"])
def test_a_folder_that_is_no_interface_package_is_refused(tmp_path: Path, name: str) -> None:
    for file in {"package.xml", "CMakeLists.txt"} - {name}:
        (tmp_path / file).touch()

    assert problem_of(tmp_path) == f"{tmp_path} is not an interface package: it has no {name}"


def test_the_packages_of_this_project_are_interface_packages() -> None:
    assert problem_of(EXAMPLES / "ros2" / "arduinobot_msgs") == ""
    assert problem_of(Path(__file__).parent / "ros2" / "fibaction_test_msgs") == ""


LINUX = Machine("linux", "x86_64", "glibc", "CPython", "3.12.1")


@pytest.mark.parametrize("python", ["3.11.0", "3.13.9"])
def test_there_are_wheels_for_linux_on_x86_64(python: str) -> None:
    assert platform_problem(LINUX._replace(python=python)) == ""


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("system", "darwin"),
        ("processor", "aarch64"),
        ("libc", "musl"),
        ("implementation", "PyPy"),
        ("python", "3.10.14"),
        ("python", "3.14.0"),
    ],
)
def test_where_there_are_no_wheels_it_is_said_where_there_are(name: str, value: str) -> None:
    said = platform_problem(LINUX._replace(**{name: value}))

    assert "on x86_64 and CPython 3.11 to 3.13, and this is" in said
    assert name == "libc" or value in said  # the name of the other libc is not known


# What is mended


BUILT_ELSEWHERE = (
    'INTERFACE_INCLUDE_DIRECTORIES "${_IMPORT_PREFIX}/include/std_msgs;'
    "/opt/python/cp3-cp3/include/python3.12;"
    '/opt/python/cp3-cp3/lib/python3.12/site-packages/numpy/_core/include"\n'
)
BUILT_HERE = (
    'INTERFACE_INCLUDE_DIRECTORIES "${_IMPORT_PREFIX}/include/std_msgs;'
    "/here/include/python3.12;"
    '/here/packages/numpy/_core/include"\n'
)


def export(share: Path, text: str) -> Path:
    file = share / "std_msgs" / "cmake" / "export_std_msgs__rosidl_generator_pyExport.cmake"
    file.parent.mkdir(parents=True)
    file.write_text(text)
    return file


def test_paths_of_the_machine_that_built_the_wheels_become_those_of_this_one(
    tmp_path: Path,
) -> None:
    file = export(tmp_path, BUILT_ELSEWHERE)

    mend_exports(tmp_path, "/here/include/python3.12", "/here/packages")

    assert file.read_text() == BUILT_HERE


# What it is built with


def test_the_build_sees_the_environment_and_no_other_ros() -> None:
    found = environment(
        Path("/venv"),
        {
            "PATH": "/usr/bin",
            "HOME": "/home/me",
            "PYTHONPATH": "/opt/ros/lib/python",
            "AMENT_PREFIX_PATH": "/opt/ros",
            "LD_LIBRARY_PATH": "/venv/lib:/mine:/venv/ros_rcl.libs",
        },
    )

    assert found == {
        "PATH": "/venv/bin:/usr/bin",
        "HOME": "/home/me",
        "AMENT_PREFIX_PATH": "/venv",
        "CMAKE_PREFIX_PATH": "/venv",
        "LD_LIBRARY_PATH": "/mine",
    }


# What is said of a build that fails


def said_of(package: Path, code: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What is printed if some Python is what builds a package, and fails."""
    assert not run_all(iter([[sys.executable, "-c", code]]), package, package.parent)
    return capsys.readouterr().out.splitlines()


def test_a_package_that_is_used_and_not_named_in_cmakelists_is_told_of_with_where_it_is_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The first two do not use it.
    for name, text in {
        "msg/Arm.msg": "my_geometry_msgs/Pose pose\n# geometry_msgs/Pose\n",
        "msg/README.md": "geometry_msgs/Pose\n",
        "action/GoTo.action": "# Where.\ngeometry_msgs/PoseStamped target\n---\n---\n",
    }.items():
        (tmp_path / "my_msgs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "my_msgs" / name).write_text(text)

    lines = said_of(tmp_path / "my_msgs", "{}['geometry_msgs']", capsys)

    assert "KeyError: 'geometry_msgs'" in lines
    assert lines[-1] == (
        f"{tmp_path}/my_msgs could not be built: action/GoTo.action uses geometry_msgs/PoseStamped"
        " in line 2, and CMakeLists.txt does not name its package: add"
        " find_package(geometry_msgs REQUIRED), and geometry_msgs behind DEPENDENCIES"
    )


@pytest.mark.parametrize("code", ["raise SystemExit('no such header')", "{}['geometry_msgs']"])
def test_of_any_other_failure_all_is_shown(
    tmp_path: Path,
    code: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "my_msgs").mkdir()
    lines = said_of(tmp_path / "my_msgs", code, capsys)

    assert {"no such header", "KeyError: 'geometry_msgs'"} & set(lines)
    assert lines[-1] == f"{tmp_path}/my_msgs could not be built: see above"


# The script


def test_an_error_is_one_line() -> None:
    ended = subprocess.run(
        [sys.executable, str(SCRIPT), "/dev/null"], capture_output=True, text=True, timeout=30
    )

    assert ended.returncode == 2
    assert ended.stderr.startswith("error: ")
    assert ended.stderr.count("\n") == 1
