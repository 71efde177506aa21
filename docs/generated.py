"""Generated pages: environments, methods, the reference, and executed notebooks.

Each function maps names on the site to contents of files.
"""

import csv
import re
from pathlib import Path

import eitbench
from eitbench.bench.methods import builtin_methods, load_method
from eitbench.bench.text import format_interval
from eitbench.bench.tracks import builtin_ids

ROOT = Path(__file__).resolve().parent.parent
REFERENCE = {
    "eitbench": [f"eitbench.{name}" for name in (
        "evaluate", "Task", "Estimate", "make_task", "simulate", "Episode", "World", "Rules",
        "register", "describe_environment", "report.plot", "data.dataset")],
    "eitbench.envs": ["eitbench.envs.estimation.EstimationEnv",
                      "eitbench.envs.injection.InjectionEnv"],
    "eitbench.estimation": ["eitbench.estimation"],
    "eitbench.estimation.onboard": ["eitbench.estimation.onboard.rules",
                                    "eitbench.estimation.onboard.belief",
                                    "eitbench.estimation.onboard.policies"],
    "eitbench.physics": ["eitbench.physics.cem", "eitbench.physics.transport",
                         "eitbench.physics.observation", "eitbench.physics.flow",
                         "eitbench.physics.navier_stokes", "eitbench.numerics.mesh"],
    "eitbench.worlds": ["eitbench.worlds.world", "eitbench.worlds.vessels",
                        "eitbench.worlds.flows",
                        "eitbench.worlds.slugs", "eitbench.worlds.bodies",
                        "eitbench.worlds.instrument", "eitbench.worlds.schedule",
                        "eitbench.worlds.world"],
    "eitbench.scoring": ["eitbench.scoring", "eitbench.bench.scores"],
    "eitbench.bench": ["eitbench.bench", "eitbench.bench.statistics"],
    "eitbench.rl": ["eitbench.rl.training", "eitbench.rl.agents", "eitbench.rl.vec_env",
                    "eitbench.rl.networks"],
}
"""Page of the reference -> modules and names."""

BASELINES = """# Methods

A method is one file that uses the public API only, like a method of a user. Each page has the code.
Trained agents are described [with the injection environments](injection.md#trained-agents).

"""
"""Introduction of the page that lists the methods."""

Files = dict[str, str | bytes]


def scores() -> list[dict[str, str]]:
    """Return the rows of the leaderboards of single environments."""
    with open(ROOT / "leaderboards" / "leaderboard.csv", encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if row["environment"] != "all"]


def environments() -> Files:
    """Return a page for each built-in id: animation, description, leaderboard."""
    files: Files = {}
    rows = scores()
    for id in builtin_ids():
        name = id.partition("/")[2]
        slug = id.replace("/", "-")
        media = ROOT / "leaderboards" / "media" / f"{slug}.webp"
        parts = [f"# {name}"]
        if media.exists():
            files[f"environments/{media.name}"] = media.read_bytes()
            parts.append(f"![An episode of {id}, in motion]({media.name})")
        parts.append(f'```python\nenv = gym.make("{id}")\n```')
        parts.append(linked(eitbench.describe_environment(id)))
        board = [row for row in rows if row["environment"] == id]
        if board:
            parts.append(f"## Scores\n\n{table(board, 'method')}\n\n[The whole board, with "
                         f"intervals and pictures](../boards/environments/{slug}.html)")
        else:
            parts.append("## Scores\n\nNobody has official records here yet.")
        files[f"environments/{name}.md"] = "\n\n".join(parts) + "\n"
    return files


