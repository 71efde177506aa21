"""What past inflows leave in a pipe, in a flow that stays or changes (``docs/methods.md``, 10)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import svd, toeplitz

if TYPE_CHECKING:
    from eitbench.estimation.inflow_prior import InflowPrior
    from eitbench.physics.transport import Transport

DECAY_TOLERANCE = 0.01
"""The pipe has forgotten an inflow of which less than this part is left, in the Frobenius norm."""
MAX_RESPONSE_STEPS = 400
"""Steps after which it has to be forgotten."""
RANK_RTOL = 1e-3
"""Directions that past inflows reach this much less than the first are left out."""


class ImpulseResponse(NamedTuple):
    """c_t = level + basis · Σ_k weights_k (c_in,t−k − level): what past inflows leave in a pipe."""

    basis: np.ndarray
    """(n, q) orthonormal: concentrations that inflows can make"""
    weights: np.ndarray
    """(q, K, n_inlet) of the inflow k = 0 … K − 1 steps ago in the basis: Fᵏ Y in a steady flow"""


@lru_cache(maxsize=4)
def steady_response(transport: Transport) -> ImpulseResponse:
    """Of a flow that stays as it is; ``ValueError`` if it never forgets what flowed in."""
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
    """Of the states t = 1 … n_steps in a flow that is ``transport_at(t)`` in the step to t, and was
    as in the first step before; all in one basis, and of as many steps as the first flow needs to
    forget an inflow.

    ``ValueError`` if that never forgets what flowed in.
    """
    n = transport_at(1).mesh.n_nodes
    squared = np.zeros((n, n))
    for parts in _changing(transport_at, n_steps):
        together = np.concatenate(parts, axis=1)
        squared += together @ together.T
    basis = _leading(squared)
    # twice the same, since all of them would need gigabytes
    return [_projected(parts, basis) for parts in _changing(transport_at, n_steps)]


def reduced_response(response: ImpulseResponse, prior: InflowPrior, modes: int) -> ImpulseResponse:
    """The same in so many directions, or all if there are fewer: those in which inflows of the
    prior move the concentration most, strongest first.

    Those are the eigenvectors of B Γ_c Bᵀ with Γ_c the covariance of Σ_k W_k E x_{t−k}: that of the
    concentration as far as it is linear in x.
    """
    q, K, _ = response.weights.shape
    root = np.linalg.cholesky(toeplitz(prior.time_covariance(K)))
    by_x = response.weights @ prior.modes                                            # (q, K, r)
    moves = np.tensordot(by_x, root, (1, 0)).reshape(q, -1)
    directions = svd(moves, full_matrices=False)[0][:, :modes]
    return ImpulseResponse(response.basis @ directions,
                           np.tensordot(directions.T, response.weights, 1))


def one_step_response(transport: Transport) -> np.ndarray:
    """Y (n, n_inlet): what an inflow leaves by the end of the step in which it comes."""
    inlet = len(transport.inlet)
    return transport.step(np.zeros((transport.mesh.n_nodes, inlet)), 0.0, np.eye(inlet))


def _changing(transport_at: Callable[[int], Transport],
              n_steps: int) -> Iterator[list[np.ndarray]]:
    """What the inflows k = 0, 1, … steps before t leave of themselves (n, n_inlet), t = 1, 2, …"""
    parts = _steady(transport_at(1))
    yield parts
    for t in range(2, n_steps + 1):
        transport = transport_at(t)
        older = np.concatenate(parts[:-1], axis=1)
        moved = transport.step(older, older[transport.inlet], 0.0)
        parts = [one_step_response(transport), *np.split(moved, len(parts) - 1, axis=1)]
        yield parts


def _steady(transport: Transport) -> list[np.ndarray]:
    """Fᵏ Y (n, n_inlet) each, k = 0, 1, … until it is forgotten."""
    F, Y = transport.transition()
    if not Y.shape[1]:
        raise ValueError("the transport must have an inlet, got one without")
    parts = [Y]
    while np.linalg.norm(parts[-1]) > DECAY_TOLERANCE * np.linalg.norm(Y):
        if len(parts) == MAX_RESPONSE_STEPS:
            raise ValueError("the transport must forget an inflow within "
                             f"{MAX_RESPONSE_STEPS} steps")
        parts.append(F @ parts[-1])
    return parts


def _leading(squared: np.ndarray) -> np.ndarray:
    """(n, q) the directions that matter of M for M Mᵀ."""
    squares, directions = np.linalg.eigh(squared)
    return directions[:, squares > RANK_RTOL**2 * squares[-1]]


def _projected(parts: list[np.ndarray], basis: np.ndarray) -> ImpulseResponse:
    weights = basis.T @ np.concatenate(parts, axis=1)
    return ImpulseResponse(basis, weights.reshape(basis.shape[1], len(parts), parts[0].shape[1]))
