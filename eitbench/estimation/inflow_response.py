"""Impulse response of a pipe to its inflow, in steady or changing flow (docs/methods.md, 10)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import toeplitz

from eitbench.estimation.inflow_prior import InflowPrior
from eitbench.physics.transport import Transport

DECAY_TOLERANCE = 0.01
"""The response ends where a smaller fraction of an inflow remains, in the Frobenius norm."""
MAX_RESPONSE_STEPS = 400
"""Largest number of steps of a response."""
RANK_RTOL = 1e-3
"""Directions with smaller singular values of the response, relative to the first, are dropped."""


class ImpulseResponse(NamedTuple):
    """Response to past inflows: c_t = c_ref + basis · Σ_k weights_k (c_in,t−k − c_ref)."""

    basis: np.ndarray
    """(n, q) orthonormal basis of the concentrations"""
    weights: np.ndarray
    """(q, K, n_inlet) for the inflow k = 0 … K − 1 steps ago in the basis: Fᵏ Y in steady flow"""


@lru_cache(maxsize=4)
def steady_response(transport: Transport) -> ImpulseResponse:
    """Return the response of a steady flow; ``ValueError`` if it does not decay."""
    parts = _steady(transport)
    together = np.concatenate(parts, axis=1)
    # the smaller of both products holds the singular values
    if together.shape[1] <= len(together):
        squares, right = np.linalg.eigh(together.T @ together)
        keep = squares > RANK_RTOL**2 * squares[-1]
        basis = together @ (right[:, keep] / np.sqrt(squares[keep]))
    else:
        basis = _leading(together @ together.T)
    return _projected(parts, basis)


def time_varying_responses(transport_at: Callable[[int], Transport],
                           n_steps: int) -> list[ImpulseResponse]:
    """Return the responses of the states t = 1 … n_steps in a time-varying flow, in one basis.

    The flow is ``transport_at(t)`` in the step to t, and ``transport_at(1)`` before t = 0. All
    responses are as long as the first one; ``ValueError`` if that does not decay.
    """
    n = transport_at(1).mesh.n_nodes
    squared = np.zeros((n, n))
    for parts in _changing(transport_at, n_steps):
        together = np.concatenate(parts, axis=1)
        squared += together @ together.T
    basis = _leading(squared)
    # computed a second time, since storing all parts would take gigabytes
    return [_projected(parts, basis) for parts in _changing(transport_at, n_steps)]


def reduced_response(response: ImpulseResponse, prior: InflowPrior, modes: int) -> ImpulseResponse:
    """Return the response in at most ``modes`` directions, those with the largest prior variance of
    the concentration, in descending order.

    The directions are the eigenvectors of B Γ_c Bᵀ with Γ_c the covariance of Σ_k W_k E x_{t−k},
    the concentration linearised in x.
    """
    root = np.linalg.cholesky(toeplitz(prior.time_covariance(response.weights.shape[1])))
    past = np.moveaxis(response.weights @ prior.modes, 1, 0)                         # (K, q, r)
    directions = principal_directions(past, root)[:, :modes]
    return ImpulseResponse(response.basis @ directions,
                           np.tensordot(directions.T, response.weights, 1))


def principal_directions(past: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return the principal directions (q, …) of Σ_k past_k x_{t−k}, in descending order, with
    ``past`` (K, q, r) and inflows x of covariance root·rootᵀ in time."""
    moves = np.tensordot(past, root, (0, 0)).reshape(past.shape[1], -1)
    return np.linalg.svd(moves, full_matrices=False)[0]


def one_step_response(transport: Transport) -> np.ndarray:
    """Return Y (n, n_inlet), the response at the end of the step in which an inflow enters."""
    inlet = len(transport.inlet)
    return transport.step(np.zeros((transport.mesh.n_nodes, inlet)), 0.0, np.eye(inlet))


def _changing(transport_at: Callable[[int], Transport],
              n_steps: int) -> Iterator[list[np.ndarray]]:
    """Yield the responses (n, n_inlet) at t to inflows k = 0, 1, … steps before, t = 1, 2, …"""
    parts = _steady(transport_at(1))
    yield parts
    for t in range(2, n_steps + 1):
        transport = transport_at(t)
        older = np.concatenate(parts[:-1], axis=1)
        moved = transport.step(older, older[transport.inlet], 0.0)
        parts = [one_step_response(transport), *np.split(moved, len(parts) - 1, axis=1)]
        yield parts


def _steady(transport: Transport) -> list[np.ndarray]:
    """Return Fᵏ Y (n, n_inlet) for k = 0, 1, … until it has decayed."""
    if not len(transport.inlet):
        raise ValueError("the transport must have an inlet, got one without")
    parts = [one_step_response(transport)]
    while np.linalg.norm(parts[-1]) > DECAY_TOLERANCE * np.linalg.norm(parts[0]):
        if len(parts) == MAX_RESPONSE_STEPS:
            raise ValueError("the transport must have a response that decays within "
                             f"{MAX_RESPONSE_STEPS} steps")
        parts.append(transport.step(parts[-1], parts[-1][transport.inlet], 0.0))
    return parts


def _leading(squared: np.ndarray) -> np.ndarray:
    """Return the leading left singular vectors (n, q) of M for M Mᵀ."""
    squares, directions = np.linalg.eigh(squared)
    return directions[:, squares > RANK_RTOL**2 * squares[-1]]


def _projected(parts: list[np.ndarray], basis: np.ndarray) -> ImpulseResponse:
    weights = basis.T @ np.concatenate(parts, axis=1)
    return ImpulseResponse(basis, weights.reshape(basis.shape[1], len(parts), parts[0].shape[1]))
