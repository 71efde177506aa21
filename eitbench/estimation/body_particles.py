"""Particle filters of the positions of moving bodies, for batches of episodes."""

from __future__ import annotations

import math
from copy import copy, deepcopy
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from eitbench.estimation.body_motion import SPACING, body_motion
from eitbench.numerics.compiled import compiled_kernels
from eitbench.numerics.fem import mass_matrix
from eitbench.physics.observation import ObservationModel
from eitbench.worlds.bodies import DISC_POINTS, DISC_WEIGHTS, TRANSITION_WIDTH, disc_indicator
from eitbench.worlds.task import Estimate, Task

POSITION_JITTER = 1e-3
"""m, standard deviation of the movement of a resampled particle."""
AREA_WALK = 0.02
"""Standard deviation per step of the logarithm of a particle's area."""
PROPOSED_ENTRIES = 0.5
"""Fraction of the absent particles that enter in a time step. Weights correct for the true rate,
with which few particles would find a body that has just entered."""
PARTICLES = 2048
SWEEPS = 2
"""Number of sweeps over the bodies at each measurement."""
SEED = 0


class Particles(NamedTuple):
    """Particles of B episodes."""

    centres: np.ndarray
    """(B, P, 2) m"""
    velocities: np.ndarray
    """(B, P, 2) m/s relative to the liquid"""
    areas: np.ndarray
    """(B, P) area of the body relative to the mean one"""
    present: np.ndarray
    """(B, P) bool: whether the body is in the vessel"""


class Injection(NamedTuple):
    """Injections of B episodes."""

    currents: np.ndarray
    """(B, L) A (A/m in 2D)"""
    electrodes: np.ndarray
    """(B, m) that contain the measured ones"""
    used: np.ndarray
    """(B, m) bool: whether an electrode is measured"""


