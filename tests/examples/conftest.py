"""Wheels of eitbench and the example, built once and installed outside the checkout."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ONE_PROCESS = """
import json, sys

from eitbench.cli.app import app
from typer.testing import CliRunner

for words, expected in json.loads(sys.argv[1]):
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0 and expected in done.output, (words, done.output, done.exception)
"""
"""Script that runs all commands in one process, which imports and compiles once."""


@pytest.fixture(scope="session")
def installed(tmp_path_factory):
    """Run commands in a new virtual environment with two installed wheels, eitbench and
    the example. Dependencies come from the present environment."""
    folder = tmp_path_factory.mktemp("fresh")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", folder / "wheels", ROOT,
                    ROOT / "examples" / "bubble_tank"], check=True)
    venv.create(folder / "venv")
    packages = next((folder / "venv").glob("lib/python*/site-packages"))
    subprocess.run([*pip, "install", "--no-deps", "--no-index", "--target", packages,
                    *(folder / "wheels").glob("*.whl")], check=True)
    (packages / "what_they_need.pth").write_text(sysconfig.get_path("purelib") + "\n")
    python = folder / "venv" / "bin" / "python"

    def run(*arguments, code=0, cwd=folder):
        done = subprocess.run(
            [python, *arguments], cwd=cwd, capture_output=True, text=True, check=False,
            env=os.environ | {"EITBENCH_CACHE": str(folder / "cache"), "PYTHONPATH": ""})
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout if code == 0 else done.stderr

    def commands(pairs, cwd=folder):
        """Run commands in their order and check a part of their outputs."""
        run("-c", ONE_PROCESS, json.dumps([(list(map(str, words)), expected) for words, expected in pairs]), cwd=cwd)

    run.folder, run.commands = folder, commands
    where = run("-c", "import eitbench; print(eitbench.__file__)").strip()
    assert Path(where).is_relative_to(folder)
    return run
