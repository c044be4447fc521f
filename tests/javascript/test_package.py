"""The package for npm, and the programs of the page "In the browser" that import it.

React is not among the libraries of the tests: its hooks, as far as the page uses them, and their
types are those of the imitation in `react/`.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from fibaction.schema.typescript import typescript_source
from fibaction_transports.web.http.plain_paths import CLIENT as SERVED
from fibaction_transports.web.http.plain_paths import all_assets
from tests.browser.served import RobotProcess
from tests.javascript.test_client import CLIENT, HERE, PATIENCE, ROOT, run
from tests.support.fibonacci import FIBONACCI
from tests.support.node import IS_LEFT_OUT, IS_REQUIRED, MISSING, MODULES
from tests.support.pages import blocks_of
from tests.tools.release.built import NPM_FILES

NPM = shutil.which("npm")
PAGE = (ROOT / "docs/howto/with_curl.md").read_text(encoding="utf-8")
PROGRAMS = [one.code for one in blocks_of(PAGE) if one.language == "typescript"]
IN_EMPTY_FOLDER = """\
import assert from "node:assert/strict";
import { createRequire } from "node:module";
import { Connection, GoalRejected, decode, encode } from "fibaction";

assert.deepEqual(decode(encode({ order: 10 })), { order: 10 });
assert.ok(new GoalRejected("no") instanceof Error);
assert.throws(() => new Connection("ws://127.0.0.1:1", { WebSocket: null }), /WebSocket/);
console.log(createRequire(import.meta.url)("fibaction/package.json").version);
"""
COMPLETED = """\
import { readFileSync } from "node:fs";
import ts from "typescript";

const text = `${readFileSync("typed.ts", "utf8")}\\nawait connection.sendGoal("`;
const options = { strict: true, module: ts.ModuleKind.NodeNext, types: [] };
const service = ts.createLanguageService({
  ...ts.sys,
  useCaseSensitiveFileNames: () => true,
  getScriptFileNames: () => ["open.ts"],
  getScriptVersion: () => "1",
  getScriptSnapshot: (name) => {
    const found = name === "open.ts" ? text : ts.sys.readFile(name);
    return found === undefined ? found : ts.ScriptSnapshot.fromString(found);
  },
  getCompilationSettings: () => options,
  getDefaultLibFileName: ts.getDefaultLibFilePath,
});
const { entries } = service.getCompletionsAtPosition("open.ts", text.length, {});
console.log(JSON.stringify(entries.map(({ name }) => name)));
"""

pytestmark = [
    pytest.mark.timeout(120),
    pytest.mark.skipif(IS_LEFT_OUT, reason=MISSING),
    pytest.mark.skipif(NPM is None and not IS_REQUIRED, reason="npm is not installed"),
]


def npm(folder: Path, *arguments: str) -> str:
    """Run npm without a network, with a cache of its own, and return what it prints."""
    assert NPM is not None
    folder.mkdir(exist_ok=True)
    settings = {"offline": "true", "audit": "false", "fund": "false", "update_notifier": "false"}
    env = os.environ | {f"npm_config_{name}": value for name, value in settings.items()}
    done = subprocess.run(
        [NPM, *arguments],
        cwd=folder,
        env=env | {"npm_config_cache": str(folder.parent / "cache"), "HOME": str(folder.parent)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def packed(folder: Path) -> Path:
    """Return the package that npm packs."""
    npm(folder, "pack", "--silent", "--pack-destination", str(folder), str(CLIENT))
    [package] = folder.glob("fibaction-*.tgz")
    return package


def as_served(folder: Path) -> Path:
    """Return a folder with the files that every server has."""
    below = folder / "fibaction"
    below.mkdir()
    for name in SERVED:
        (below / name).write_bytes(all_assets()[f"/{name}"].body)
    return below


def options(files: list[str], **more: object) -> str:
    """Return the settings of the compiler for files that import the package."""
    given = json.loads((HERE / "tsconfig.json").read_text())
    given["compilerOptions"] |= more
    return json.dumps(given | {"files": files})


@pytest.mark.parametrize("source", [packed, as_served])
def test_an_empty_folder_gets_the_package_with_its_types(
    tmp_path: Path, source: Callable[[Path], Path]
) -> None:
    folder = tmp_path / "empty"
    npm(folder, "install", str(source(tmp_path)))
    (folder / "program.mjs").write_text(IN_EMPTY_FOLDER)
    version = json.loads((CLIENT / "package.json").read_text())["version"]
    assert run(folder, "program.mjs").strip() == version
    (folder / "typed.mts").write_text(
        (HERE / "program.ts").read_text().replace("./fibaction.js", "fibaction")
    )
    (folder / "tsconfig.json").write_text(options(["typed.mts"]))
    run(folder, str(MODULES / "typescript/bin/tsc"), "--noEmit", "-p", ".")


def test_the_package_has_the_files_that_a_release_has(tmp_path: Path) -> None:
    [told] = json.loads(npm(tmp_path / "here", "pack", "--json", "--dry-run", str(CLIENT)))
    assert {one["path"] for one in told["files"]} == NPM_FILES


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project with the programs of the page, the package, and an imitation of React."""
    libraries = tmp_path / "node_modules"
    react = libraries / "react"
    react.mkdir(parents=True)
    for name in ("ws", "typescript"):
        (libraries / name).symlink_to(MODULES / name)
    shutil.copytree(CLIENT, libraries / "fibaction")
    for one in ("react.js", "react.d.ts"):
        shutil.copy(HERE / "react" / one, react)
    entry = {"types": "./react.d.ts", "default": "./react.js"}
    exports = {".": entry, "./jsx-runtime": entry}
    (react / "package.json").write_text(json.dumps({"type": "module", "exports": exports}))
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "robot_types.ts").write_text(typescript_source([FIBONACCI.info]))
    typed, hook, component = PROGRAMS
    (tmp_path / "typed.ts").write_text(typed.replace("./fibaction.js", "fibaction"))
    (tmp_path / "use_action.ts").write_text(hook)
    (tmp_path / "fibonacci.tsx").write_text(component)
    return tmp_path


def test_the_programs_of_the_page_have_types_and_the_hook_follows_goals(project: Path) -> None:
    files = ["typed.ts", "use_action.ts", "fibonacci.tsx"]
    (project / "tsconfig.json").write_text(options(files, jsx="react-jsx"))
    run(project, "node_modules/typescript/bin/tsc", "-p", ".")
    shutil.copy(HERE / "react/program.mjs", project)
    with RobotProcess() as robot:
        run(project, "program.mjs", robot.url)


def test_an_editor_completes_the_names_of_actions(project: Path) -> None:
    (project / "complete.mjs").write_text(COMPLETED)
    assert json.loads(run(project, "complete.mjs")) == ["fibonacci"]