class BodyModel:
    """Motion, signals and images of a body, shared by all episodes of a task.

    The signal of a disc is the linearised one times the ratio 2/(1 + k) of an exact and a
    linearised dipole, with k the ratio of the conductivities, and proportional to its area. With
    the best area it is within 6 % of the complete electrode model up to three radii from the wall,
    and within 12 % at half of that.
    """

    def __init__(self, task: Task) -> None:
        assert task.body is not None, "the task must have a body"
        self.target = target = task.body
        observation, mesh = task.observation, task.mesh
        self.noise, self.motion = task.noise, body_motion(task)
        self.radius = float(np.mean(target.radius_range))
        axes = (SPACING * (np.arange(count) - origin)
                for count, origin in zip(self.motion.shape, self.motion.origin, strict=True))
        grid = self.motion.within(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
        discs = np.array([disc_indicator(mesh.points, centre, self.radius, TRANSITION_WIDTH)
                          for centre in grid])
        # a coarse mesh distorts the area of a small disc
        area = mass_matrix(mesh).sum(axis=0)
        discs *= (math.pi * self.radius**2 / (discs @ area))[:, None]
        contrast = target.concentration / target.background - 1.0
        liquid = np.full(mesh.n_nodes, task.expected_concentration)
        self.resistance = observation.resistance_derivatives(liquid)[0]
        self.signals = np.ascontiguousarray(
            2.0 * contrast / (2.0 + contrast) * self._linearised(observation, grid))
        """(L², G) change of 𝓡 by a disc at each grid point"""
        discs[discs < 1e-3] = 0.0
        self.images = sp.csc_array((contrast * target.background * discs).T)
        """(n, G) change of the concentration by a disc at each grid point in mol/m³"""
        self.log_area_std = (math.log(target.radius_range[1] / target.radius_range[0])
                             / math.sqrt(3.0))

    def __deepcopy__(self, memo: dict[int, Any]) -> BodyModel:
        return self

    def _linearised(self, observation: ObservationModel, grid: np.ndarray) -> np.ndarray:
        """Return the derivatives (L², G) of 𝓡 by the logarithm of the conductivity in discs about
        the grid points, from its density in space: a coarse mesh distorts a small disc."""
        cem = observation.cem
        conductivity = observation.conductivity(np.full(cem.mesh.n_nodes, self.target.background))
        derivatives = cem.transfer_resistance_derivatives(conductivity)[1]
        by_node = derivatives.reshape(len(conductivity), -1)
        density = conductivity[0] * by_node / mass_matrix(cem.mesh).sum(axis=0)[:, None]
        area = math.pi * self.radius**2
        return area * sum(weight * (cem.mesh.interpolation_to(grid + self.radius * point) @ density)
                          for weight, point in zip(DISC_WEIGHTS, DISC_POINTS, strict=True)).T

    def draw(self, random: np.random.Generator, count: int) -> tuple[np.ndarray, ...]:
        """Draw centres, velocities and areas of particles at the start, (count, …)."""
        return self.motion.draw(random, count), *self._draw_rest(random, count)

    def _draw_rest(self, random: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        motion = self.motion
        return (motion.mean_velocity + motion.velocity_std * random.standard_normal((count, 2)),
                np.exp(self.log_area_std * random.standard_normal(count)))

    def move(self, particles: Particles, weights: np.ndarray,
             random: np.random.Generator) -> tuple[Particles, np.ndarray]:
        """Move particles with their weights (B, P) by a time step, with the same random numbers in
        all episodes; return them with their weights, which correct for the proposed entries."""
        centres, velocities, areas, present = particles
        motion = self.motion
        B, P = areas.shape
        noise = random.standard_normal((P, 3))
        velocities = (motion.mean_velocity + motion.decay * (velocities - motion.mean_velocity)
                      + np.sqrt(1.0 - motion.decay**2) * motion.velocity_std * noise[:, :2])
        areas = areas * np.exp(AREA_WALK * noise[:, 2])
        centres, velocities = motion.move(centres, velocities)
        if motion.has_visits:
            draw = np.asarray(random.uniform(size=P))
            entering = ~present & (draw < PROPOSED_ENTRIES)
            ratio = np.where(entering, motion.enter / PROPOSED_ENTRIES,
                             (1.0 - motion.enter) / (1.0 - PROPOSED_ENTRIES))
            weights = np.where(present, weights, ratio * weights)
            weights = weights / weights.sum(axis=1, keepdims=True)
            new = motion.entries(random, P), *self._draw_rest(random, P)
            centres, velocities, areas = (
                np.where(entering.reshape(B, P, *(1,) * (old.ndim - 2)), each, old)
                for old, each in zip((centres, velocities, areas), new, strict=True))
            present = np.where(present, ~motion.leaves(centres, draw), entering)
        return Particles(centres, velocities, areas, present), weights

    def cells(self, particles: Particles) -> tuple[np.ndarray, np.ndarray]:
        """Return the grid points (B, P, 4) around each particle, and their bilinear weights, times
        the area; zero for absent ones."""
        shape = (*particles.areas.shape, 4)
        index, weights = np.empty(shape, dtype=int), np.empty(shape)
        compiled_kernels().bilinear_weights(
            particles.centres.reshape(-1, 2), SPACING, self.motion.origin, self.motion.shape,
            index.reshape(-1, 4), weights.reshape(-1, 4))
        weights *= (particles.areas * particles.present)[..., None]
        return index, weights

    def likelihoods(self, cells: tuple[np.ndarray, np.ndarray], weights: np.ndarray,
                    injection: Injection, residual: np.ndarray,
                    variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the log-likelihoods (B, P) of a ``residual`` (B, m) in V with this noise
        ``variance`` (B, m) for particles in `cells`, and for these ``weights`` (B, P) the mean
        (B, m) and covariance (B, m, m) of what the particles leave of the residual, with noise."""
        log_likelihood, mean = np.zeros(weights.shape), np.zeros(residual.shape)
        S = ~injection.used[:, None] * np.eye(residual.shape[1])
        compiled_kernels().particle_likelihoods(
            self.signals, *cells, weights, *injection, residual, variance,
            self.motion.signal_error, log_likelihood, mean, S)
        return log_likelihood, mean, S

    def noise_std(self, voltages: np.ndarray) -> np.ndarray:
        """Return the assumed noise (V) of predicted voltages (..., L), at least a thousandth of the
        largest: voltages near zero would have almost no noise."""
        return np.maximum(self.noise.std(voltages),
                          1e-3 * np.abs(voltages).max(axis=-1, keepdims=True))


class BodyParticles:
    """Particles of one body in B episodes: proposals from the motion with more entries, systematic
    resampling.

    Parameters
    ----------
    model : BodyModel
    episodes : int
        B.
    n_particles : int
    random : Generator
        Its numbers are the same in all episodes.

    Attributes
    ----------
    particles, weights
        Present particles and their weights (B, P).
    """

    def __init__(self, model: BodyModel, episodes: int, n_particles: int,
                 random: np.random.Generator) -> None:
        self.model = model
        P = self.n_particles = n_particles
        centres, velocities, areas = (np.repeat(each[None], episodes, axis=0)
                                      for each in model.draw(random, P))
        self.particles = Particles(centres, velocities, areas, np.ones((episodes, P), dtype=bool))
        self.weights = np.full((episodes, P), 1.0 / P)
        self._density: np.ndarray | None = None

    def repeat(self, count: int) -> BodyParticles:
        """Return ``count`` copies of the first episode."""
        copies = copy(self)
        copies.particles = Particles(*(np.repeat(each[:1], count, axis=0)
                                       for each in self.particles))
        copies.weights = np.repeat(self.weights[:1], count, axis=0)
        return copies

    def move(self, random: np.random.Generator) -> None:
        """Move the particles by a time step."""
        self.particles, self.weights = self.model.move(self.particles, self.weights, random)

    def posterior(self, log_likelihood: np.ndarray) -> np.ndarray:
        """Return the weights (B, P) after a measurement with these log-likelihoods (B, P)."""
        log_weights = np.log(np.maximum(self.weights, 1e-300)) + log_likelihood
        weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def reweight(self, weights: np.ndarray, random: np.random.Generator) -> None:
        """Set the weights (B, P), and resample the episodes with few effective particles."""
        self.weights = weights
        self._density = None
        P = self.n_particles
        offset = random.uniform()
        jitter = POSITION_JITTER * random.standard_normal((P, 2))
        places = (np.arange(P) + offset) / P
        for b in np.flatnonzero((self.weights**2).sum(axis=1) * P > 2.0):
            chosen = np.minimum(np.searchsorted(self.weights[b].cumsum(), places), P - 1)
            for each in self.particles:
                each[b] = each[b].take(chosen, axis=0)
            self.particles.centres[b] += jitter
            self.weights[b] = 1.0 / P

    def _densities(self) -> np.ndarray:
        """Return the posterior means (2, B, G) on the grid of the body's area, and of its square.
        """
        index, shares = self.model.cells(self.particles)
        densities = np.zeros((2, len(self.weights), self.model.signals.shape[1]))
        flat = index.reshape(len(self.weights), -1)
        for density, factor in zip(densities, (1.0, self.particles.areas), strict=True):
            values = shares * (self.weights * factor)[..., None]
            compiled_kernels().scatter(flat, values.reshape(flat.shape), density)
        return densities

    def mean(self, images: sp.csc_array) -> np.ndarray:
        """Return the mean (B, m) of functionals (m, G) of the body's image on the grid."""
        return self._expectations(images, 1)

    def variance(self, images: sp.csc_array) -> np.ndarray:
        """Return the variance (B, m) of functionals (m, G)."""
        variance = self._expectations(images, 2) - self._expectations(images, 1)**2
        return np.maximum(variance, 0.0)

    def _expectations(self, images: sp.csc_array, moment: int) -> np.ndarray:
        """Return the expectation (B, m) of functionals of the body to the power of ``moment``."""
        if self._density is None:
            self._density = self._densities()
        found = np.zeros((len(self.weights), images.shape[0]))
        compiled_kernels().add_columns(images.indptr, images.indices, images.data**moment,
                                       self._density[moment - 1], found)
        return found

    def summary(self) -> np.ndarray:
        """Return the estimated `BODY` of each episode, (B, 9)."""
        centres, velocities, areas, present = self.particles
        weights = self.weights * present
        presence = weights.sum(axis=1, keepdims=True)
        weights = weights[:, None] / np.maximum(presence, 1e-300)[:, None]          # (B, 1, P)
        position, velocity, area = ((weights @ each)[:, 0]
                                    for each in (centres, velocities, areas[..., None]))
        deviation = np.swapaxes(centres - position[:, None], 1, 2)
        covariance = (weights * deviation) @ np.swapaxes(deviation, 1, 2)
        std = np.sqrt(covariance.diagonal(axis1=1, axis2=2))
        correlation = covariance[:, 0, 1] / np.maximum(std.prod(axis=1), 1e-300)
        return np.concatenate([position, velocity, std, correlation[:, None], area, presence],
                              axis=1)


class BodyParticleFilter:
    """Particle filters of B episodes with one or several bodies.

    The concentration of the liquid is known. Signals of bodies add up, and the posterior is
    approximated by a product over the bodies (mean field): the measurement of a body is the voltage
    minus the mean signals of the others, whose variances add to the noise. Each body in turn is
    conditioned on it, `SWEEPS` times.

    Parameters
    ----------
    model : BodyModel
    episodes : int
        B.
    n_particles : int
        Particles of each body.

    Attributes
    ----------
    bodies : list of BodyParticles
    innovation : tuple
        Last innovation (B, m) in V, its covariance (B, m, m) in V², and the mask (B, m) of its
        measured entries.
    """

    def __init__(self, model: BodyModel, episodes: int, n_particles: int = PARTICLES) -> None:
        self.model = model
        self._random = np.random.default_rng(SEED)
        self.bodies = [BodyParticles(model, episodes, n_particles, self._random)
                       for _ in range(model.target.n_bodies)]

    def repeat(self, count: int) -> BodyParticleFilter:
        """Return filters of ``count`` copies of the first episode."""
        copies = copy(self)
        copies._random = deepcopy(self._random)
        copies.bodies = [each.repeat(count) for each in self.bodies]
        return copies

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray,
                   measured: np.ndarray) -> np.ndarray:
        """Predict and condition on voltages (B, L) in V for currents (B, L), where ``measured``
        (B, L); return the innovations (B, L) in predicted standard deviations."""
        model = self.model
        for body in self.bodies:
            body.move(self._random)
        injection = Injection(currents,
                              *measured_first(measured & currents.any(axis=1, keepdims=True)))
        base = (currents[:, None] @ model.resistance)[:, 0]     # one product per episode
        std, residual = (np.take_along_axis(each, injection.electrodes, axis=1)
                         for each in (model.noise_std(base), voltages - base))
        posteriors, innovation, S = self._posteriors(injection, residual, std**2)
        self.innovation = innovation, S, injection.used
        for body, weights in zip(self.bodies, posteriors, strict=True):
            body.reweight(weights, self._random)
        scaled = np.zeros(voltages.shape)
        np.put_along_axis(scaled, injection.electrodes, innovation / np.sqrt(
            S.diagonal(axis1=1, axis2=2)), axis=1)
        return scaled

    def _posteriors(self, injection: Injection, residual: np.ndarray, noise: np.ndarray,
                    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """Return the weights (B, P) of each body after a measurement of the ``residual`` (B, m) in
        V with the variance ``noise`` (B, m), and its innovation and covariance."""
        likelihoods = self.model.likelihoods
        weights = [body.weights for body in self.bodies]
        cells = [self.model.cells(body.particles) for body in self.bodies]
        alone = [likelihoods(*each, injection, residual, noise)
                 for each in zip(cells, weights, strict=True)]
        others = len(alone) - 1
        used = injection.used
        without = np.where(used, noise, 1.0)[..., None] * np.eye(used.shape[1])
        innovation = sum(mean for _, mean, _ in alone) - others * np.where(used, residual, 0.0)
        S = sum(S for *_, S in alone) - others * without
        if not others:
            return [self.bodies[0].posterior(alone[0][0])], innovation, S
        for _ in range(SWEEPS):
            for k, body in enumerate(self.bodies):
                rest, variance = residual, noise
                for _, mean, covariance in alone[:k] + alone[k + 1:]:
                    rest = rest - (residual - mean)
                    variance = variance + (covariance.diagonal(axis1=1, axis2=2) - noise)
                weights[k] = body.posterior(
                    likelihoods(cells[k], body.weights, injection, rest, variance)[0])
                alone[k] = likelihoods(cells[k], weights[k], injection, residual, noise)
        return weights, innovation, S

    def mean(self, images: sp.csc_array) -> np.ndarray:
        """Return the mean (B, m) of functionals (m, G) of the bodies' image on the grid."""
        return np.asarray(sum(body.mean(images) for body in self.bodies))

    def variance(self, images: sp.csc_array) -> np.ndarray:
        """Return the variance (B, m) of functionals (m, G)."""
        return np.asarray(sum(body.variance(images) for body in self.bodies))

    def summaries(self) -> np.ndarray:
        """Return the estimated `BODY` of each body in each episode, (B, bodies, 9)."""
        return np.stack([body.summary() for body in self.bodies], axis=1)


def measured_first(measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return electrodes (B, m) that contain the measured ones of a mask (B, L), with m as small as
    possible, and their mask (B, m)."""
    m = max(1, measured.sum(axis=1).max())
    electrodes = np.argsort(~measured, axis=1, kind="stable")[:, :m]
    return electrodes, np.take_along_axis(measured, electrodes, axis=1)


class BodyTracker:
    """Particle filter of one episode, for `FilterEstimator`; NaN voltages are not measured."""

    def __init__(self, task: Task) -> None:
        self._level = task.expected_concentration
        self._filter = BodyParticleFilter(body_model(task), 1)

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray) -> None:
        """Advance one time step and use its voltages (L,) in V for currents (L,)."""
        self._filter.assimilate(voltages[None], currents[None], np.isfinite(voltages)[None])

    def estimate(self, lag: int = 0) -> Estimate:
        """Return the present state; ``ValueError`` for an earlier one."""
        if lag:
            raise ValueError(f"lag must be 0 for a particle filter, got {lag}")
        found, images = self._filter, self._filter.model.images
        innovation, S, _ = found.innovation
        return Estimate(self._level + found.mean(images)[0], found.variance(images)[0],
                        innovation[0], S[0])


@lru_cache(maxsize=4)
def body_model(task: Task) -> BodyModel:
    """Return the model of a task's body, built once per process."""
    return BodyModel(task)
