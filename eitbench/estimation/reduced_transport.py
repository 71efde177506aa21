"""Carrying inflows through a pipe in the few directions that they reach, in any flow of a family
(``docs/methods.md``, 16)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from eitbench import _check

if TYPE_CHECKING:
    from eitbench.physics.transport import Transport

NODES = 8
"""Flows of the family along each parameter, between which a step is interpolated."""
SHOWN = 16
"""States of each episode show the directions, or all if there are fewer."""
CARRIED_ON = 2
"""So many times the directions that are asked for are kept while flows are looked at in turn."""


class ReducedTransport:
    """c⁺ = F(θ) c + Y(θ) u + Y⁺(θ) u⁺ in an orthonormal basis, with u before and u⁺ after the step
    at the inlet.

    A step is a polynomial in the parameters θ of the flow, through the flows at Chebyshev's points;
    the basis holds the strongest directions of what given inflows become in them.

    Parameters
    ----------
    transport_at : callable
        θ (p,) -> the transport in that flow; mesh and inlet are always the same.
    ranges : p pairs
        (lowest, highest) of each parameter; none for a flow that is always the same.
    inflows : (T + 1, n_inlet, N)
        Such as will be carried: of N episodes, zero before.
    directions : int
        q, or as many as there are.
    """

    def __init__(self, transport_at: Callable[[np.ndarray], Transport],
                 ranges: Sequence[tuple[float, float]], inflows: np.ndarray,
                 directions: int = 160) -> None:
        directions = _check.integer("directions", directions, low=1)
        self._axes = [_chebyshev(low, high) for low, high in ranges]
        transports = [transport_at(np.array(theta)) for theta in product(*self._axes)]
        self.inlet = transports[0].inlet
        self.basis = _strongest(transports, inflows, directions)
        """(n, q)"""
        steps = [self._reduced(transport) for transport in transports]
        self._carried, self._before, self._after = map(np.array, zip(*steps, strict=True))

    def _reduced(self, transport: Transport) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """F (q, q), Y and Y⁺ (q, n_inlet)."""
        n, q = self.basis.shape
        inlet = len(self.inlet)
        one = np.eye(inlet)
        none = np.zeros((n, inlet))
        return (self.basis.T @ transport.step(self.basis, np.zeros((inlet, q)), 0.0),
                self.basis.T @ transport.step(none, one, 0.0),
                self.basis.T @ transport.step(none, 0.0, one))

    def carry(self, inflow: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """(T, n) what an inflow (T + 1, n_inlet) becomes, zero before, in flows θ_t (T, p) that
        carry it from t − 1 to t."""
        a = np.zeros(self.basis.shape[1])
        states = np.empty((len(parameters), len(a)))
        for t, theta in enumerate(parameters):
            if t == 0 or (theta != parameters[t - 1]).any():
                F, before, after = self._step(theta)
            a = F @ a + before @ inflow[t] + after @ inflow[t + 1]
            states[t] = a
        carried = states @ self.basis.T
        carried[:, self.inlet] = inflow[1:]
        return carried

    def _step(self, theta: np.ndarray) -> list[np.ndarray]:
        weights = np.ones(1)
        for value, points in zip(theta, self._axes, strict=True):
            weights = np.outer(weights, _lagrange(points, value)).ravel()
        return [np.tensordot(weights, each, 1)
                for each in (self._carried, self._before, self._after)]


def _chebyshev(low: float, high: float) -> np.ndarray:
    if low == high:
        return np.array([low])
    angles = np.pi * (np.arange(NODES) + 0.5) / NODES
    return 0.5 * (low + high) + 0.5 * (high - low) * np.cos(angles)


def _lagrange(points: np.ndarray, x: float) -> np.ndarray:
    """Each point's polynomial, one there and zero at the others, at x."""
    off = (x - points)[:, None] / (points[None] - points[:, None] + np.eye(len(points)))
    np.fill_diagonal(off, 1.0)
    weights: np.ndarray = off.prod(axis=0)
    return weights


def _strongest(transports: Sequence[Transport], inflows: np.ndarray, q: int) -> np.ndarray:
    """(n, q) orthonormal: the strongest directions of what the inflows become."""
    found = np.zeros((transports[0].mesh.n_nodes, 0))
    for transport in transports:
        seen = np.hstack([found, *_carried(transport, inflows)])
        squares, right = np.linalg.eigh(seen.T @ seen)
        kept = squares > 1e-12 * squares[-1]
        found = seen @ right[:, kept][:, :-CARRIED_ON * q - 1:-1]
    basis: np.ndarray = np.linalg.qr(found[:, :q])[0]
    return basis


def _carried(transport: Transport, inflows: np.ndarray) -> list[np.ndarray]:
    """States (n, N) of N episodes, some steps apart."""
    c = np.zeros((transport.mesh.n_nodes, inflows.shape[2]))
    every = max(1, (len(inflows) - 1) // SHOWN)
    states = []
    for t in range(1, len(inflows)):
        c = transport.step(c, inflows[t - 1], inflows[t])
        if t % every == 0:
            states.append(c)
    return states
