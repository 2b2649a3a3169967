"""`python -m dano`."""

import subprocess
import sys

import dano


def test_python_runs_the_command_as_a_module():
    command = [sys.executable, "-m", "dano", "--version"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (answer.returncode, answer.stdout.strip()) == (0, f"dano {dano.__version__}")
