"""Loading of estimators: required contents of a file, and error messages."""

import json
import os
import re

import pytest
from eitbench.bench.methods import MAX_METHOD_BYTES, builtin_methods, is_builtin, load_method

from tiny import strict


def test_built_in_methods_load():
    """Each built-in method has a title, subtracks, a hash, and parameters that JSON can hold."""
    for name in builtin_methods("estimation"):
        baseline = load_method(name, "estimation")
        assert baseline.name == name and baseline.title and baseline.subtracks and len(baseline.sha256) == 64
        assert strict(json.dumps(baseline.parameters)) == baseline.parameters
    ours = [load_method(name, track) for track in ("estimation", "injection") for name in builtin_methods(track)]
    roles = {method.name: method.role for method in ours if method.role}
    assert roles == {"homogeneous": "floor", "persistence": "floor", "true_model_smoother": "reference",
                     "attainable_oracle": "reference", "clairvoyant": "reference", "one_step_oracle": "reference",
                     "random_pair": "floor"}
    assert [method.name for method in ours if method.privileged] == [
        "true_model_smoother", "attainable_oracle", "clairvoyant", "one_step_oracle"]


@pytest.mark.parametrize(("source", "message"), [
    ("x = 1", "must define a class Estimator with a method update"),
    ("class Estimator: pass", "Estimator must have a method update"),
    ("class Estimator:\n  boards = ('filer',)\n  def update(self, V, I): pass", "subtracks must be some of filter"),
    ("class Estimator:\n  role = 'flor'\n  def update(self, V, I): pass", "role must be among None"),
    ("class Estimator:\n  parameters = {'a': {1}}\n  def update(self, V, I): pass", "fit for JSON"),
    ("class Estimator:\n  parameters = {'a': 'b' * 10_000}\n  def update(self, V, I): pass", "at most 10000 bytes"),
    ("class Estimator:\n  parameters = eval('{1:' * 30 + '1' + '}' * 30)\n  def update(self): pass", "nested deeper"),
    ("class Estimator:\n  privileged = 1\n  def update(self, V, I): pass", "privileged must be True or False, got 1"),
    ("def broken(:", "invalid syntax"),
])
def test_invalid_files_are_reported(source, message, tmp_path):
    """The message names the file and the missing part."""
    path = tmp_path / "mine.py"
    path.write_text(source)
    with pytest.raises(ValueError, match=message) as caught:
        load_method(str(path), "estimation")
    assert str(path) in str(caught.value)


def test_unknown_baselines(tmp_path):
    """The message lists similar built-in names, or names the missing file. A file that is too large is not read."""
    path = tmp_path / "mine.py"
    path.touch()
    os.truncate(path, MAX_METHOD_BYTES + 1)
    with pytest.raises(ValueError, match="must have 256 MiB at most"):
        load_method(str(path), "estimation")
    for name, message in (("kalman", r"one of kalman_filter, .*got 'kalman'. Did you mean kalman_filter\?"),
                          ("no/such/file.py", "no/such/file.py does not exist"), ("", "one of .*got ''")):
        with pytest.raises(ValueError, match=message):
            load_method(name, "estimation")


@pytest.mark.parametrize(("docstring", "title"), [
    ('"""My filter (v2.1), quick."""', "My filter (v2.1), quick"), ('"""My filter. Quick."""', "My filter"),
    ('"""\nMy filter\n\nLong story.\n"""', "My filter"), ('"""  """', "mine"), (f'"""{150 * "x"}"""', 120 * "x")])
def test_titles_and_dataclasses(docstring, title, tmp_path):
    """The title ends at a colon, sentence or paragraph; by default it is the file's name. Deferred annotations and
    dataclasses are possible; the default subtrack is filter."""
    path = tmp_path / "mine.py"
    path.write_text(f"{docstring}\nfrom __future__ import annotations\nfrom dataclasses import dataclass\n@dataclass\n"
                    "class Estimator:\n    task: object\n    def update(self, V, I): pass\n")
    loaded = load_method(str(path), "estimation")
    assert (loaded.title, loaded.subtracks) == (title, ("filter",)) and loaded.make(task=3).task == 3


@pytest.mark.parametrize("track", ["estimation", "injection"])
def test_only_registered_names_are_built_in(track, tmp_path, monkeypatch):
    """A path without .py is not a method, even if the file with .py exists; a link is resolved to its target; a file
    with a built-in name in another folder is rejected."""
    ours = next(iter(builtin_methods(track)))
    path = tmp_path / "insider.py"
    path.write_text("raise SystemExit('executed')")
    monkeypatch.chdir(tmp_path)
    for name in (str(tmp_path / "insider"), "insider", "./insider", f"../{tmp_path.name}/insider",
                 f"{ours}/../../insider", "", "."):
        assert not is_builtin(name)
        with pytest.raises(ValueError, match=f"must be one of .*; got {re.escape(repr(name))}"):
            load_method(name, track)
    assert is_builtin(ours) and not is_builtin(str(path))
    link = tmp_path / f"{ours}.py"
    link.symlink_to(path)
    assert not is_builtin(str(link))
    with pytest.raises(ValueError, match="has the name of a built-in method"):
        load_method(str(link), track)
