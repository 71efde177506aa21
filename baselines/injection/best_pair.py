"""Best fixed pair: the same pair at every step, the best of all pairs on training episodes; a
budget is used at equal intervals."""

from typing import Any

from eitbench.estimation.onboard.policies import CyclePolicy
from eitbench.estimation.onboard.rules import Rules


class Policy(CyclePolicy):
    # Found by `python studies/search_injections.py`; electrodes by world.
    parameters: dict[str, Any] = {  # noqa: RUF012
        "pair": {"Pipe2D": [0, 8], "Pipe2D with faults": [0, 8],
                 "Pipe2D with estimated faults": [0, 8],
                 "Pipe2DIntermittent with a budget": [0, 10],
                 "Pipe2DIntermittent with a budget and a fitted inflow prior": [0, 9],
                 "Pipe2DDriftingVelocity": [7, 9],
                 "RotatingTank2D": [9, 15], "TankTracking": [8, 14],
                 "TankTracking with chosen readings": [8, 14],
                 "SearchAndTrack": [2, 12], "BubbleTracking": [2, 10],
                 "TwoBubbleTracking": [2, 9]},
        "environment_steps": {
            "Pipe2D": 314_880, "Pipe2D with faults": 314_880,
            "Pipe2D with estimated faults": 314_880,
            "Pipe2DIntermittent with a budget": 698_880,
            "Pipe2DIntermittent with a budget and a fitted inflow prior": 698_880,
            "Pipe2DDriftingVelocity": 157_440,
            "RotatingTank2D": 303_360, "TankTracking": 368_640,
            "TankTracking with chosen readings": 368_640,
            "SearchAndTrack": 368_640, "BubbleTracking": 368_640, "TwoBubbleTracking": 368_640}}

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        return cls.parameters["pair"].get(rules.tuning_key) in rules.pairs.tolist()

    def electrodes(self) -> list[list[int]]:
        return [self.parameters["pair"][self.rules.tuning_key]]
