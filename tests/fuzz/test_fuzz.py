"""Bad input of every kind is answered in one line that says what is wrong: see `python -m tests.fuzz`.

In a process of its own: the hook of these tests would check types before dano does.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import dano

REPOSITORY = Path(__file__).resolve().parents[2]
LEAST = {"calls": 2900, "drawn": 1000, "files": 80, "commands": 350, "processes": 15}
NOT_CALLED = {
    "AbstractContactLaw",
    "AbstractEngine",
    "AbstractField",
    "AbstractShape",
    "Control",  # checked where it is used: its arrays may be traced
    "State",
    # What functions return:
    "Execution",
    "Frames",
    "Identification",
    "InverseKinematics",
    "Load",
    "Others",
    "Patch",
    "Plan",
    "Rollouts",
    "compiler_options",  # takes nothing
}


def answers(part: str) -> list[dict[str, str]]:
    environment = {**os.environ, "PYTHONPATH": f"{REPOSITORY / 'src'}{os.pathsep}{REPOSITORY}"}
    answer = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", part, "--json"],
        cwd=REPOSITORY,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(answer.stdout.splitlines()[-1])[part]


@pytest.mark.parametrize("part", [pytest.param(part, marks=pytest.mark.slow) for part in LEAST])
def test_every_answer_is_clear(part):
    cases = answers(part)
    assert [case for case in cases if case["verdict"] != "clear"] == []
    assert len(cases) >= LEAST[part]


@pytest.mark.slow
def test_every_public_function_is_tried():
    tried = {case["case"].partition("(")[0].partition(" ")[0].partition(".")[0] for case in answers("calls")}
    public = {name for name, value in vars(dano).items() if callable(value) and not name.startswith("_")}
    assert public - NOT_CALLED <= tried
    assert public >= NOT_CALLED
