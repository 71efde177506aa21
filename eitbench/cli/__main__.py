"""Entry point of the command `eitbench` and of `python -m eitbench`."""

import sys

from eitbench._extras import require_extra


def main() -> None:
    """Run the command, or exit with the name of a missing extra."""
    try:
        with require_extra("the command eitbench"):
            from eitbench.cli.app import app
    except ModuleNotFoundError as error:
        sys.exit(str(error))
    app()


if __name__ == "__main__":
    main()
