"""Which estimator stands inside an injection environment."""

from __future__ import annotations

from typing import TYPE_CHECKING

from eitbench.estimation.onboard.inflow_operator import InflowFullOperator, InflowOperator
from eitbench.estimation.onboard.joint_operator import JointReducedOperator
from eitbench.estimation.onboard.operator import FullOperator
from eitbench.estimation.onboard.reduced_operator import ReducedOperator

if TYPE_CHECKING:
    from eitbench.estimation.onboard.operator import Operator
    from eitbench.estimation.onboard.rules import Rules

ESTIMATORS = ("reduced", "full", "none")
"""By name: for training, for scores, and nobody."""
OPERATORS: dict[tuple[str, str], type[Operator]] = {
    ("white", "reduced"): ReducedOperator, ("white", "full"): FullOperator,
    ("learned", "reduced"): InflowOperator, ("learned", "full"): InflowFullOperator}
"""By what is believed of the inflow, and by name, where the flow is known."""
JOINT: dict[tuple[str, str], type[Operator]] = {
    ("white", "reduced"): JointReducedOperator, ("white", "full"): FullOperator}
"""The same where the mean of the flow is to be estimated too."""


def operator_type(rules: Rules, estimator: str) -> type[Operator] | None:
    """The estimator of this name under these rules, None for "none"; ``ValueError`` if there is
    none such."""
    if estimator not in ESTIMATORS:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
    if estimator == "none":
        return None
    known = OPERATORS if rules.world.velocity_model is None else JOINT
    if rules.inflow == "learned" and not hasattr(rules.world.target, "draw_inflow"):
        raise ValueError("inflow must be 'white' where nothing flows in, got 'learned' and a "
                         f"target {type(rules.world.target).__name__}")
    if (rules.inflow, estimator) not in known:
        raise ValueError("inflow must be 'white' where the flow is to be estimated too, "
                         f"got {rules.inflow!r}")
    return known[rules.inflow, estimator]
