"""Convection-diffusion (thesis ch. 3; ``docs/methods.md``, 1).

∂c/∂t = ∇·(κ∇c) − v·∇c, c given on the inlet, ∂c/∂n = 0 elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
import scipy.sparse as sp
import skfem
from skfem.helpers import dot, grad

from eitbench import _check
from eitbench.numerics.compiled import compiled_kernels, scratch
from eitbench.numerics.fem import basis as basis_on
from eitbench.numerics.fem import element, to_skfem
from eitbench.numerics.mesh import Mesh
from eitbench.numerics.sparse_lu import SparseLU

VelocityField = Callable[[np.ndarray], np.ndarray]
MIN_WIDE_COLUMNS = 16
"""Least number of columns for which the kernel of wide batches is used."""


class EvolutionModel(NamedTuple):
    """c⁺ = F c + Y c_in⁺ + w, w = Y η + H e (thesis 5.14–5.16), for nodal concentrations."""

    F: np.ndarray
    """(n, n) state transition over one time step, including the old inlet values."""
    Y: np.ndarray
    """(n, n_inlet) effect of the new inlet values."""
    H: np.ndarray
    """(n, n) effect of nodal noise e, an unknown source during the time step."""

    def state_noise_covariance(self, inflow_variance: float, nodal_variance: float) -> np.ndarray:
        """Return Γ_w = Y Γ_η Yᵀ + H Γ_e Hᵀ (n, n) (thesis 5.16) for Γ = variance · I."""
        return inflow_variance * (self.Y @ self.Y.T) + nodal_variance * (self.H @ self.H.T)


class Transport(Protocol):
    """Evolution of a concentration over a time step: `ConvectionDiffusion` or, in `stationary`,
    `StationaryTransport`."""

    def __hash__(self) -> int: ...

    @property
    def mesh(self) -> Mesh:
        """Mesh of the concentration."""

    @property
    def time_step(self) -> float:
        """Time between two states in s."""

    @property
    def inlet(self) -> np.ndarray:
        """(n_inlet,) int, nodes with a prescribed concentration."""

    def step(self, c: np.ndarray, inflow_before: np.ndarray | float,
             inflow_after: np.ndarray | float) -> np.ndarray:
        """Return the concentration (n,) or (n, batch) after one time step."""

    def evolution_model(self) -> EvolutionModel:
        """Return F, Y and H of (5.14–5.16) as dense matrices."""

    def transition(self) -> tuple[np.ndarray, np.ndarray]:
        """Return F and Y of `evolution_model`."""


class ConvectionDiffusion:
    """Time step of convection-diffusion: P1 elements with SUPG, Crank–Nicolson sub-steps.

    The SUPG test function φ + τ v·∇φ also weights the mass matrix, so that the scheme is consistent
    in time. The first sub-step consists of two backward-Euler half steps (Rannacher), which damp
    node-to-node noise. They have the same matrix, so that a step costs ``substeps + 1`` solves with
    one factorisation. The inlet value is linear in time within a step. The scheme is of second
    order in space and in the sub-step; at cell Péclet numbers of about 2–8 the order in space is
    1.5, because P1 elements have no ∇·(κ∇c). It is of first order for shorter steps at equal
    ``substeps``, because every step begins with the two half steps. ``ValueError`` naming the
    argument if it is out of range, of the wrong shape, or not finite.

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
        Nodes with a prescribed concentration; default: nodes where fluid enters.
    """

    def __init__(self, mesh: Mesh, velocity: VelocityField, diffusivity: float, time_step: float, *,
                 substeps: int = 8, inlet: np.ndarray | None = None) -> None:
        self.mesh = mesh
        self.diffusivity = _check.number("diffusivity", diffusivity, low=0.0, open_low=True,
                                         units="m²/s")
        self.time_step = _check.number("time_step", time_step, low=0.0, open_low=True, units="s")
        self.substeps = _check.integer("substeps", substeps, low=1)
        nodes = np.unique(inlet_nodes(mesh, velocity) if inlet is None else inlet)
        if nodes.size and not np.issubdtype(nodes.dtype, np.integer):
            raise ValueError(f"inlet must hold integer node numbers, got {nodes.dtype}")
        if nodes.size and (nodes[0] < 0 or nodes[-1] >= mesh.n_nodes):
            raise ValueError(f"inlet must hold node numbers in [0, {mesh.n_nodes - 1}], "
                             f"got {nodes}")
        self.inlet = nodes.astype(np.int64)
        self.velocity = velocity
        mass, transport = _supg_matrices(mesh, velocity, self.diffusivity)
        dt = self.time_step / self.substeps
        free = self._free = np.setdiff1d(np.arange(mesh.n_nodes), self.inlet)
        implicit = (mass / dt + 0.5 * transport)[free]
        self._solver = SparseLU(implicit[:, free])
        self._explicit = sp.csr_matrix((mass / dt - 0.5 * transport)[free])
        self._implicit_inlet = sp.csr_matrix(implicit[:, self.inlet])
        self._mass = sp.csr_matrix(mass[free])

    def with_velocity(self, velocity: VelocityField) -> ConvectionDiffusion:
        """Return this model with another velocity and the same inlet nodes."""
        return ConvectionDiffusion(self.mesh, velocity, self.diffusivity, self.time_step,
                                   substeps=self.substeps, inlet=self.inlet)

    def step(self, c: np.ndarray, inflow_before: np.ndarray | float,
             inflow_after: np.ndarray | float) -> np.ndarray:
        """Return the concentration after one time step, in the shape of ``c``.

        Parameters
        ----------
        c : (n,) or (n, batch) float
            Nodal concentration; its inlet entries are replaced by ``inflow_before``.
        inflow_before, inflow_after : float, (n_inlet,) or (n_inlet, batch)
            Inlet concentration at the beginning and at the end of the step, in the unit of ``c``.
        """
        c = np.asarray(c, dtype=float)
        if c.ndim not in (1, 2) or len(c) != self.mesh.n_nodes:
            raise ValueError(f"c must have shape ({self.mesh.n_nodes},) or "
                             f"({self.mesh.n_nodes}, batch), got {c.shape}")
        state = _check.array("c", c, c.shape).reshape(len(c), -1)
        before = self._inflow("inflow_before", inflow_before, state.shape[1])
        after = self._inflow("inflow_after", inflow_after, state.shape[1])
        return self._advance(state, before, after).reshape(c.shape)

    def velocity_derivatives(self, c: np.ndarray, inflow_before: np.ndarray | float,
                             inflow_after: np.ndarray | float,
                             directions: Sequence[VelocityField]) -> tuple[np.ndarray, np.ndarray]:
        """Return the step (n,) and its derivatives (n, K) by θ at θ = 0, for v + Σ θ_k v_k.

        These are exact derivatives of the discrete step, including the velocity dependence of the
        test functions; the inlet nodes are fixed. The cost is the step, the assembly of 2K
        matrices, and a solve with K right-hand sides per sub-step.

        The length of a cell along the flow has a kink where the flow is parallel to a side of the
        cell; the derivative there is the mean of both one-sided derivatives. Where v = 0 it is
        exact along each direction, but the scheme is nonlinear in the direction unless all
        directions are parallel. ``ValueError`` naming the argument if it is of the wrong shape or
        not finite.

        Parameters
        ----------
        c, inflow_before, inflow_after : (n,), float or (n_inlet,)
            As in `step`.
        directions : K callables
            v_k, each points (k, d) in m -> velocity (k, d) in m/s for θ_k = 1, divergence-free.
        """
        if not len(directions):
            raise ValueError("directions must hold at least one velocity field, got none")
        c = _check.array("c", c, (self.mesh.n_nodes,))[:, None]
        before = self._inflow("inflow_before", inflow_before, 1)
        after = self._inflow("inflow_after", inflow_after, 1)
        changes = _supg_derivatives(self.mesh, self.velocity, self.diffusivity, directions)
        substeps = self._substeps(c, before, after, [0.0] * (self.substeps + 1))
        states = np.hstack([state.copy() for state in substeps])
        # A sub-step solves M (c⁺ − c)/Δt + K (c⁺ + c)/2 = 0, backward Euler the same with K c⁺/2.
        # By the product rule what M and K change by is a load in the equation for the derivative.
        differences = (states[:, :-1] - states[:, 1:]) * (self.substeps / self.time_step)
        averages = 0.5 * (states[:, 1:] + states[:, :-1])
        averages[:, :2] = 0.5 * states[:, 1:3]
        loads = np.stack([mass[self._free] @ differences - transport[self._free] @ averages
                          for mass, transport in changes], axis=-1)  # (n_free, solves, K)
        nothing = np.zeros((len(c), len(directions)))
        none_in = nothing[self.inlet]
        *_, derivatives = self._substeps(nothing, none_in, none_in, loads.swapaxes(0, 1))
        return states[:, -1].copy(), derivatives

    def evolution_model(self) -> EvolutionModel:
        """Return F, Y and H of (5.14–5.16) as dense matrices; computed once and cached."""
        return self._evolution_model

    def transition(self) -> tuple[np.ndarray, np.ndarray]:
        """Return F (n, n) and Y (n, n_inlet) of `evolution_model` in half the time; cached."""
        return self._transition

    @cached_property
    def _transition(self) -> tuple[np.ndarray, np.ndarray]:
        n = self.mesh.n_nodes
        m = len(self.inlet)
        identity = np.eye(n)
        F = self._advance(identity, identity[self.inlet], np.zeros((m, n)))
        Y = self._advance(np.zeros((n, m)), np.zeros((m, m)), np.eye(m))
        for matrix in (F, Y):
            matrix.setflags(write=False)                  # shared by all users of this model
        return F, Y

    @cached_property
    def _evolution_model(self) -> EvolutionModel:
        n = self.mesh.n_nodes
        m = len(self.inlet)
        nothing = np.zeros((m, n))
        H = self._advance(np.zeros((n, n)), nothing, nothing, source=np.eye(n) / self.time_step)
        H.setflags(write=False)
        return EvolutionModel(*self._transition, H)

    def _advance(self, c: np.ndarray, before: np.ndarray, after: np.ndarray,
                 source: np.ndarray | None = None) -> np.ndarray:
        """Compute all sub-steps of (n, batch) columns; ``source``: added to c per second."""
        load = None if source is None else self._mass @ source
        if c.shape[1] >= MIN_WIDE_COLUMNS:
            return self._advance_wide(c, before, after, load)
        f = 0.0 if load is None else load
        loads = [0.5 * f, 0.5 * f] + [f] * (self.substeps - 1)
        *_, last = self._substeps(c, before, after, loads)
        return last

    @cached_property
    def _kernel_arguments(self) -> tuple[Any, ...]:
        """Matrices by rows, factors, nodes and rate: arguments of `eitbench.numerics.kernels`."""
        row_perm, columns, lower, upper, scale = self._solver.factors
        matrices = [(each.indptr, each.indices, each.data)
                    for each in (self._mass, self._explicit, self._implicit_inlet)]
        return (*matrices, lower, upper, scale, row_perm, self._free[columns], self.inlet,
                self.substeps, self.substeps / self.time_step)

    def _advance_wide(self, c: np.ndarray, before: np.ndarray, after: np.ndarray,
                      load: np.ndarray | None = None) -> np.ndarray:
        """Compute all sub-steps of (n, batch) columns, with an optional ``load`` (n_free, batch).

        A panel of columns goes through all sub-steps before the next one, so that it stays in the
        CPU cache; each substitution processes the panel at once. The result is bit-identical to
        `_substeps`.
        """
        kernels = compiled_kernels()
        width = kernels.WIDE
        n_free, n_inlet = len(self._free), len(self.inlet)
        rows = np.array([len(c), n_inlet, n_inlet, n_inlet, n_free, n_free])
        memory = scratch(rows.sum() * width).reshape(-1, width)
        blocks = np.split(memory, np.cumsum(rows)[:-1])
        state, first, slope, _, source, _ = blocks
        flat = [block.reshape(-1) for block in blocks]
        result = np.empty(c.shape)
        for begin in range(0, c.shape[1], width):
            panel = slice(begin, begin + width)
            used = slice(min(width, c.shape[1] - begin))
            state[:, used] = c[:, panel]
            state[self.inlet, used] = before[:, panel]
            first[:, used] = before[:, panel]
            slope[:, used] = (after[:, panel] - before[:, panel]) / self.substeps
            if load is not None:
                source[:, used] = load[:, panel]
            kernels.advance_wide(*self._kernel_arguments, *flat[:5], load is not None, flat[5])
            state[self.inlet, used] = after[:, panel]
            result[:, panel] = state[:, used]
        return result

    def _substeps(self, c: np.ndarray, before: np.ndarray, after: np.ndarray,
                  loads: Iterable[np.ndarray | float]) -> Iterator[np.ndarray]:
        """Yield columns (n, batch) at the beginning and after each solve, in the same array.

        ``loads`` contains an additional right-hand side of the free nodes for each of the
        ``substeps + 1`` solves.
        """
        c = c.copy()
        c[self.inlet] = before
        yield c
        slope = (after - before) / self.substeps
        rate = self.substeps / self.time_step
        for k, load in enumerate(loads):
            # The first two are backward Euler over half a sub-step: (2M/Δt + K) c⁺ = (2M/Δt) c + f,
            # with twice the matrix of Crank–Nicolson.
            inlet = before + (k or 0.5) * slope
            explicit = rate * (self._mass @ c) if k < 2 else self._explicit @ c
            c[self._free] = self._solver.solve(explicit - self._implicit_inlet @ inlet + load)
            c[self.inlet] = inlet if k < self.substeps else after
            yield c

    def _inflow(self, name: str, value: np.ndarray | float, batch: int) -> np.ndarray:
        value = _check.array(name, value, np.shape(value))
        if value.ndim == 1:
            value = value[:, None]
        n = len(self.inlet)
        try:
            return np.broadcast_to(value, (n, batch))
        except ValueError:
            raise ValueError(f"{name} must be a number or have shape ({n},) or ({n}, {batch}), "
                             f"got {value.shape}") from None


def inlet_nodes(mesh: Mesh, velocity: VelocityField) -> np.ndarray:
    """(n_inlet,) int, nodes of boundary facets where fluid enters: ∫ v·n < 0 by midpoint rule."""
    basis = skfem.FacetBasis(to_skfem(mesh), element(mesh.dim, 1), intorder=1)
    x = np.asarray(basis.global_coordinates())
    speed = (velocity_at(velocity, x) * np.asarray(basis.normals)).sum(axis=0).mean(axis=1)
    facets = basis.find[speed < -1e-12 * max(1e-300, np.abs(speed).max())]
    return np.unique(basis.mesh.facets[:, facets])


def velocity_at(velocity: VelocityField, x: np.ndarray, name: str = "velocity") -> np.ndarray:
    """Return the field at quadrature points (d, cells, points), in the same shape."""
    points = x.reshape(len(x), -1).T
    value = _check.array(f"{name}(points)", velocity(points), points.shape, units="m/s")
    return value.T.reshape(x.shape)


# -- SUPG ------------------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def supg_basis(mesh: Mesh) -> skfem.CellBasis:
    """Return the basis of the transport's matrices."""
    return basis_on(mesh, 1, intorder=4)


