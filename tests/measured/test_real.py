"""Tanks that somebody measured and photographed: the estimate shows bodies where they stood.

The files are public and not part of this repository; docs/measured-data.md says where they are found.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from eitbench.bench.measured import play_record
from eitbench.bench.measured_cases import read_case
from scipy.ndimage import center_of_mass, label

REAL = os.environ.get("EITBENCH_REAL_FILES")
CASES = Path(__file__).parents[2] / "leaderboards" / "measured"
PHOTOGRAPHS = {
    "kit4-2.3": [(0.063, 0.053, 1), (0.0355, -0.056, 1)], "kit4-4.1": [(-0.009, 0.091, 1), (0.040, -0.035, -1)],
    "kit4-4.4": [(0.069, -0.004, 1), (0.021, -0.057, -1)]}
"""Middles of bodies, in m, read off the photographs of the water's surface to about 2 mm; 1 conducts better."""


@pytest.mark.skipif(not REAL, reason="EITBENCH_REAL_FILES names no folder of real files")
@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_bodies_are_where_the_photograph_has_them(name):
    """Within 1 cm, in a tank of 28 cm."""
    case = read_case(CASES / f"{name}.yml")
    env = case.env(Path(REAL) / "kit4" / Path(case.file).name)
    estimate = np.log(play_record(env, "log_map").mean[-1] / env.task.expected_concentration)
    side = np.linspace(-0.14, 0.14, 141)
    x, y = np.meshgrid(side, side)
    inside = x**2 + y**2 < 0.139**2
    field = np.zeros_like(x)
    field[inside] = env.task.mesh.interpolation_to(np.stack([x[inside], y[inside]], axis=1)) @ estimate
    for at_x, at_y, sign in PHOTOGRAPHS[name]:
        here = np.hypot(x - at_x, y - at_y) < 0.02
        parts, _ = label(sign * field > 0.5 * (sign * field)[here].max())
        row, column = center_of_mass(parts == np.bincount(parts[here & (parts > 0)]).argmax())
        found = -0.14 + 0.002 * np.array([column, row])
        assert np.linalg.norm(found - [at_x, at_y]) < 0.01
