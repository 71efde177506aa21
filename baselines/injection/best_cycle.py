"""Best cycle: round-robin over up to four pairs, optimised on training episodes; a budget is used
at equal intervals.

For a body that stays in a tank a pair that rotates around the tank is better. If the electrodes to
measure are chosen, they rotate with it.
"""

from typing import Any

from eitbench.estimation.onboard.policies import CyclePolicy
from eitbench.estimation.onboard.rules import Rules

ROTATION = [sorted((5 * k % 16, (5 * k + 3) % 16)) for k in range(16)]
"""Three electrodes apart, and five further in each step."""
READINGS_ROTATION = [
    [*sorted((5 * k % 16, (5 * k + 4) % 16)), *((5 * k + place) % 16 for place in (12, 8, 9, 2))]
    for k in range(16)]
"""Four electrodes apart, and five further in each step; then the electrodes to measure."""


class Policy(CyclePolicy):
    # Found by `python studies/search_injections.py`; electrodes by world.
    parameters: dict[str, Any] = {  # noqa: RUF012
        "cycle": {"Pipe2D": [[0, 8]], "Pipe2D with faults": [[8, 11], [0, 4], [2, 8], [0, 14]],
                  "Pipe2D with estimated faults": [[0, 8], [2, 8], [0, 11]],
                  "Pipe2DIntermittent with a budget": [[0, 10]],
                  "Pipe2DIntermittent with a budget and a fitted inflow prior": [[0, 9]],
                  "Pipe2DDriftingVelocity": [[7, 8], [1, 7]], "RotatingTank2D": [[9, 15]],
                  "TankTracking": ROTATION, "TankTracking with chosen readings": READINGS_ROTATION,
                  "SearchAndTrack": [[4, 13], [3, 14], [0, 10]],
                  "BubbleTracking": [[2, 10], [4, 12], [2, 10]],
                  "TwoBubbleTracking": [[2, 9], [1, 12], [3, 8]]},
        "environment_steps": {
            "Pipe2D": 346_368, "Pipe2D with faults": 608_768,
            "Pipe2D with estimated faults": 467_072,
            "Pipe2DIntermittent with a budget": 768_768,
            "Pipe2DIntermittent with a budget and a fitted inflow prior": 768_768,
            "Pipe2DDriftingVelocity": 217_792,
            "RotatingTank2D": 333_696, "TankTracking": 712_704,
            "TankTracking with chosen readings": 1_824_768,
            "SearchAndTrack": 712_704, "BubbleTracking": 1_127_424, "TwoBubbleTracking": 546_816}}

    @classmethod
    def suits(cls, rules: Rules) -> bool:
        pairs = rules.pairs.tolist()
        found = cls.parameters["cycle"].get(rules.tuning_key, [[]])
        return all(each[:2] in pairs for each in found)

    def electrodes(self) -> list[list[int]]:
        return self.parameters["cycle"][self.rules.tuning_key]
