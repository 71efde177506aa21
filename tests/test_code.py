"""Digests of code: words do not count, all else does."""

import pytest
from eitbench._code import code_digest, package_files

CODE = '''"""A module."""

class Thing: "in a line"; size = 1

def area(width):
    """Über alles: m²."""
    text = "width"
    "after an assignment"; "beside it"
    return width * len(text)
'''


@pytest.mark.parametrize(("old", "new", "counts"), [
    ("A module.", "A module,\nand more of it.", False), ("in a line", "", False), ("Über alles: m²", "In m²", False),
    ("after an assignment", "ä", False), ("beside it", "beside", False),
    ("after an assignment", "", False), ("size = 1", "size = 2", True), ('"width"', '"depth"', True),
    ("return", "return 2 *", True), ("\n    return", "\n    # why\n    return", True), ("(width)", "(wide", True),
])
def test_docstrings_do_not_count(old, new, counts, tmp_path):
    """Nor does how many lines they have; a file that is no Python is taken as it is."""
    file = tmp_path / "module.py"
    file.write_text(CODE, encoding="utf-8")
    before = code_digest([file])
    assert old in CODE
    file.write_text(CODE.replace(old, new), encoding="utf-8")
    assert (code_digest([file]) != before) == counts


def test_order_and_number_of_files_count(tmp_path):
    one, two = tmp_path / "one.py", tmp_path / "two.c"
    one.write_text("x = 1\n")
    two.write_text('"x"\n')
    digests = {code_digest(files) for files in ([one], [two], [one, two], [two, one], [])}
    assert len(digests) == 5
    before = code_digest([two])
    two.write_text('"y"\n')                                            # no docstring: it is not Python
    assert code_digest([two]) != before


def test_files_that_are_named_are_there():
    """A digest never leaves out silently what has moved."""
    assert [file.name for file in package_files("bench/scores.py", "bench/run.py")] == ["run.py", "scores.py"]
    with pytest.raises(FileNotFoundError, match=r"no file bench/score\.py"):
        package_files("bench/run.py", "bench/score.py")
