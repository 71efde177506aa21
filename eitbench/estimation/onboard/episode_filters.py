"""Interface of the filters inside injection environments, and their innovations for scores."""

from __future__ import annotations

import math
from copy import copy
from typing import Any, NamedTuple, Self

import numpy as np

from eitbench.data.episode_cache import score_mass, step_error
from eitbench.estimation.onboard.electrode_faults import BROKEN, LOOSE, ElectrodeFaults
from eitbench.estimation.onboard.linearisation import linearisation_table
from eitbench.estimation.onboard.rules import Rules

BODY = ("x, m", "y, m", "velocity x, m/s", "velocity y, m/s", "std of x, m", "std of y, m",
        "correlation of x and y", "area relative to the mean", "probability of presence")
"""Estimate of a body, given that it is present."""
FAULT_EMA_WEIGHT = 0.2
"""Weight of the last injection in the moving average of the fraction of rejected measurements."""


class Innovation(NamedTuple):
    """Innovation of the m measurements that a filter accepted."""

    value: np.ndarray
    """(m,) ν in V, measured minus predicted"""
    covariance: np.ndarray
    """(m, m) predicted S in V²"""

    @classmethod
    def of(cls, value: np.ndarray, covariance: np.ndarray,
           accepted: np.ndarray) -> Innovation | None:
        """Return the innovation of the ``accepted`` measurements (L,), from ν (L,) and S (L, L);
        None if all were rejected."""
        if not accepted.any():
            return None
        return cls(value[accepted], covariance[np.ix_(accepted, accepted)])


class EpisodeFilters:
    """Filters of B episodes, which start at t = 0 with c_ref of the first frame, and the fault
    scores of their electrodes.

    Parameters
    ----------
    rules : Rules
    frames : (B, K, L)
        Voltages in V of the first frame, the world's cycle.
    """

    filter: Any
    """batch of filters that has `repeat`, except for full filters"""

    def __init__(self, rules: Rules, frames: np.ndarray) -> None:
        B, _, L = frames.shape
        self._rules = rules
        self.faults = (ElectrodeFaults(rules.instrument, (B, L), rules.world.n_steps)
                       if rules.faults == "estimated" else None)
        """None: measurements beyond the gate are rejected"""
        self.table = linearisation_table(rules.world)
        self.indices = self._reference_indices(frames)
        """indices of c_ref in the table"""
        self.c_ref = np.array([self.table.c_ref(k) for k in self.indices])
        """(B,) ĉ_bh in mol/m³"""
        self._start(B)
        for k, currents in enumerate(rules.world.currents):
            self._condition(frames[:, k], np.repeat(currents[None], B, axis=0))
        self._innovations = np.zeros((B, L))
        self._doubt = np.zeros((B, 2, L))

    def _reference_indices(self, frames: np.ndarray) -> list[int]:
        """Return the index of c_ref of each episode in the table, from the first frame."""
        robust = math.isfinite(self._rules.gate) or self.faults is not None
        return self.table.nearest_indices(frames, robust)

    def _start(self, episodes: int) -> None:
        """Create the filters at t = 0."""
        raise NotImplementedError

    def repeat(self, count: int) -> Self:
        """Return filters of ``count`` copies of the first episode, not of full filters."""
        copies = copy(self)
        copies.indices = self.indices[:1] * count
        copies.c_ref, copies._innovations, copies._doubt = (
            np.repeat(each[:1], count, axis=0)
            for each in (self.c_ref, self._innovations, self._doubt))
        copies.filter = self.filter.repeat(count)
        copies.faults = self.faults and self.faults.repeat(count)
        return copies

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Predict and condition on voltages (B, L) in V for currents (B, L) in A (A/m in 2D), all
        zero without an injection."""
        innovations, accepted = self._condition(voltages, currents)
        # Fault scores of each electrode: moving averages of the fraction of rejected measurements
        # at it, and of failed injections through it.
        reading = self._doubt[:, 0]
        driving = self._doubt[:, 1]
        injected = currents.any(axis=1, keepdims=True)
        keeps_last = self._rules.history == "injections"
        self._innovations = np.where(injected | (not keeps_last), innovations, self._innovations)
        failed = ~accepted.any(axis=1, keepdims=True)
        # A failed injection has no information on the measuring electrodes.
        reading += FAULT_EMA_WEIGHT * (injected & ~failed) * (~accepted - reading)
        driving += FAULT_EMA_WEIGHT * (currents != 0.0) * (failed - driving)

    def _condition(self, voltages: np.ndarray,
                   currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predict and condition as `assimilate` does; return the innovations in predicted standard
        deviations and the mask of accepted measurements, both (B, L)."""
        raise NotImplementedError

    def features(self) -> dict[str, np.ndarray]:
        """Return innovations (B, L) in predicted standard deviations, mean and std (B, patches) in
        mol/m³, the fault scores doubt (B, 2, L), and, if estimated, velocity and its std in m/s, or
        `BODY` of each body (B, 9 bodies)."""
        mean, std = self.coarse_grid()
        doubt = self._doubt
        if self.faults is not None:
            doubt = np.moveaxis(self.faults.probabilities[..., [BROKEN, LOOSE]], 2, 1)
        shown = {"innovations": self._innovations.copy(), "mean": mean, "std": std,
                 "doubt": doubt.copy()}
        if (flow := self.velocity()) is not None:
            shown |= {"velocity": flow[0], "velocity_std": flow[1]}
        if (bodies := self.bodies()) is not None:
            shown["body"] = bodies.reshape(len(mean), -1)
        return shown

    def innovations(self) -> list[Innovation | None]:
        """Return the last innovation of each episode, for scores; None without an injection or an
        accepted measurement."""
        raise NotImplementedError

    def coarse_grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation (B, patches) in mol/m³ on the coarse grid."""
        raise NotImplementedError

    def errors(self, moments: np.ndarray, deviations: np.ndarray,
               squares: np.ndarray) -> np.ndarray:
        """Return relative errors (5.12) of the present means, from moments (B, …) after `project`.
        """
        world = self._rules.world
        return step_error(score_mass(world), self.means() - world.background, moments, deviations,
                          squares)

    def means(self) -> np.ndarray:
        """Return estimates (B, n) in mol/m³ on the task's mesh."""
        raise NotImplementedError

    def stds(self) -> np.ndarray:
        """Return standard deviations (B, n) of the estimates in mol/m³."""
        raise NotImplementedError

    def velocity(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return velocity parameters θ and their standard deviations (B, k) in m/s; None if the
        task specifies the velocity."""
        return None

    def bodies(self) -> np.ndarray | None:
        """Return the estimated `BODY` of each body in each episode, (B, bodies, 9); None without.
        """
        return None

    @staticmethod
    def project(rules: Rules, moment: np.ndarray) -> np.ndarray:
        """Return moments (T, n) over the scored region in the form for `errors`; see
        `eitbench.data.episode_cache.ScoreIntegrals`."""
        return np.asarray(moment)
