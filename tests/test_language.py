"""Prose in code, tests, documents and templates is plain technical English: patterns that the style rules forbid.

`python tests/test_language.py PATH ...` lists the findings of files or folders.
"""

import ast
import io
import json
import re
import sys
import tokenize
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("eitbench", "baselines", "tests", "docs", "studies", "benchmarks", "examples", "leaderboards", ".github",
           ".")
SUFFIXES = {".py", ".md", ".j2", ".js", ".css", ".yml", ".yaml", ".toml", ".ipynb"}
GENERATED = ("leaderboards/results", "leaderboards/site", "leaderboards/leaderboard.md", "docs/media", "docs/site",
             "tests/test_language.py")
RULES = {
    "starts with a question word": r'^\s*(?:"""|#+ |// )?(?:What|Whether|Which|Where|How|Who|Whose)\b(?!.*\?)',
    "starts with a preposition or pronoun": r'^"""(?:Of|By|As|From|In|With|To|Those|That|The same|Also)\b',
    "fronted complement": r"(?:^|[.;:] )Of (?!course)",
    "actor without a name": r"\b(?:some|any|no|every)body(?:'s)?\b|\bwho(?:so)?ever\b|\bstrangers?\b",
    "code that speaks or knows": r"\b(?:said|says|told|tells|asked|believes?|believed|believing|knows|forgiven|"
                                 r"forgives?)\b",
    "nested relative clause": r"\b(?:that of|those of|the ones? that|of which|what it is off|those (?:that|which))\b",
    "vague number": r"\b(?:in parts of|so many|as many|by how much|parts? of the readings)\b",
    "negated noun": r"\b(?:is|are|was) no (?!longer|more|less|better|worse|larger|smaller)\w|\b(?:is|are|was) none\b"
                    r"|\bnothing else\b",
    "possessive": r"\bof (?:ours|theirs)\b|\bsomebody else's\b|\bof (?:one's|its|their) own\b|\bones? own\b",
    "old-fashioned word": r"\b(?:anew|for ever|now and then|beside|aslant|learnt|mends?|mended|thereof|hitherto)\b",
    "play": r"\b(?:plays?|played|playing|players?)\b",
    "metaphor": r"\b(?:podium|verdicts?|judges?|judged|judging|honest(?:ly)?|claims?|claimed|guests?|keepers?|cellar"
                r"|too good|kits?|floors?|witness(?:es)?|diary|recipe)\b(?<!noise floor)(?<!noise floors)",
}
"""Rule -> regular expression, matched in prose only; case matters."""
NO_PROSE = re.compile(r"```.*?```|`[^`\n]*`|\]\([^)]*\)|https?://\S+|<style.*?</style>|<[^>]*>|\{[%#{].*?[%#}]\}",
                      re.S)
PARTICIPLE = re.compile(r"[a-z]+ed|shown|kept|given|made|found|drawn|known|told|said|left|held|sent|built|begun|spent")


def prose_of_python(text: str) -> list[tuple[int, str]]:
    """Return docstrings, comments and strings that hold a space, with their first line's number."""
    tree = ast.parse(text)
    docstrings = {id(node.body[0].value) for node in ast.walk(tree)
                  if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node)}
    parts = [(node.lineno, ('"""' if id(node) in docstrings else "") + node.value) for node in ast.walk(tree)
             if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value.strip()]
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    parts += [(token.start[0], token.string.lstrip("# ")) for token in tokens if token.type == tokenize.COMMENT]
    return [(first + row, line) for first, part in parts for row, line in enumerate(part.split("\n"))]


def prose_of_text(path: Path) -> list[tuple[int, str]]:
    """Return the lines of a document or template without code blocks, inline code, links and tags."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = [cell["source"] for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
        text = "\n".join("".join(source) for source in cells)
    text = NO_PROSE.sub(lambda match: "\n" * match.group().count("\n"), text)
    return list(enumerate(text.split("\n"), 1))


def findings(path: Path) -> list[str]:
    """Return a line for each place that breaks a rule."""
    name = path.relative_to(ROOT)
    lines = prose_of_python(path.read_text(encoding="utf-8")) if path.suffix == ".py" else prose_of_text(path)
    return [f"{name}:{number}: {rule}: {match.group().strip()!r} in {line.strip()[:90]!r}"
            for number, line in lines for rule, pattern in RULES.items()
            for match in re.finditer(pattern, line)]


def files(*paths: Path) -> list[Path]:
    """Return the files that hold prose below the given paths."""
    found = [file for path in paths for file in ([path] if path.is_file() else sorted(path.rglob("*")))]
    return [file for file in found if file.suffix in SUFFIXES and "__pycache__" not in file.parts
            and not str(file.relative_to(ROOT)).startswith(GENERATED)]


@pytest.mark.parametrize("folder", FOLDERS)
def test_prose_keeps_the_rules(folder):
    """Files of a folder, or the documents at the top."""
    paths = [ROOT / folder] if folder != "." else [*ROOT.glob("*.md"), *ROOT.glob("*.toml"), ROOT / "CITATION.cff"]
    found = [line for file in files(*paths) for line in findings(file)]
    assert not found, f"{len(found)} findings\n" + "\n".join(found[:50])


def test_no_public_function_is_named_by_a_bare_participle():
    """Functions are verbs; `cached` is the name of the design."""
    names = {f"{path.relative_to(ROOT)}: {node.name}" for path in (ROOT / "eitbench").rglob("*.py")
             for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
             if isinstance(node, ast.FunctionDef) and PARTICIPLE.fullmatch(node.name) and node.name != "cached"}
    assert not names, "\n".join(sorted(names))


def test_no_constant_is_defined_in_two_modules():
    """A constant's name has one meaning in the package."""
    places = defaultdict(list)
    for path in sorted((ROOT / "eitbench").rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            for target in targets:
                if isinstance(target, ast.Name) and re.fullmatch("[A-Z][A-Z0-9_]+", target.id):
                    places[target.id].append(str(path.relative_to(ROOT)))
    assert not (twice := {name: files for name, files in places.items() if len(files) > 1}), twice


if __name__ == "__main__":
    for file in files(*(Path(name).resolve() for name in sys.argv[1:])):
        for line in findings(file):
            print(line)
