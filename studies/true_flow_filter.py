"""Log-inflow filter with the true flow of each step: an oracle for `docs/turbulence.md`.

`eitbench run --isolate none --baseline studies/true_flow_filter.py --env
eitbench/Pipe2DTurbulent-v0` compares it with filters that assume the mean flow: its error is due
to the inflow, not the flow.
"""

from pathlib import Path

from eitbench import Task
from eitbench.estimation import (
    FilterEstimator,
    compatible_priors,
    inflow_filter,
    time_varying_responses,
)

PRIORS = Path(__file__).resolve().parent.parent / "baselines" / "priors"


class Estimator(FilterEstimator):
    subtracks = ("filter",)
    role = "reference"
    privileged = True

    def __init__(self, task: Task, revealed) -> None:
        prior = compatible_priors(PRIORS, task, "logarithm")[0]
        responses = time_varying_responses(revealed.transport, task.n_steps)
        super().__init__(
            task, lambda c_ref: inflow_filter(task, prior, c_ref, responses=responses))
