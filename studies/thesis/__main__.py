"""Draw a figure of the thesis: `python studies/thesis fig5.4 --seeds dev:0`."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from eitbench.data.seeds import parse_seeds

sys.path.insert(0, str(Path(__file__).parents[1]))
from thesis import FIGURES


def main() -> None:
    """Draw one figure and print whether it agrees with the thesis."""
    parser = argparse.ArgumentParser(description=__doc__.split(":")[0])
    parser.add_argument("name", choices=FIGURES, help="figure or table of the thesis, or a study")
    parser.add_argument("--seeds", help="episodes, as in dev:0-1; a picture shows the first")
    parser.add_argument("--jobs", "-j", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--out", "-o", type=Path, default=Path("results/figures"))
    arguments = parser.parse_args()
    try:
        seeds = None if arguments.seeds is None else parse_seeds(arguments.seeds)
    except ValueError as error:
        parser.error(str(error))
    path, description = FIGURES[arguments.name](seeds, arguments.jobs, arguments.out)
    print(f"wrote {path}\n{description}")


if __name__ == "__main__":
    main()
