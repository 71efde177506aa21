"""Run the command line as a user."""

import re

from eitbench.cli.app import app
from typer.testing import CliRunner


def run(*arguments):
    """Return exit code, output and errors; raise what a user would get as a traceback."""
    done = CliRunner().invoke(app, list(map(str, arguments)))
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.stdout, done.stderr


def eitbench(*arguments):
    """Return the same, with standard error without boxes and line breaks."""
    code, said, complaint = run(*arguments)
    return code, said, re.sub(r"[│╭╮╰╯─\s]+", " ", complaint)
