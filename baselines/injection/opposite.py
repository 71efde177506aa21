"""Opposite pairs: round-robin over opposite electrodes; a budget is used at equal intervals."""

from eitbench.estimation.onboard.policies import CyclePolicy


class Policy(CyclePolicy):
    def electrodes(self) -> list[tuple[int, int]]:
        half = self.rules.world.currents.shape[1] // 2
        return [(i, half + i) for i in range(half)]
