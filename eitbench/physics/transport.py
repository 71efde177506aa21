"""Convection-diffusion: ∂c/∂t = ∇·(κ∇c) − v·∇c, c given on the inlet, ∂c/∂n = 0 elsewhere (problem.md §1)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import skfem
from skfem.helpers import dot, grad

from eitbench import _check
from eitbench.physics._backend import Backend
from eitbench.physics.fem import element, to_skfem
from eitbench.physics.mesh import Mesh
from eitbench.physics.sparse_lu import SparseLU

VelocityField = Callable[[np.ndarray], np.ndarray]


class EvolutionModel(NamedTuple):
    """c⁺ = F c + Y c_in⁺ + w, with w = Y η + H e (thesis 5.14–5.16); all matrices act on nodal concentrations."""

    F: np.ndarray
    """(n, n) state transition over one time step; it carries the inlet's old value along."""
    Y: np.ndarray
    """(n, n_inlet) effect of the new inlet values."""
    H: np.ndarray
    """(n, n) effect of nodal noise e, the concentration that an unknown source adds over the time step."""

    def state_noise_covariance(self, inflow_variance: float, nodal_variance: float) -> np.ndarray:
        """Γ_w = Y Γ_η Yᵀ + H Γ_e Hᵀ (thesis 5.16) for Γ_η = inflow_variance·I and Γ_e = nodal_variance·I; (n, n)."""
        return inflow_variance * (self.Y @ self.Y.T) + nodal_variance * (self.H @ self.H.T)


class ConvectionDiffusion:
    """One time step of the CD model: P1 elements with SUPG, sub-stepped Crank–Nicolson.

    The SUPG test function φ + τ v·∇φ also weighs the mass matrix, so the scheme is consistent in time. The first
    sub-step is taken as two backward-Euler halves (Rannacher), which damp node-to-node noise that Crank–Nicolson would
    keep; they use the same matrix, so a step costs one factorisation for ever and ``substeps + 1`` solves. Within a
    step the inlet value moves linearly from the old to the new one. Second order in space and in the sub-step; between
    those, at cell Péclet numbers of about 2–8, the order in space sinks to 1.5, as P1 has no ∇·(κ∇c) to weigh. Because
    every step starts anew with the two halves, shorter steps at equal ``substeps`` are first order only.

    Parameters
    ----------
    mesh : Mesh
        2D or 3D.
    velocity : callable
        points (k, d) in m -> velocity (k, d) in m/s, divergence-free.
    diffusivity : float
        κ in m²/s, > 0.
    time_step : float
        Time between two states in s, > 0.
    substeps : int
        Crank–Nicolson steps per time step, ≥ 1.
    inlet : (n_inlet,) int, optional
        Nodes where the concentration is given; default: nodes of the boundary facets through which fluid enters.
    backend : "auto", "compiled" or "scipy"
        What solves; see `eitbench.physics.sparse_lu`.

    Raises
    ------
    ValueError
        Naming the argument, if it is out of range, of the wrong shape, or not finite.
    """

    def __init__(self, mesh: Mesh, velocity: VelocityField, diffusivity: float, time_step: float, *,
                 substeps: int = 8, inlet: np.ndarray | None = None, backend: Backend = "auto") -> None:
        self.mesh = mesh
        self.diffusivity = _check.number("diffusivity", diffusivity, low=0.0, open_low=True, units="m²/s")
        self.time_step = _check.number("time_step", time_step, low=0.0, open_low=True, units="s")
        self.substeps = _check.integer("substeps", substeps, low=1)
        self.inlet = inlet_nodes(mesh, velocity) if inlet is None else np.unique(inlet).astype(np.int64)
        if inlet is not None and np.size(inlet) and not np.issubdtype(np.asarray(inlet).dtype, np.integer):
            raise ValueError(f"inlet must hold integer node numbers, got {np.asarray(inlet).dtype}")
        if self.inlet.size and (self.inlet[0] < 0 or self.inlet[-1] >= mesh.n_nodes):
            raise ValueError(f"inlet must hold node numbers in [0, {mesh.n_nodes - 1}], got {self.inlet}")
        mass, transport = _supg_matrices(mesh, velocity, self.diffusivity)
        dt = self.time_step / self.substeps
        implicit, explicit = mass / dt + 0.5 * transport, mass / dt - 0.5 * transport
        self._free = np.setdiff1d(np.arange(mesh.n_nodes), self.inlet)
        free, inlet_ = self._free, self.inlet
        self._solver = SparseLU(implicit[free][:, free], backend)
        self._explicit = sp.csr_matrix(explicit[free])
        self._implicit_inlet = sp.csr_matrix(implicit[free][:, inlet_])
        self._mass = sp.csr_matrix(mass[free])

    def step(self, c: np.ndarray, inflow_before: np.ndarray | float, inflow_after: np.ndarray | float) -> np.ndarray:
        """The concentration one time step later.

        Parameters
        ----------
        c : (n,) or (n, batch) float
            Nodal concentration; its inlet entries are replaced by ``inflow_before``.
        inflow_before, inflow_after : float, (n_inlet,) or (n_inlet, batch)
            Inlet concentration at the beginning and at the end of the step, in the unit of ``c``.

        Returns
        -------
        Array shaped like ``c``.
        """
        c = np.asarray(c, dtype=float)
        if c.ndim not in (1, 2) or len(c) != self.mesh.n_nodes:
            raise ValueError(f"c must have shape ({self.mesh.n_nodes},) or ({self.mesh.n_nodes}, batch), got {c.shape}")
        state = _check.array("c", c, c.shape).reshape(len(c), -1)
        before = self._inflow("inflow_before", inflow_before, state.shape[1])
        after = self._inflow("inflow_after", inflow_after, state.shape[1])
        return self._advance(state, before, after).reshape(c.shape)

    def evolution_model(self) -> EvolutionModel:
        """F, Y and H of (5.14–5.16) as dense matrices; computed once and kept."""
        return self._evolution_model

    @cached_property
    def _evolution_model(self) -> EvolutionModel:
        n, m = self.mesh.n_nodes, len(self.inlet)
        identity = np.eye(n)
        F = self._advance(identity, identity[self.inlet], np.zeros((m, n)))
        Y = self._advance(np.zeros((n, m)), np.zeros((m, m)), np.eye(m))
        H = self._advance(np.zeros((n, n)), np.zeros((m, n)), np.zeros((m, n)), source=identity / self.time_step)
        for matrix in (F, Y, H):
            matrix.setflags(write=False)                  # shared by all who use this model
        return EvolutionModel(F, Y, H)

    def _advance(self, c: np.ndarray, before: np.ndarray, after: np.ndarray,
                 source: np.ndarray | None = None) -> np.ndarray:
        """All sub-steps on (n, batch) columns, perhaps with a nodal source of so much concentration a second."""
        c = c.copy()
        c[self.inlet] = before
        slope = (after - before) / self.substeps
        load = 0.0 if source is None else self._mass @ source
        rate = self.substeps / self.time_step
        for fraction in (0.5, 1.0):                               # backward Euler, twice half a sub-step
            inlet = before + fraction * slope
            # (2M/Δt + K) c⁺ = (2M/Δt) c + f, divided by two: the Crank–Nicolson matrix again
            right = rate * (self._mass @ c) - self._implicit_inlet @ inlet + 0.5 * load
            c[self._free] = self._solver.solve(right)
            c[self.inlet] = inlet
        for k in range(1, self.substeps):
            inlet = before + (k + 1) * slope
            c[self._free] = self._solver.solve(self._explicit @ c - self._implicit_inlet @ inlet + load)
            c[self.inlet] = inlet
        c[self.inlet] = after
        return c

    def _inflow(self, name: str, value: np.ndarray | float, batch: int) -> np.ndarray:
        value = _check.array(name, value, np.shape(value))
        if value.ndim == 1:
            value = value[:, None]
        try:
            return np.broadcast_to(value, (len(self.inlet), batch))
        except ValueError:
            raise ValueError(f"{name} must be a number or have shape ({len(self.inlet)},) or ({len(self.inlet)}, "
                             f"{batch}), got {value.shape}") from None


