"""The covariance without data, Π⁺ = F Π Fᵀ + Γ_w: what is uncertain when nothing is measured."""

from __future__ import annotations

import numpy as np


class FreeCovariance:
    """Π_t, t = 0, 1, …, from which measurements subtract: P = Π − Z Zᵀ (``docs/methods.md``, 5).

    Π_t depends on no data, so it is computed once and shared by all episodes. It is kept as Π_t =
    Π_∞ + U D Uᵀ with D = diag(±1): what is left of the initial covariance, U ← F U, loses rank
    quickly because the flow carries it away and diffusion smooths it. ``ValueError`` if Π_t has no
    limit.

    Parameters
    ----------
    transition : (n, n)
        F, with spectral radius below one (or F = I without noise, for a target that stands still).
    noise : (n, n)
        Γ_w.
    initial : (n, n), optional
        Γ_{0|0}; by default Π_∞.
    tolerance : float
        Eigenvalues of U D Uᵀ below this part of Π_∞'s largest entry are dropped.
    """

    def __init__(self, transition: np.ndarray, noise: np.ndarray,
                 initial: np.ndarray | None = None, *, tolerance: float = 1e-14) -> None:
        self.scale = 1.0
        self.transition = transition
        self._noise = noise
        self.limit = _stationary(transition, noise)
        self._threshold = tolerance * np.abs(self.limit).max()
        left = (np.zeros((len(noise), 0)), np.zeros(0))
        if initial is not None:
            left = _signed_factor(initial - self.limit, self._threshold)
        self._transients = [left]  # (U, D) at t = 0, 1, …

    def scaled(self, factor: float) -> FreeCovariance:
        """The same sequence times ``factor``, sharing all matrices."""
        other = object.__new__(FreeCovariance)
        other.__dict__ = self.__dict__ | {"scale": self.scale * factor}
        return other

    def apply(self, t: int, X: np.ndarray) -> np.ndarray:
        """Π_t X for X (n, k)."""
        U, signs = self._transient(t)
        return self.scale * (self.limit @ X + U @ (signs[:, None] * (U.T @ X)))

    def apply_noise(self, X: np.ndarray) -> np.ndarray:
        """Γ_w X for X (n,) or (n, k)."""
        return self.scale * (self._noise @ X)

    def diagonal(self, t: int) -> np.ndarray:
        """The variances Π_t holds, (n,)."""
        U, signs = self._transient(t)
        return self.scale * (self.limit.diagonal() + (U**2) @ signs)

    def _transient(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        while len(self._transients) <= t:
            U, signs = self._transients[-1]
            U = self.transition @ U
            if len(self._transients) % 2 and U.shape[1]:
                Q, R = np.linalg.qr(U)
                W, signs = _signed_factor((R * signs) @ R.T, self._threshold)
                U = Q @ W
            self._transients.append((U, signs))
        return self._transients[t]


def _stationary(F: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """The solution of Π = F Π Fᵀ + Γ_w, by doubling the number of steps until nothing is added."""
    total = noise
    power = F
    for _ in range(40):
        added = power @ total @ power.T
        total = total + added
        total = 0.5 * (total + total.T)
        if not np.isfinite(total).all():
            break
        if np.abs(added).max() <= 1e-16 * np.abs(total).max():
            return total
        power = power @ power
    raise ValueError("transition must have a spectral radius below one; the covariance without "
                     "data has no limit")


def _signed_factor(symmetric: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """(U, D) with U diag(D) Uᵀ = symmetric up to eigenvalues of ``threshold``, D = ±1."""
    values, vectors = np.linalg.eigh(0.5 * (symmetric + symmetric.T))
    keep = np.abs(values) > threshold
    return vectors[:, keep] * np.sqrt(np.abs(values[keep])), np.sign(values[keep])