def baselines() -> Files:
    """Return a page for each built-in method, with description, scores and code, and their list."""
    files: Files = {}
    rows = scores()
    lists = []
    for track, heading in (("estimation", "Estimators"), ("injection", "Injection policies")):
        lines = []
        for name in builtin_methods(track):
            method = load_method(name, track)
            source = method.path.read_text(encoding="utf-8")
            docstring, code = re.fullmatch(r'"""(.*?)"""\n+(.*)', source, re.DOTALL).groups()
            summary = " ".join(docstring.split("\n\n")[0].split())
            where = method.path.relative_to(ROOT).as_posix()
            mine = table([row for row in rows if row["method"] == name], "environment")
            files[f"baselines/{name}.md"] = "\n\n".join([
                f"# {method.title}", f"`{name}`" + kind(method.role, method.privileged),
                linked(docstring), f"## Scores\n\n{mine}",
                f"## Code\n\n`{where}`\n\n```python\n{code.strip()}\n```"]) + "\n"
            lines.append(f"- [`{name}`](baselines/{name}.md): {summary}")
        lists.append(f"## {heading}\n\n" + "\n".join(lines))
    files["baselines.md"] = BASELINES + "\n\n".join(lists) + "\n"
    return files


def kind(role: str | None, privileged: bool) -> str:
    """Return why a method has no rank."""
    kinds = []
    if role == "floor":
        kinds.append("a naive baseline, without a rank")
    if role == "reference":
        kinds.append("an oracle: an estimate of the attainable error")
    if privileged:
        kinds.append("it uses privileged information, and has no rank")
    return "".join(f" – {each}" for each in kinds)


def table(rows: list[dict[str, str]], first: str) -> str:
    """Return ranks and errors of rows of the leaderboards, named by method or by environment."""
    lines = ["| | rank | ẽ_c (95 % interval) | skill score |", "|---|---:|---:|---:|"]
    for row in rows:
        error = format_interval(*(float(row[key] or "nan")
                                for key in ("error", "error_low", "error_high")))
        gain = f"{float(row['gain']):.2f}" if row["gain"] else "–"
        lines.append(f"| {name_of(row, first)} | {row['rank'] or row['note'] or '–'} | {error} | "
                     f"{gain} |")
    return "\n".join(lines) if rows else "No records yet."


def name_of(row: dict[str, str], first: str) -> str:
    """Return the name of a row with a link to its page."""
    if first == "environment":
        name = row["environment"].removeprefix("eitbench/")
        return f"[{name}](../environments/{name}.md)"
    if re.search(r"_seed\d+$", row["method"]):
        return f"[{row['title']}](../injection.md#trained-agents)"
    return f"[{row['title']}](../baselines/{row['method']}.md)"


def linked(text: str) -> str:
    """Return the text with links to the documents whose files it names."""
    return re.sub(r"`+docs/([\w-]+)\.md`+", r"[\1](../\1.md)", text)


def reference() -> Files:
    """Return the pages of the reference, which mkdocstrings fills from docstrings."""
    return {f"api/{page}.md": f"# {page}\n\n" + "\n\n".join(f"::: {name}" for name in names) + "\n"
            for page, names in REFERENCE.items()}


def notebook(source: Path, execute: bool) -> Files:
    """Return a notebook and a page with the output of its cells; an exception in a cell ends the
    build."""
    import nbformat
    from jupyter_client.manager import AsyncKernelManager
    from nbclient import NotebookClient
    from nbconvert import MarkdownExporter

    book = nbformat.read(source, as_version=4)
    if execute:
        kernel = AsyncKernelManager(kernel_name="python3", transport="ipc")
        NotebookClient(book, km=kernel, timeout=1200).execute()
    for cell in book.cells:
        if cell.cell_type == "code":
            cell.outputs = [out for out in cell.outputs if out.get("name") != "stderr"]
    text, resources = MarkdownExporter().from_notebook_node(
        book, {"output_files_dir": f"{source.stem}_files"})
    heading, rest = text.split("\n", 1)
    note = (f"*A notebook, executed when this site was built. Take it: "
            f"[{source.name}]({source.name}).*")
    pictures = {f"notebooks/{name}": data for name, data in resources["outputs"].items()}
    return pictures | {f"notebooks/{source.stem}.md": f"{heading}\n\n{note}\n{rest}",
                       f"notebooks/{source.name}": nbformat.writes(book)}
