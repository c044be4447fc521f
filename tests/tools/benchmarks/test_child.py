"""One end of a contender, as a process."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.support.processes import ended
from tests.tools.benchmarks.program import ROOT
from tests.tools.benchmarks.ways import KEPT, WAYS


@pytest.mark.parametrize("end", ["server", "client"])
def test_a_contender_that_there_is_not_is_one_sentence_with_those_that_there_are(end: str) -> None:
    code, out, err = ended(
        subprocess.Popen(
            [sys.executable, "-m", "tests.tools.benchmarks.child", end, "horse"],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    )

    assert (code, out) == (2, "")
    said = err.splitlines()[-1]
    assert "'horse'" in said
    for way in (*WAYS.values(), *KEPT.values()):
        assert f" {way.module}," in f"{said},"
