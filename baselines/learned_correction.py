"""Recurrent network that corrects the log-inflow filter: trained on episodes in which the velocity
differs from the model's.

The inputs of the GRU (Cho et al. 2014) are the filter's innovations and its estimates before and
after each measurement vector, in modes of training concentrations. Its outputs are the correction
of the filter in these modes and its variance. `studies/learn.py` trains the network; inference
needs numpy and the network file, which only a checkout contains.
"""

from eitbench.estimation import NetworkEstimator


class Estimator(NetworkEstimator):
    subtracks = ("filter",)
    network_file = "networks/pipe2d-biased.npz"
    parameters = {"network": network_file}  # noqa: RUF012 (as a record has it)