def _supg_matrices(mesh: Mesh, velocity: VelocityField,
                   diffusivity: float) -> tuple[sp.csr_array, sp.csr_array]:
    """Return the SUPG mass matrix and transport matrix (n, n): M ċ + K c = 0."""
    basis = supg_basis(mesh)
    v = velocity_at(velocity, np.asarray(basis.global_coordinates()))
    tau, _ = upwinding(basis, v, diffusivity)

    @skfem.BilinearForm
    def mass(u, phi, w):
        return u * (phi + w["tau"] * dot(w["v"], grad(phi)))

    @skfem.BilinearForm
    def transport(u, phi, w):
        test = phi + w["tau"] * dot(w["v"], grad(phi))
        return diffusivity * dot(grad(u), grad(phi)) + dot(w["v"], grad(u)) * test

    return (sp.csr_array(mass.assemble(basis, v=v, tau=tau)),
            sp.csr_array(transport.assemble(basis, v=v, tau=tau)))


def _supg_derivatives(mesh: Mesh, velocity: VelocityField, diffusivity: float,
                      directions: Sequence[VelocityField],
                      ) -> list[tuple[sp.csr_array, sp.csr_array]]:
    """Return ∂M/∂θ_k and ∂K/∂θ_k, each (n, n), at θ = 0 for the velocity v + Σ θ_k v_k."""
    basis = supg_basis(mesh)
    x = np.asarray(basis.global_coordinates())
    v = velocity_at(velocity, x)
    tau, by_velocity = upwinding(basis, v, diffusivity)

    @skfem.BilinearForm
    def mass(u, phi, w):
        return u * dot(w["test"], grad(phi))

    @skfem.BilinearForm
    def transport(u, phi, w):
        return (dot(w["v_k"], grad(u)) * (phi + w["tau"] * dot(w["v"], grad(phi)))
                + dot(w["v"], grad(u)) * dot(w["test"], grad(phi)))

    derivatives = []
    for number, direction in enumerate(directions):
        v_k = velocity_at(direction, x, f"directions[{number}]")
        test = tau * v_k + (by_velocity * v_k).sum(axis=0) * v  # derivative of τ v
        along = sum(np.abs((v_k * phi[0].grad).sum(axis=0)) for phi in basis.basis)
        # In slow flow τ = |v|²/(3κ(Σᵢ|v·∇φᵢ|)²) depends on the direction only: at v = 0 the
        # derivative of τ v is τ(v_k) v_k.
        slow = (v_k**2).sum(axis=0) / np.maximum(3 * diffusivity * along**2, 1e-300)
        test = np.where(tau == 0.0, slow * v_k, test)
        by_mass = mass.assemble(basis, test=test)
        by_transport = transport.assemble(basis, v=v, tau=tau, v_k=v_k, test=test)
        derivatives.append((sp.csr_array(by_mass), sp.csr_array(by_transport)))
    return derivatives


