"""The command line, as a user sees it."""

import re

from eitbench.cli.app import app
from typer.testing import CliRunner


def eitbench(*arguments):
    """Exit code, standard output, and standard error without boxes and line breaks; what a user would see as a
    traceback is raised."""
    done = CliRunner().invoke(app, list(map(str, arguments)))
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.stdout, re.sub(r"[│╭╮╰╯─\s]+", " ", done.stderr)
