"""Growth of cost with size: `python benchmarks/run.py scaling` measures, fits exponents and draws
`scaling.png`."""

from __future__ import annotations

import copy
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from common import best_of, in_fresh_process, peak_growth
from forward import conductivities, electrode_model, forget, pipe_mesh
from pipe_record import STEPS, WARM_UP, problem
from stepping import COUNTS, environments

from eitbench._files import write_atomically
from eitbench.estimation import kalman_filter

EIT_CELLS = ((5, 13), (7, 20), (11, 32), (16, 48), (23, 68))
"""cells at an electrode and across: 4,300 to 100,000 unknowns"""
FLOW_CELLS = ((44, 10), (62, 15), (83, 23), (124, 31))
"""cells along and across: 495 to 4,000 nodes"""


@dataclass
class Curve:
    """Curve y(x) in a double logarithmic plot; curves of one ``column`` share a column."""

    column: str
    label: str
    x_label: str
    y_label: str
    x: list[float]
    y: list[float]

    @property
    def exponent(self) -> float:
        """Exponent p of y ∝ xᵖ, by least squares in the logarithms."""
        return float(np.polyfit(np.log(self.x), np.log(self.y), 1)[0])


def curves() -> Iterator[Curve]:
    """Time and memory of the forward model, the filter and the environments."""
    for column, x_label, label, measure, sizes in (
            ("Complete electrode model", "unknowns", "all injections of a state", forward_model,
             EIT_CELLS), ("Kalman filter, m = 16", "nodes", "a step", kalman_step, FLOW_CELLS)):
        x, seconds, memory = (list(values) for values in
                              zip(*(in_fresh_process(measure, cells) for cells in sizes),
                                  strict=True))
        yield Curve(column, label, x_label, "time in ms", x, [1e3 * value for value in seconds])
        yield Curve(column, "with the model, peak", x_label, "memory in MB", x,
                    [1e-6 * value for value in memory])
    for kind, rates, memory in environments():
        counts = [float(count) for count in COUNTS]
        yield Curve("Environments", kind, "environments", "steps per second", counts, rates)
        yield Curve("Environments", kind, "environments", "memory in MB", counts,
                    [1e-6 * value for value in memory])


def forward_model(cells: tuple[int, int]) -> tuple[float, float, float]:
    """Return the number of unknowns, seconds of `transfer_resistance`, and peak bytes of model
    setup and one solution."""
    small = pipe_mesh(1, 2)
    # load kernels and libraries first
    electrode_model(small).transfer_resistance(conductivities(small, 1)[0])
    models = []

    def build() -> None:
        mesh = pipe_mesh(*cells)
        models.append((electrode_model(mesh), conductivities(mesh, 1)[0]))
        models[0][0].transfer_resistance(models[0][1])

    memory = peak_growth(build)
    cem, sigma = models[0]
    return cem.n_unknowns, best_of(lambda: forget(cem).transfer_resistance(sigma), 15), memory


def kalman_step(cells: tuple[int, int]) -> tuple[float, float, float]:
    """Return the number of nodes, seconds of a step after the rank has converged, and bytes of the
    model F, s, Π and the arrays of one step."""
    record = problem(cells)
    ours = copy.copy(record.start)
    kalman_filter(ours, record.observations[:WARM_UP])

    def steps() -> None:
        kalman_filter(copy.copy(ours), record.observations[WARM_UP:])

    covariance = record.start.covariance.open_loop
    held = (record.motion.transition.nbytes + covariance.limit.nbytes
            + sum(U.nbytes for U, _ in covariance._transients))
    seconds = best_of(steps, 5) / STEPS
    step = peak_growth(lambda: kalman_filter(copy.copy(ours), record.observations[-1:]))
    return record.n, seconds, held + step


def draw(curves: list[Curve], path: Path) -> None:
    """Draw a column of panels for each quantity, time above memory."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter, NullLocator, StrMethodFormatter
    columns = list(dict.fromkeys(curve.column for curve in curves))
    figure, axes = plt.subplots(2, len(columns), figsize=(4.2 * len(columns), 6.4), squeeze=False,
                                layout="constrained")
    for column, panels in zip(columns, axes.T, strict=True):
        panels[0].set_title(column)
        ours = [curve for curve in curves if curve.column == column]
        for ax, y_label in zip(panels, dict.fromkeys(curve.y_label for curve in ours), strict=True):
            drawn = [curve for curve in ours if curve.y_label == y_label]
            for number, curve in enumerate(drawn):
                x, y = np.array(curve.x), np.array(curve.y)
                level = np.exp(np.log(y).mean() - curve.exponent * np.log(x).mean())
                ax.loglog(x, level * x**curve.exponent, color=f"C{number}", linewidth=1, alpha=0.5)
                ax.loglog(x, y, "o", color=f"C{number}",
                          label=f"{curve.label}, exponent {curve.exponent:.2f}")
            if len(drawn) > 1:                                # room for the legend
                ax.set_ylim(top=4 * max(max(curve.y) for curve in drawn) * len(drawn))
            ax.set_xlabel(drawn[0].x_label)
            ax.set_ylabel(y_label)
            ax.set_xticks(x, [f"{value:,.0f}" for value in x], fontsize=8)
            ax.xaxis.set_minor_locator(NullLocator())
            ax.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
            ax.yaxis.set_minor_formatter(NullFormatter())
            ax.grid(True, which="both", color="0.9", linewidth=0.6)
            ax.legend(frameon=False, fontsize=8)
    data = io.BytesIO()
    figure.savefig(data, dpi=150)
    plt.close(figure)
    write_atomically(path, data.getvalue())