def upwinding(basis: skfem.Basis, v: np.ndarray,
               diffusivity: float) -> tuple[np.ndarray, np.ndarray]:
    """Return τ (cells, points) and its derivative by v (d, cells, points), zero where τ is zero.

    τ = h/(2|v|)·(coth Pe − 1/Pe) with Pe = |v|h/(2κ) and h the cell's length along the flow (Brooks
    & Hughes 1982).
    """
    gradients = [np.asarray(phi[0].grad) for phi in basis.basis]
    streams = [(v * gradient).sum(axis=0) for gradient in gradients]
    along = sum(np.abs(stream) for stream in streams)  # Σᵢ|v·∇φᵢ| = 2|v|/h
    some = np.maximum(along, 1e-300)
    peclet = (v**2).sum(axis=0) / np.maximum(along * diffusivity, 1e-300)
    larger = np.maximum(peclet, 1e-3)
    upwinding = np.where(peclet > 1e-3, 1.0 / np.tanh(larger) - 1.0 / larger, peclet / 3.0)
    tau = np.where(along > 0, upwinding / some, 0.0)
    slope = np.where(peclet > 1e-3, 1.0 / larger**2 + 1.0 - 1.0 / np.tanh(larger)**2, 1.0 / 3.0)
    # Rounding must not choose a side of the kink.
    turn = sum(np.where(np.abs(stream) > 1e-12 * along, np.sign(stream), 0.0) * gradient
               for stream, gradient in zip(streams, gradients, strict=True))
    by_velocity = (slope * (2 * v / diffusivity / some - peclet / some * turn) - tau * turn) / some
    return tau, np.where(tau > 0, by_velocity, 0.0)
