"""`eitbench fit prior`, `fit model`: filters can read the files, and only training episodes are used."""

import numpy as np
import pytest
from eitbench.bench.methods import baseline_folder
from eitbench.estimation import InflowPrior

from commands import eitbench


@pytest.mark.parametrize("name", ["pipe2d-linear", "pipe2dintermittent-logarithm"])
def test_shipped_priors_are_what_the_command_writes(tmp_path, name):
    """The source in the file reproduces it to nine digits."""
    shipped = InflowPrior.load(baseline_folder() / "priors" / f"{name}.json")
    source = shipped.source
    quiet = ["--quiet", source["quiet"]] if "quiet" in source else []
    code, _, err = eitbench("fit", "prior", "--env", source["environment"], "--seeds", source["seeds"],
                            "--link", shipped.link, "--nugget", source["nugget"], *quiet, "--out",
                            tmp_path / "again.json")
    assert code == 0, err
    again = InflowPrior.load(tmp_path / "again.json")
    np.testing.assert_allclose(again.correlation, shipped.correlation, atol=1e-8)
    np.testing.assert_allclose(again.modes @ again.modes.T, shipped.modes @ shipped.modes.T, atol=1e-8)
    assert again.regimes == shipped.regimes and again.source == {"kept": 1e-4} | source


@pytest.mark.parametrize("arguments, message", [
    (["--env", "eitbench/Pipe2D-v0", "--seeds", "test:0-3"], "seeds must be of the split train"),
    (["--env", "eitbench/RotatingTank2D-v0"], "target must have an inflow"),
    (["--env", "eitbench/Nowhere-v0"], "env must be one of"),
])
@pytest.mark.parametrize("command", ["prior", "model"])
def test_errors_precede_all_writing(tmp_path, command, arguments, message):
    code, _, err = eitbench("fit", command, *arguments, "--out", tmp_path / "mine")
    assert code == 2 and message in err
    assert not (tmp_path / "mine").exists()
