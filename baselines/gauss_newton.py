"""Stationary Gauss–Newton: reconstruction of each frame of 16 injections under the assumption of a
stationary target (thesis 5.11).

In the filtering subtrack, the frame consists of the latest 16 injections; in the smoothing subtrack
each state gets the image of the frame that contains it, as in the thesis (Fig. 5.6). ALPHA was
tuned once, on stationary targets from the training seeds, by `studies/tune_reconstruction.py`, to
the smallest mean error on a grid of two values per octave.
"""

from eitbench import Task
from eitbench.estimation import FrameEstimator, gauss_newton
from eitbench.numerics.fem import stiffness_matrix

ALPHA = 0.177
"""1/(mol/m³): weight of the gradient of c relative to voltages in noise standard deviations"""


class Estimator(FrameEstimator):
    subtracks = ("filter", "smoothing")
    parameters = {"alpha": ALPHA}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        penalty = ALPHA**2 * stiffness_matrix(task.mesh)
        super().__init__(task, lambda V, I, start: gauss_newton(
            task.observation, V, I, task.noise.std(V), penalty, start))
