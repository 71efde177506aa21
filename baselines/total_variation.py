"""Total variation: nonlinear reconstruction of each frame with sharp edges, under the assumption of
a stationary target.

Lagged diffusivity (Vogel & Oman 1996; for EIT Borsic, Graham, Adler & Lionheart 2010). ALPHA was
tuned as in `gauss_newton`, by `studies/tune_reconstruction.py`.
"""

from eitbench import Task
from eitbench.estimation import FrameEstimator, total_variation

ALPHA = 4.0
"""m^(1-d)/(mol/m³)"""
SMOOTHING = 10.0
"""β in mol/m⁴: smaller gradients are penalised by their square"""


class Estimator(FrameEstimator):
    subtracks = ("filter", "smoothing")
    parameters = {"alpha": ALPHA, "smoothing": SMOOTHING}  # noqa: RUF012 (as a record has it)

    def __init__(self, task: Task) -> None:
        super().__init__(task, lambda V, I, start: total_variation(
            task.observation, V, I, task.noise.std(V), task.mesh, ALPHA, SMOOTHING, start))
