"""The command `eitbench`, also as `python -m eitbench`."""

import sys

from eitbench._extras import require_extra


def main() -> None:
    """Run the command, or say what it needs to be installed."""
    try:
        with require_extra("the command eitbench"):
            from eitbench.cli.app import app
    except ModuleNotFoundError as error:
        sys.exit(str(error))
    app()


if __name__ == "__main__":
    main()