def inlet_nodes(mesh: Mesh, velocity: VelocityField) -> np.ndarray:
    """Nodes of the boundary facets through which fluid enters: ∫ v·n < 0 (midpoint rule); (n_inlet,) int."""
    basis = skfem.FacetBasis(to_skfem(mesh), element(mesh.dim, 1), intorder=1)
    x = np.asarray(basis.global_coordinates())
    speed = (_velocity_at(velocity, x) * np.asarray(basis.normals)).sum(axis=0).mean(axis=1)
    facets = basis.find[speed < -1e-12 * max(1e-300, np.abs(speed).max())]
    return np.unique(basis.mesh.facets[:, facets])


def _velocity_at(velocity: VelocityField, x: np.ndarray) -> np.ndarray:
    """The field at quadrature points (d, cells, points), same shape back."""
    points = x.reshape(len(x), -1).T
    value = _check.array("velocity(points)", velocity(points), points.shape, units="m/s")
    return value.T.reshape(x.shape)


def _supg_matrices(mesh: Mesh, velocity: VelocityField, diffusivity: float) -> tuple[sp.csr_array, sp.csr_array]:
    """SUPG mass matrix and transport matrix (n, n): M ċ + K c = 0.

    τ = h/(2|v|)·(coth Pe − 1/Pe) with Pe = |v|h/(2κ) and h the cell's length along the flow (Brooks & Hughes 1982).
    """
    basis = skfem.Basis(to_skfem(mesh), element(mesh.dim, 1), intorder=4)
    v = _velocity_at(velocity, np.asarray(basis.global_coordinates()))
    speed = np.sqrt((v**2).sum(axis=0))
    along = sum(np.abs((v * phi[0].grad).sum(axis=0)) for phi in basis.basis)        # Σᵢ|v·∇φᵢ| = 2|v|/h
    peclet = speed**2 / np.maximum(along * diffusivity, 1e-300)
    upwinding = np.where(peclet > 1e-3, 1.0 / np.tanh(np.maximum(peclet, 1e-3)) - 1.0 / np.maximum(peclet, 1e-3),
                         peclet / 3.0)
    tau = np.where(along > 0, upwinding / np.maximum(along, 1e-300), 0.0)

    @skfem.BilinearForm
    def mass(u, phi, w):
        return u * (phi + w["tau"] * dot(w["v"], grad(phi)))

    @skfem.BilinearForm
    def transport(u, phi, w):
        convection = dot(w["v"], grad(u))
        return diffusivity * dot(grad(u), grad(phi)) + convection * (phi + w["tau"] * dot(w["v"], grad(phi)))

    return (sp.csr_array(mass.assemble(basis, v=v, tau=tau)),
            sp.csr_array(transport.assemble(basis, v=v, tau=tau)))
