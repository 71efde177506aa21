"""A world checks that its parts are what their protocols ask for."""

from dataclasses import replace

import pytest
from eitbench.worlds.catalogue import PIPE_2D


@pytest.mark.parametrize(("name", "part", "message"), [
    ("vessel", PIPE_2D.flow, "vessel must be a Vessel, with .*; got LaminarFlow without .*electrode_model"),
    ("flow", None, "flow must be a Flow, with .*; got NoneType without .*nominal"),
    ("target", PIPE_2D.vessel, "target must be a Target, with .*; got PlanePipe without .*evolve")])
def test_a_part_without_what_its_protocol_asks_for_is_refused(name, part, message):
    """The message names the part, what came and what is missing."""
    with pytest.raises(ValueError, match=message):
        replace(PIPE_2D, **{name: part})
