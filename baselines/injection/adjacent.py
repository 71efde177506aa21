"""Adjacent pairs: round-robin over neighbouring electrodes; a budget is used at equal intervals."""

from eitbench.estimation.onboard.policies import CyclePolicy


class Policy(CyclePolicy):
    def electrodes(self) -> list[tuple[int, int]]:
        L = self.rules.world.currents.shape[1]
        return [(i, (i + 1) % L) for i in range(L)]
