"""Particle filters of the positions of moving bodies, for batches of episodes."""

from __future__ import annotations

import math
from copy import copy, deepcopy
from functools import lru_cache
from itertools import permutations
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
"""Number of particles with one body; with K bodies it is 4^(K − 1) times this number."""
RESTART_STRIDE, RESTART_WEIGHT = 16, 1e-3
"""With several bodies, one of a particle's bodies jumps to any place in every 16th particle at each
time step. These particles have this weight together, so that lost bodies are found again."""
MAX_DISTANCE = 0.1
"""m, largest distance between two estimates of a body, for the order of the bodies."""
SEED = 0


class Particles(NamedTuple):
    """Particles of B episodes; each is a state of all K bodies."""

    centres: np.ndarray
    """(B, P, K, 2) m"""
    velocities: np.ndarray
    """(B, P, K, 2) m/s relative to the liquid"""
    areas: np.ndarray
    """(B, P, K) area of each body relative to the mean one"""
    present: np.ndarray
    """(B, P, K) bool: whether each body is in the vessel"""


class BodyModel:
    """Motion, signals and images of bodies, shared by all episodes of a task.

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

    def draw(self, random: np.random.Generator, centres: np.ndarray) -> tuple[np.ndarray, ...]:
        """Draw velocities (count, 2) and areas (count,) of bodies at ``centres`` (count, 2); return
        all three."""
        motion = self.motion
        normal = random.standard_normal(centres.shape)
        return (centres, motion.mean_velocity + motion.velocity_std * normal,
                np.exp(self.log_area_std * random.standard_normal(len(centres))))

    def move(self, particles: Particles, weights: np.ndarray,
             random: np.random.Generator) -> tuple[Particles, np.ndarray]:
        """Move particles with their weights (B, P) by a time step, with the same random numbers in
        all episodes; return them with their weights, which correct for the proposed entries."""
        centres, velocities, areas, present = particles
        motion = self.motion
        _, P, K = areas.shape
        noise = random.standard_normal((P, K, 3))
        velocities = (motion.mean_velocity + motion.decay * (velocities - motion.mean_velocity)
                      + np.sqrt(1.0 - motion.decay**2) * motion.velocity_std * noise[..., :2])
        areas = areas * np.exp(AREA_WALK * noise[..., 2])
        centres, velocities = motion.move(centres, velocities)
        if motion.has_visits:
            draw = np.asarray(random.uniform(size=(P, K)))
            entering = ~present & (draw < PROPOSED_ENTRIES)
            ratio = np.where(entering, motion.enter / PROPOSED_ENTRIES,
                             (1.0 - motion.enter) / (1.0 - PROPOSED_ENTRIES))
            weights = normalise(weights * np.where(present, 1.0, ratio).prod(axis=2))
            new = self.draw(random, motion.entries(random, P * K))
            centres, velocities, areas = (
                np.where(entering.reshape(*entering.shape, *(1,) * (old.ndim - 3)),
                         each.reshape(old.shape[1:]), old)
                for old, each in zip((centres, velocities, areas), new, strict=True))
            present = np.where(present, ~motion.leaves(centres, draw), entering)
        moved = Particles(centres, velocities, areas, present)
        return moved, self._restart(moved, weights, random) if K > 1 else weights

    def _restart(self, particles: Particles, weights: np.ndarray,
                 random: np.random.Generator) -> np.ndarray:
        """Let one body of some particles jump, as `RESTART_STRIDE` describes; return the weights
        (B, P)."""
        P, K = particles.areas.shape[1:]
        jumping = np.arange(random.integers(RESTART_STRIDE), P, RESTART_STRIDE)
        body = np.arange(len(jumping)) % K
        drawn = self.draw(random, self.motion.draw(random, len(jumping)))
        for old, new in zip(particles, (*drawn, True), strict=True):
            old[:, jumping, body] = new
        factor = np.full(P, (1.0 - RESTART_WEIGHT) / (1.0 - 1.0 / RESTART_STRIDE))
        factor[jumping] = RESTART_WEIGHT * RESTART_STRIDE
        return normalise(weights * factor)

    def cells(self, particles: Particles) -> tuple[np.ndarray, np.ndarray]:
        """Return the grid points (B, P, 4 K) around the bodies of each particle, and their bilinear
        weights, times the areas; zero for absent ones."""
        shape = (*particles.areas.shape, 4)
        index, weights = np.empty(shape, dtype=int), np.empty(shape)
        compiled_kernels().bilinear_weights(
            particles.centres.reshape(-1, 2), SPACING, self.motion.origin, self.motion.shape,
            index.reshape(-1, 4), weights.reshape(-1, 4))
        weights *= (particles.areas * particles.present)[..., None]
        return index.reshape(*shape[:2], -1), weights.reshape(*shape[:2], -1)

    def noise_std(self, voltages: np.ndarray) -> np.ndarray:
        """Return the assumed noise (V) of predicted voltages (..., L), at least a thousandth of the
        largest: voltages near zero would have almost no noise."""
        return np.maximum(self.noise.std(voltages),
                          1e-3 * np.abs(voltages).max(axis=-1, keepdims=True))


body_model = lru_cache(maxsize=4)(BodyModel)  # built once per process


class BodyParticleFilter:
    """Particle filters of B ``episodes`` with K bodies: proposals from the motion with more
    entries, systematic resampling. The concentration of the liquid is known, and signals of bodies
    add up. ``n_particles`` is the number with one body; see `PARTICLES`.

    Attributes
    ----------
    particles, weights
        Present particles and their weights (B, P). The random numbers are the same in all episodes.
    innovation : tuple
        Last innovation (B, m) in V, its covariance (B, m, m) in V², and the mask (B, m) of its
        measured entries.
    """

    def __init__(self, model: BodyModel, episodes: int, n_particles: int = PARTICLES) -> None:
        self.model = model
        self._random = np.random.default_rng(SEED)
        K = model.target.n_bodies
        P = self.n_particles = n_particles * 4 ** (K - 1)
        drawn = model.draw(self._random, model.motion.draw(self._random, P * K))
        states = (each.reshape(P, K, *each.shape[1:]) for each in drawn)
        centres, velocities, areas = (np.repeat(each[None], episodes, axis=0) for each in states)
        self.particles = Particles(centres, velocities, areas, np.full(areas.shape, True))
        self.weights = np.full((episodes, P), 1.0 / P)
        self._density: np.ndarray | None = None

    def repeat(self, count: int) -> BodyParticleFilter:
        """Return filters of ``count`` copies of the first episode."""
        copies = copy(self)
        copies._random = deepcopy(self._random)
        copies.particles = Particles(*(np.repeat(each[:1], count, axis=0)
                                       for each in self.particles))
        copies.weights = np.repeat(self.weights[:1], count, axis=0)
        return copies

    def assimilate(self, voltages: np.ndarray, currents: np.ndarray,
                   measured: np.ndarray) -> np.ndarray:
        """Predict and condition on voltages (B, L) in V for currents (B, L), where ``measured``
        (B, L); return the innovations (B, L) in predicted standard deviations."""
        model = self.model
        self.particles, self.weights = model.move(self.particles, self.weights, self._random)
        electrodes, used = measured_first(measured & currents.any(axis=1, keepdims=True))
        base = (currents[:, None] @ model.resistance)[:, 0]     # one product per episode
        std, residual = (np.take_along_axis(each, electrodes, axis=1)
                         for each in (model.noise_std(base), voltages - base))
        log_likelihood, innovation = np.zeros(self.weights.shape), np.zeros(residual.shape)
        S = ~used[:, None] * np.eye(used.shape[1])
        compiled_kernels().particle_likelihoods(
            model.signals, *model.cells(self.particles), self.weights, currents, electrodes, used,
            residual, std**2, model.motion.signal_error, log_likelihood, innovation, S)
        self.innovation = innovation, S, used
        log_weights = np.log(np.maximum(self.weights, 1e-300)) + log_likelihood
        weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
        self.reweight(normalise(weights))
        scaled = np.zeros(voltages.shape)
        np.put_along_axis(scaled, electrodes, innovation / np.sqrt(
            S.diagonal(axis1=1, axis2=2)), axis=1)
        return scaled

    def reweight(self, weights: np.ndarray) -> None:
        """Set the weights (B, P), and resample the episodes with few effective particles."""
        self.weights = weights
        self._density = None
        P = self.n_particles
        offset = self._random.uniform()
        jitter = POSITION_JITTER * self._random.standard_normal(self.particles.centres.shape[1:])
        places = (np.arange(P) + offset) / P
        for b in np.flatnonzero((self.weights**2).sum(axis=1) * P > 2.0):
            chosen = np.minimum(np.searchsorted(self.weights[b].cumsum(), places), P - 1)
            for each in self.particles:
                each[b] = each[b].take(chosen, axis=0)
            self.particles.centres[b] += jitter
            self.weights[b] = 1.0 / P
        if self.model.target.n_bodies > 1:
            self._order_bodies()

    def _order_bodies(self) -> None:
        """Order the bodies of each particle as in the particle with the largest weight: particles
        with different orders would have no mean positions."""
        centres, _, _, present = self.particles
        K = present.shape[2]
        best = np.arange(len(centres))[:, None], self.weights.argmax(axis=1)[:, None]
        reference, in_reference = centres[best][:, :, None], present[best][:, :, None]
        distance = ((centres[..., None, :] - reference)**2).sum(axis=-1)            # (B, P, K, K)
        cost = np.where(present[..., None] & in_reference, np.minimum(distance, MAX_DISTANCE**2),
                        MAX_DISTANCE**2 * (present[..., None] ^ in_reference))
        orders = np.array(list(permutations(range(K))))
        order = orders[cost[:, :, orders, np.arange(K)].sum(axis=-1).argmin(axis=-1)]
        self.particles = Particles(*(np.take_along_axis(
            each, order.reshape(*order.shape, *(1,) * (each.ndim - 3)), axis=2)
            for each in self.particles))

    def _densities(self) -> np.ndarray:
        """Return the posterior means (2, B, G) on the grid of the bodies' areas, and of their
        squares."""
        index, shares = self.model.cells(self.particles)
        areas = self.particles.areas
        densities = np.zeros((2, len(self.weights), self.model.signals.shape[1]))
        flat = index.reshape(len(self.weights), -1)
        for density, factor in zip(densities, (1.0, areas), strict=True):
            values = shares.reshape(*areas.shape, 4) * (self.weights[..., None] * factor)[..., None]
            compiled_kernels().scatter(flat, values.reshape(flat.shape), density)
        return densities

    def mean(self, images: sp.csc_array) -> np.ndarray:
        """Return the mean (B, m) of functionals (m, G) of the bodies' image on the grid."""
        return self._expectations(images, 1)

    def variance(self, images: sp.csc_array) -> np.ndarray:
        """Return the variance (B, m) of functionals (m, G), for bodies that do not overlap."""
        variance = self._expectations(images, 2) - self._expectations(images, 1)**2
        return np.maximum(variance, 0.0)

    def _expectations(self, images: sp.csc_array, moment: int) -> np.ndarray:
        """Return the expectation (B, m) of functionals of a body to the power of ``moment``, summed
        over the bodies."""
        if self._density is None:
            self._density = self._densities()
        found = np.zeros((len(self.weights), images.shape[0]))
        compiled_kernels().add_columns(images.indptr, images.indices, images.data**moment,
                                       self._density[moment - 1], found)
        return found

    def summaries(self) -> np.ndarray:
        """Return the estimated `BODY` of each body in each episode, (B, K, 9)."""
        centres, velocities, areas, present = (np.moveaxis(each, 2, 1) for each in self.particles)
        weights = self.weights[:, None] * present                                   # (B, K, P)
        presence = weights.sum(axis=2, keepdims=True)
        weights = (weights / np.maximum(presence, 1e-300))[:, :, None]              # (B, K, 1, P)
        position, velocity, area = ((weights @ each)[:, :, 0]
                                    for each in (centres, velocities, areas[..., None]))
        deviation = np.swapaxes(centres - position[:, :, None], 2, 3)
        covariance = (weights * deviation) @ np.swapaxes(deviation, 2, 3)
        std = np.sqrt(covariance.diagonal(axis1=2, axis2=3))
        correlation = covariance[..., 0, 1] / np.maximum(std.prod(axis=2), 1e-300)
        return np.concatenate([position, velocity, std, correlation[..., None], area, presence],
                              axis=2)


def normalise(weights: np.ndarray) -> np.ndarray:
    """Return weights (B, P) with a sum of one in each episode."""
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


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
