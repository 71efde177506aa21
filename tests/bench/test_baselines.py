"""Loading baselines: what a file must hold, and what is said of those that do not."""

import json

import pytest
from eitbench.bench.methods import load_method, own_methods

from tiny import strict


def test_our_baselines_load():
    """Each of ours has a title, a board, a hash, and parameters that JSON can hold."""
    assert {"homogeneous", "kalman_filter", "fixed_interval_smoother", "gauss_newton"} <= set(own_methods("estimation"))
    for name in own_methods("estimation"):
        baseline = load_method(name, "estimation")
        assert baseline.name == name and baseline.title and baseline.boards and len(baseline.sha256) == 64
        assert strict(json.dumps(baseline.parameters)) == baseline.parameters
    ours = [load_method(name, "estimation") for name in own_methods("estimation")]
    roles = {method.name: method.role for method in ours if method.role}
    assert roles == {"homogeneous": "floor", "persistence": "floor", "true_model_smoother": "reference"}
    assert [method.name for method in ours if method.privileged] == ["true_model_smoother"]


@pytest.mark.parametrize(("source", "message"), [
    ("x = 1", "must define a class Estimator with a method update"),
    ("class Estimator: pass", "must define a class Estimator with a method update"),
    ("class Estimator:\n  boards = ('filer',)\n  def update(self, V, I): pass", "boards must be some of filter"),
    ("class Estimator:\n  boards = ()\n  def update(self, V, I): pass", "boards must be some of filter"),
    ("class Estimator:\n  boards = 'filter'\n  def update(self, V, I): pass", "boards must be some of filter"),
    ("class Estimator:\n  role = 'flor'\n  def update(self, V, I): pass", "role must be None, 'floor' or 'reference'"),
    ("class Estimator:\n  parameters = {'a': {1}}\n  def update(self, V, I): pass", "fit for JSON"),
    ("class Estimator:\n  parameters = {'a': 'b' * 10_000}\n  def update(self, V, I): pass", "at most 10000 bytes"),
    ("class Estimator:\n  parameters = {'a': 10**400}\n  def update(self, V, I): pass", "fit for JSON"),
    ("class Estimator:\n  parameters = eval('{1:' * 30 + '1' + '}' * 30)\n  def update(self): pass", "nested deeper"),
    ("class Estimator:\n  parameters = {'a': float('nan')}\n  def update(self, V, I): pass", "fit for JSON"),
    ("class Estimator:\n  privileged = 1\n  def update(self, V, I): pass", "privileged must be True or False, got 1"),
    ("import no_such_package", "no_such_package"),
    ("def broken(:", "invalid syntax"),
])
def test_files_that_are_no_baselines(source, message, tmp_path):
    """The message names the file and what it lacks."""
    path = tmp_path / "mine.py"
    path.write_text(source)
    with pytest.raises(ValueError, match=message) as caught:
        load_method(str(path), "estimation")
    assert str(path) in str(caught.value)


def test_unknown_baselines():
    """A name that is none of ours: the message lists ours."""
    for name in ("kalman", "no/such/file.py", ""):
        with pytest.raises(ValueError, match=r"one of .*homogeneous.*got"):
            load_method(name, "estimation")


@pytest.mark.parametrize(("docstring", "title"), [
    ('"""My filter: quick."""', "My filter"), ('"""My filter (v2)."""', "My filter"), ('"""My filter. Quick."""',
    "My filter"), ('"""\nMy filter\n\nLong story.\n"""', "My filter"), ("", "mine"), ('"""  """', "mine"),
    (f'"""{150 * "x"}"""', 120 * "x")])
def test_titles(docstring, title, tmp_path):
    """The docstring's first line up to a colon, bracket or full stop; without one, the file's name."""
    path = tmp_path / "mine.py"
    path.write_text(docstring + "\nclass Estimator:\n    def update(self, V, I): pass\n")
    assert load_method(str(path), "estimation").title == title


def test_baselines_may_use_dataclasses(tmp_path):
    """A file with deferred annotations and a dataclass, as modern code has them, loads like an imported one."""
    path = tmp_path / "mine.py"
    path.write_text("from __future__ import annotations\nfrom dataclasses import dataclass\n@dataclass\n"
                    "class Estimator:\n    task: object\n    def update(self, V, I): pass\n")
    assert load_method(str(path), "estimation").make(task=3).task == 3
