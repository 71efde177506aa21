"""Recurrent network that corrects the filter with identified flow: trained in a pipe with an
obstacle, where the velocity profile differs from the model's parabola.

The network is as in `learned_correction`, the filter as in `identified_flow`.
"""

from eitbench.estimation import NetworkEstimator


class Estimator(NetworkEstimator):
    subtracks = ("filter",)
    models = "models"
    network_file = "networks/pipe2d-obstacle.npz"
    parameters = {"network": network_file}  # noqa: RUF012 (as a record has it)
