"""Transverse pairs: round-robin over diagonal pairs; a budget is used at equal intervals."""

from eitbench.estimation.onboard.policies import CyclePolicy

AXIAL_OFFSET = 3
"""Downstream offset of the sink electrode, in electrodes."""


class Policy(CyclePolicy):
    def electrodes(self) -> list[tuple[int, int]]:
        half = self.rules.world.currents.shape[1] // 2
        return [(i, half + (i + AXIAL_OFFSET) % half) for i in range(half)]
