"""The habits of a public project: the files that tools read are valid, and name what exists."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import fibaction
from tests.support.processes import ended, lines_until

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
YAML = [
    *sorted((ROOT / ".github").rglob("*.yml")),
    ROOT / ".pre-commit-config.yaml",
    ROOT / "CITATION.cff",
]

WAITS = "        await anyio.sleep_forever()\n"

if not (ROOT / ".github").exists():
    pytest.skip("an sdist has no files for GitHub", allow_module_level=True)


def load(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def targets() -> set[str]:
    """Return the targets of the Makefile, by their patterns."""
    return set(re.findall(r"^([a-z-]+):", MAKEFILE, re.MULTILINE))


def commands_of(workflow: Any) -> list[str]:
    return [
        step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step
    ]


@pytest.mark.parametrize("path", YAML, ids=lambda path: path.name)
def test_a_file_for_tools_is_yaml(path: Path) -> None:
    assert isinstance(load(path), dict)


@pytest.mark.parametrize("path", sorted((ROOT / ".github/workflows").iterdir()), ids=str)
def test_a_workflow_makes_targets_that_exist_and_has_a_time_limit(path: Path) -> None:
    workflow = load(path)
    for command in commands_of(workflow):
        if command.startswith("make "):
            words = re.sub(r"\$\{\{.*?\}\}", "", command).split()[1:]
            named = [word for word in words if "=" not in word]
            assert set(named) <= targets()
    assert workflow["permissions"] == {"contents": "read"}
    for name, job in workflow["jobs"].items():
        assert "timeout-minutes" in job or name.startswith("publish")


def test_every_long_trial_runs_each_night() -> None:
    job = load(ROOT / ".github/workflows/nightly.yml")["jobs"]["trial"]
    trials = {trial.split()[0] for trial in job["strategy"]["matrix"]["trial"]}
    assert trials <= targets()
    longer = {
        "agents",
        "attack",
        "contract",
        "fleet",
        "frontends",
        "fuzz",
        "kills",
        "lossy",
        "mutants",
        "openapi",
        "properties",
        "simulate",
        "soak",
    }
    assert trials == longer


def test_each_night_the_speed_is_compared_with_that_of_the_commits_before() -> None:
    job = load(ROOT / ".github/workflows/nightly.yml")["jobs"]["speed"]

    assert job["steps"][0]["with"]["fetch-depth"] == 0
    assert {"run": "make regression"} in job["steps"]


def test_every_supported_python_is_checked() -> None:
    matrix = load(ROOT / ".github/workflows/check.yml")["jobs"]["test"]["strategy"]["matrix"]
    promised = [
        each.rpartition(" ")[2]
        for each in PROJECT["classifiers"]
        if re.fullmatch(r"Programming Language :: Python :: 3\.\d+", each)
    ]
    assert matrix["python"] == [*promised, "3.14"]


def test_hooks_make_targets_that_exist() -> None:
    for repository in load(ROOT / ".pre-commit-config.yaml")["repos"]:
        for hook in repository["hooks"]:
            tool, argument, *_ = hook["entry"].split()
            assert argument in targets() if tool == "make" else tool == ".venv/bin/ruff"


def test_the_container_makes_what_the_makefile_has() -> None:
    container = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text(encoding="utf-8"))

    tool, target = container["postCreateCommand"].split()
    assert tool == "make"
    assert f"$(VENV){target.removeprefix('.venv')}:" in MAKEFILE


def test_the_version_is_one_in_every_place() -> None:
    citation = load(ROOT / "CITATION.cff")

    assert fibaction.__version__ == PROJECT["version"] == str(citation["version"])
    assert citation["repository-code"] == PROJECT["urls"]["Repository"]


def test_the_header_of_the_site_has_the_version_and_the_repository() -> None:
    site = tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))["project"]
    header = (ROOT / site["theme"]["custom_dir"] / "partials/source.html").read_text("utf-8")

    assert site["extra"]["version"] == PROJECT["version"]
    assert site["repo_url"] == PROJECT["urls"]["Repository"]
    assert PROJECT["urls"]["Repository"].endswith(f"/{site['repo_name']}")
    for shown in ("config.repo_url", "config.repo_name", "config.extra.version"):
        assert f"{{{{ {shown} }}}}" in header
    # The script of the theme would ask the host of the repository for figures.
    assert "data-md-component" not in header


def test_every_url_of_the_project_is_in_its_repository() -> None:
    urls = PROJECT["urls"]
    assert set(urls) == {"Changelog", "Documentation", "Issues", "Repository"}
    for url in (urls["Changelog"], urls["Issues"]):
        assert url.startswith(f"{urls['Repository']}/")


def test_the_description_for_the_package_index_has_absolute_links_to_files_that_exist() -> None:
    spec = importlib.util.spec_from_file_location("index_readme", ROOT / "docs/index_readme.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    base = PROJECT["urls"]["Repository"]

    text = module.with_absolute_links(README, base, PROJECT["version"])

    links = re.findall(r"(!?)\[[^]]*\]\(([^)\s]+)\)", text)
    assert len(links) > 20
    for picture, target in links:
        assert "://" in target or target.startswith("#")
        kind, found, path = target.removeprefix(f"{base}/").partition(f"/v{PROJECT['version']}/")
        if found:
            assert kind == ("raw" if picture else "blob")
            assert (ROOT / path.partition("#")[0]).is_file()
    assert "<!--" not in text


def programs_of(page: str) -> list[str]:
    return [part.partition("```")[0] for part in page.split("```python\n")[1:]]


def test_readme_begins_with_a_short_program() -> None:
    program = programs_of(README)[0]

    assert len(program.splitlines()) <= 25
    assert "get_cancelled_exc_class" not in program
    executor = next(part for part in ast.parse(program).body if hasattr(part, "decorator_list"))
    assert executor.end_lineno is not None
    assert executor.end_lineno - executor.lineno < 12


def test_readme_and_the_first_page_open_with_the_same_program() -> None:
    index = (ROOT / "docs/index.md").read_text(encoding="utf-8")

    assert programs_of(README)[0] == programs_of(index)[0]


def test_readme_is_short() -> None:
    prose = re.sub(r"^```.*?^```", "", README, flags=re.DOTALL | re.MULTILINE)

    assert len(prose.split()) <= 700
    assert README.count("](") <= 30
    assert "pip install" in "\n".join(README.splitlines()[:25])


def test_every_extra_is_in_the_page_about_installing() -> None:
    page = (ROOT / "docs/installing.md").read_text(encoding="utf-8")

    section = page.partition("\n## Extras\n")[2].partition("\n## ")[0]
    named = re.findall(r"^\| `(.+?)` \|", section, re.MULTILINE)

    assert sorted(named) == sorted(PROJECT["optional-dependencies"])


@pytest.mark.skipif(sys.platform == "win32", reason="a process gets no Ctrl-C alone there")
def test_the_server_of_readme_ends_at_ctrl_c_without_a_traceback() -> None:
    before, found, after = "\n".join(programs_of(README)[:3]).partition(WAITS)
    assert found
    serving = before.replace(":7400", ":0") + '        print("serving", flush=True)\n'
    process = subprocess.Popen(
        [sys.executable, "-c", serving + WAITS + after],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'transports'}"},
    )
    lines_until("serving", process)
    process.send_signal(signal.SIGINT)

    assert ended(process) == (0, "", "")
