"""Compare the speed with peers: `python benchmarks/run.py [section …]` measures, and writes
`results.json` and `README.md`.

Each section runs in a separate process, limited to one thread, and replaces its part of the
results.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

from common import COLUMNS, Row, ceilings, in_fresh_process, machine, quantity

from eitbench._files import write_atomically

HERE = Path(__file__).parent
SECTIONS = {"first_hour": "The first hour, with an empty cache",
            "forward": "Complete electrode model", "kernels": "Compiled kernels",
            "filtering": "Kalman filter and smoother",
            "stepping": "Environments",
            "simulation": "Simulation of new episodes", "scaling": "Growth with size"}
"""name of a module in this folder, with `rows()` or `curves()` → heading"""

INTRODUCTION = """# Speed

eitbench and peers, measured in the same run on one thread. Each time is the minimum of several
calls, which alternate between the candidates; references that take seconds run once or twice.
Results are first compared with the reference, except pyEIT, whose model differs. On a shared
machine a ratio may vary by a third between runs. Targets were set before measuring.

- *ratio*: time of eitbench divided by the reference, or the inverse for "faster"
- *limited by*: resource that dominates the time of eitbench
- *ceiling*: attained fraction of the machine's peak performance, measured in the same process
- *eitbench with scipy's SuperLU and sparse products*: the reference in `references.py`

```sh
python3 -m venv peers
peers/bin/pip install -c constraints.txt -e . -r benchmarks/requirements.txt
peers/bin/python benchmarks/run.py            # or only some: run.py forward
```

The command writes this page. A peer that is not installed has a dash.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sections", nargs="*", metavar="section",
                        help=f"of {', '.join(SECTIONS)}; default: all")
    parser.add_argument("--render-only", action="store_true",
                        help="only rewrite README.md from results.json")
    arguments = parser.parse_args()
    if unknown := set(arguments.sections) - set(SECTIONS):
        parser.error(f"no section {', '.join(sorted(unknown))}; there are {', '.join(SECTIONS)}")
    results = HERE / "results.json"
    record = json.loads(results.read_text()) if results.exists() else {}
    for section in [] if arguments.render_only else arguments.sections or SECTIONS:
        record[section] = in_fresh_process(measure, section)
        write_atomically(results,
                         (json.dumps(record, indent=1, ensure_ascii=False) + "\n").encode())
    write_atomically(HERE / "README.md", page(record).encode())


def measure(section: str) -> dict[str, Any]:
    """Measure one section, for `results.json`."""
    record: dict[str, Any] = {"machine": machine(), "ceilings": ceilings()._asdict()}
    begin = time.monotonic()
    module = import_module(section)
    if section == "scaling":
        curves = []
        for curve in module.curves():
            curves.append(curve)
            report(section, begin,
                   f"{curve.column}, {curve.y_label}: exponent {curve.exponent:.2f}")
        module.draw(curves, HERE / "scaling.png")
        record["curves"] = [asdict(curve) | {"exponent": curve.exponent} for curve in curves]
    else:
        record["rows"] = []
        for row in module.rows():
            record["rows"].append(asdict(row))
            report(section, begin,
                   f"{row.what}: {row.ratio_text} {'' if row.met in (True, None) else '(missed)'}")
    return record


def report(section: str, begin: float, text: str) -> None:
    print(f"{section} {time.monotonic() - begin:5.0f} s  {text}", flush=True)


# -- the page --------------------------------------------------------------------------------------


def page(record: dict[str, Any]) -> str:
    parts = [INTRODUCTION]
    for section, heading in SECTIONS.items():
        parts.append(f"## {heading}\n")
        if section not in record:
            parts.append(f"Not measured yet: `python benchmarks/run.py {section}`.\n")
            continue
        parts.append(conditions(record[section]))
        parts.append(growth(record[section])
                     if section == "scaling" else table(record[section]["rows"]))
    return "\n".join(parts)


def conditions(record: dict[str, Any]) -> str:
    on = ", ".join(f"{name}: {value}" for name, value in record["machine"].items())
    best = record["ceilings"]
    return (f"*{on}. Ceilings: dgemm {best['gflops']:.0f} GFlop/s, reading {best['read']:.0f} "
            "GB/s, copying "
            f"{best['copy']:.0f} GB/s, an empty Python call {quantity(best['call'], 's')}.*\n")


def table(rows: list[dict[str, Any]]) -> str:
    lines = [COLUMNS, ["---", "---", "---:", "---:", "---:", "---", "---", "---"],
             *(Row(**row).cells for row in rows)]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
                     for cells in lines) + "\n"


def growth(record: dict[str, Any]) -> str:
    lines = ["| what | measured | from | to | exponent |", "| --- | --- | ---: | ---: | ---: |"]
    for curve in record["curves"]:
        ends = [f"{f'{y:,.0f}' if y >= 100 else f'{y:.3g}'} at {x:,.0f} {curve['x_label']}"
                for x, y in list(zip(curve["x"], curve["y"], strict=True))[::len(curve["x"]) - 1]]
        lines.append(f"| {curve['column']}: {curve['label']} | {curve['y_label']} | {ends[0]} | "
                     f"{ends[1]} | {curve['exponent']:.2f} |")
    return "![Time and memory against size](scaling.png)\n\n" + "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
