"""Run the command line as a user."""

import re

from eitbench.cli.app import app
from typer.testing import CliRunner


def eitbench(*arguments):
    """Return exit code, standard output, and standard error without boxes and line breaks; raise errors that a user
    would get as a traceback."""
    done = CliRunner().invoke(app, list(map(str, arguments)))
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.stdout, re.sub(r"[│╭╮╰╯─\s]+", " ", done.stderr)
