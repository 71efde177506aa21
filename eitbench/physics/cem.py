"""Electrical impedance tomography with the complete electrode model (CEM; thesis ch. 4).

∇·(σ∇u) = 0 in Ω,  u + z_l σ ∂u/∂n = U_l on electrode e_l,  ∫_{e_l} σ ∂u/∂n = I_l,  σ ∂u/∂n = 0
elsewhere,  ΣI = ΣU = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import skfem
from scipy.sparse.csgraph import connected_components
from skfem.helpers import dot, grad

from eitbench import _check
from eitbench.numerics.condensation import Condensation
from eitbench.numerics.fem import basis as basis_on
from eitbench.numerics.fem import element, facet_numbers, integral, product
from eitbench.numerics.mesh import Mesh, facet_set, validate_facets
from eitbench.physics.sensitivity import Sensitivity


class CompleteElectrodeModel:
    """Electrode voltages, and their derivatives, for a nodal conductivity.

    Voltages are linear in the currents: one symmetric L×L matrix per conductivity determines them,
    U = 𝓡 I with 𝓡1 = 0, and requires one sparse factorisation for all injections. ``ValueError``
    if the mesh is not connected, there are fewer than two electrodes, a facet is not on the
    boundary, two electrodes share a facet, or a contact impedance is not positive.

    Parameters
    ----------
    mesh : Mesh
        2D or 3D; the conductivity is linear on its cells and given at its nodes.
    electrodes : sequence of (k, d) int arrays
        The boundary facets of each electrode, as node numbers (pairs in 2D, triples in 3D).
    contact_impedance : float or (L,)
        z_l in Ω·m², > 0.
    order : int
        1 or 2: polynomial order of the potential. First order is wrong by several noise standard
        deviations on meshes of a few thousand unknowns.
    """

    def __init__(self, mesh: Mesh, electrodes: Sequence[np.ndarray],
                 contact_impedance: float | np.ndarray, order: int = 2) -> None:
        self.mesh = mesh
        self.order = order
        self.electrodes = _checked_electrodes(mesh, electrodes)
        self.n_electrodes = n_electrodes = len(self.electrodes)
        self.contact_impedance = self._checked_contacts(contact_impedance)

        basis = basis_on(mesh, order, intorder=2 * order - 1)
        self._walls = _walls(basis, self.electrodes, order)
        contact = self._contact_terms()
        rows, columns, derivatives = _conduction(basis)
        pattern = sp.coo_array((np.ones(len(rows)), (rows, columns)), shape=contact.shape).tocsc()
        # The last electrode is grounded: without its row and column K is positive definite.
        system = Condensation((pattern + abs(contact))[:-1, :-1].tocsc(), n_electrodes - 1,
                              places=basis.doflocs.T if mesh.dim == 3 else None)
        self._system = system
        self.n_unknowns = system.n
        # K(σ) = constant + D σ, for the entries that the solver stores, in its order
        n = system.n + 1
        number = sp.csr_array((np.arange(len(rows)) + 1, (rows, columns)), shape=(n, n))
        padded = sp.vstack([sp.csr_array((1, mesh.n_nodes)), derivatives], format="csr")
        self._derivatives = padded[number[system.rows, system.columns]]
        self._constant = contact[system.rows, system.columns]
        # Mean-free currents and potentials: P = I − 11ᵀ/L on both sides of the grounded solution.
        self._centre = (np.eye(n_electrodes) - 1.0 / n_electrodes)[:, :-1]
        self._sensitivity = Sensitivity(basis)
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._last_resistance: tuple[np.ndarray, np.ndarray] | None = None

    # -- public ------------------------------------------------------------------------------------

    def with_contacts(self, contact_impedance: float | np.ndarray) -> CompleteElectrodeModel:
        """Return this model with other z_l in Ω·m², > 0, one or (L,), faster than a new model."""
        made = copy(self)
        made.contact_impedance = self._checked_contacts(contact_impedance)
        contact = made._contact_terms()
        made._constant = contact[self._system.rows, self._system.columns]
        made._last = made._last_resistance = None
        return made

    def transfer_resistance(self, conductivity: np.ndarray) -> np.ndarray:
        """(..., L, L) 𝓡 with U = 𝓡 I, in Ω (in 2D Ω·m); symmetric, rows sum to zero.

        Parameters
        ----------
        conductivity : (..., n_nodes) float
            σ at the mesh nodes in S/m, finite and > 0.
        """
        sigma = self._checked_conductivity(conductivity, batched=True)
        if sigma.ndim == 1:
            # the last one is kept: many estimates stay constant during a frame
            if self._last_resistance is None or not np.array_equal(self._last_resistance[0], sigma):
                inverse = self._system.port_inverse(self._assemble(sigma))
                self._last_resistance = sigma.copy(), self._centred(inverse)
            return self._last_resistance[1].copy()
        flat = sigma.reshape(-1, self.mesh.n_nodes)
        size = self._system.batch
        result = np.concatenate([self._system.port_inverse(self._assemble(flat[k:k + size].T))
                                 for k in range(0, len(flat), size)])
        shape = (*sigma.shape[:-1], self.n_electrodes, self.n_electrodes)
        return self._centred(result).reshape(shape)

    def voltages(self, conductivity: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """Potentials (K, L) in V for currents (K, L) in A (A/m in 2D); rows of both sum to zero."""
        currents = self._checked_currents(currents)
        return currents @ self.transfer_resistance(self._checked_conductivity(conductivity))

    def jacobian(self, conductivity: np.ndarray, currents: np.ndarray) -> np.ndarray:
        """dU/dσ, (K, L, n_nodes) in V·m/S, by adjoint fields: ∂U_m/∂σ_j = −∫ φ_j ∇u·∇w_m."""
        return self.linearise(conductivity, currents)[1]

    def linearise(self, conductivity: np.ndarray,
                  currents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `voltages` and `jacobian` from one factorisation."""
        currents = self._checked_currents(currents)
        if 0 < len(currents) <= self.n_electrodes // 4:  # a filter's step: faster than the table
            fields, grounded = self._fields(conductivity)
            derivatives = self._sensitivity(fields @ self._centre.T, currents)
            jacobian = np.ascontiguousarray(np.moveaxis(derivatives, 0, 2))
            return currents @ self._centred(grounded), jacobian
        resistance, table = self.transfer_resistance_derivatives(conductivity)
        # (L, L·n_nodes), so that one product gives all Jacobians in their final memory order
        by_node = np.ascontiguousarray(table.reshape(len(table), -1).T)
        by_node = by_node.reshape(self.n_electrodes, -1)
        return currents @ resistance, (currents @ by_node).reshape(*currents.shape, -1)

    def transfer_resistance_derivatives(
            self, conductivity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return 𝓡 and its derivatives by nodal conductivity, from one factorisation.

        They are (L, L) in Ω (Ω·m in 2D) and (n_nodes, L, L) in Ω·m/S (Ω·m²/S in 2D), for
        ``conductivity`` (n_nodes,) in S/m, > 0.
        The field of any injection is a combination of the L fields w_m of unit currents at m that
        leave in equal shares at all electrodes, so that ∂𝓡_ml/∂σ_j = −∫ φ_j ∇w_m·∇w_l.
        """
        fields, grounded = self._fields(conductivity)
        return self._centred(grounded), self._sensitivity(fields @ self._centre.T)

    def scaled_resistance(self, conductivity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return 𝓡 (L, L) in Ω (Ω·m in 2D) and d𝓡(a σ)/da at a = 1, from one factorisation.

        With K = a D σ + C, where C is the part of the contacts, and K X = E for the currents E, it
        is −Xᵀ (K − C) X = −𝓡 + Xᵀ C X.
        """
        fields, grounded = self._fields(conductivity)
        columns = np.vstack([fields, grounded])
        contacts = columns.T @ (self._contact_terms()[:-1, :-1] @ columns)
        return self._centred(grounded), self._centred(contacts - grounded)

    def contact_derivatives(self, conductivity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return 𝓡 (L, L) and its derivatives (L, L, L) by each electrode's contact impedance.

        Units are Ω and Ω/(Ω·m²) (2D: Ω·m, and per Ω·m²); l is the first index of the derivatives.
        Let w_m be the field and W_m the electrode potentials of a unit current at m that leaves in
        equal shares at all electrodes. Then ∂𝓡_mk/∂z_l = (1/z_l²) ∫_{e_l} (w_m − W_m)(w_k − W_k).
        """
        fields, grounded = self._fields(conductivity)
        L = self.n_electrodes
        potentials = np.vstack([grounded, np.zeros((1, L - 1))])     # the last one is grounded
        derivatives = np.empty((L, L, L))
        for l, (wall, z) in enumerate(zip(self._walls, self.contact_impedance, strict=True)):
            U, own = potentials[l], np.unique(wall.mass.nonzero()[0])
            at_wall = fields[own]
            mixed = np.outer(at_wall.T @ wall.load[own], U)
            inner = at_wall.T @ (wall.mass[own][:, own] @ at_wall) - mixed - mixed.T
            inner += wall.load.sum() * np.outer(U, U)
            derivatives[l] = self._centre @ inner @ self._centre.T / z**2
        return self._centred(grounded), derivatives

    # -- the linear system -------------------------------------------------------------------------

    def _contact_terms(self) -> sp.csr_array:
        """Σ_l (1/z_l)∫_{e_l}(u − U_l)(φ − Φ_l) on all N + L unknowns."""
        size = self._walls[0].mass.shape
        mass = sp.csr_array(size)
        loads = []
        for wall, z in zip(self._walls, self.contact_impedance, strict=True):
            mass = mass + wall.mass / z
            loads.append(wall.load / z)
        load = sp.csr_array(np.stack(loads, axis=1))
        total = sp.diags_array(load.sum(axis=0))
        return sp.block_array([[mass, -load], [-load.T, total]], format="csr")

    def _assemble(self, conductivity: np.ndarray) -> np.ndarray:
        """Return the entries of K for the solver, (k,) or (k, b) for (n_nodes,) or (n_nodes, b)."""
        values = self._derivatives @ conductivity
        return values + (self._constant if values.ndim == 1 else self._constant[:, None])

    def _fields(self, conductivity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return potentials (N, L − 1) and (L − 1, L − 1) of the nodes and the electrodes for unit
        currents that leave at the last electrode. The last ones are kept, since a filter linearises
        all injections about the same reference."""
        sigma = self._checked_conductivity(conductivity)
        if self._last is None or not np.array_equal(self._last[0], sigma):
            self._last = sigma.copy(), self._system.port_columns(self._assemble(sigma))
        columns = self._last[1]
        return columns[:-self._system.n_ports], columns[-self._system.n_ports:]

    def _centred(self, grounded: np.ndarray) -> np.ndarray:
        resistance = self._centre @ grounded @ self._centre.T
        return 0.5 * (resistance + np.swapaxes(resistance, -1, -2))

    # -- checks ------------------------------------------------------------------------------------

    def _checked_contacts(self, contact_impedance: float | np.ndarray) -> np.ndarray:
        z = contact_impedance
        if np.ndim(z) == 0:
            z = np.full(self.n_electrodes, z)
        z = _check.array("contact_impedance", z, (self.n_electrodes,), units="Ω·m²", positive=True)
        z = z.copy()
        z.setflags(write=False)
        return z

    def _checked_conductivity(self, conductivity: np.ndarray, batched: bool = False) -> np.ndarray:
        shape = (-1, self.mesh.n_nodes) if batched else (self.mesh.n_nodes,)
        return _check.array("conductivity", conductivity, shape, units="S/m", positive=True)

    def _checked_currents(self, currents: np.ndarray) -> np.ndarray:
        currents = _check.array("currents", currents, (None, self.n_electrodes), units="A")
        surplus = np.abs(currents.sum(axis=1))
        wrong = surplus > 1e-9 * np.abs(currents).sum(axis=1)
        if wrong.any():
            k = int(np.flatnonzero(wrong)[0])
            raise ValueError(f"currents must sum to zero over the electrodes; pattern {k} sums to "
                             f"{currents[k].sum():g} A")
        return currents


class _Wall(NamedTuple):
    """Integrals over one electrode."""

    mass: sp.csr_array
    """(N, N) ∫ u φ"""
    load: np.ndarray
    """(N,) ∫ φ"""


def _walls(basis: skfem.CellBasis, electrodes: Sequence[np.ndarray], order: int) -> list[_Wall]:
    mesh = basis.mesh
    ends = np.cumsum([len(facets) for facets in electrodes])
    numbers = np.split(facet_numbers(mesh, np.concatenate(electrodes)), ends[:-1])
    walls = [skfem.FacetBasis(mesh, element(mesh.dim(), order), intorder=2 * order, facets=each)
             for each in numbers]
    return [_Wall(sp.csr_array(product.assemble(wall)), integral.assemble(wall)) for wall in walls]


@skfem.TrilinearForm
def _conduction_form(s, u, v, _w):
    return s * dot(grad(u), grad(v))


def _conduction(basis: skfem.CellBasis) -> tuple[np.ndarray, np.ndarray, sp.csr_array]:
    """Return the entries of ∫σ∇u·∇φ: rows, columns, derivatives (entries, n_nodes) by nodal σ."""
    sigma = basis.with_element(element(basis.mesh.dim(), 1))
    tensor = _conduction_form.coo_data(sigma, basis, basis)
    i, j, k = (np.asarray(index, dtype=np.int64) for index in tensor.indices)
    key, slot = np.unique(i * basis.N + j, return_inverse=True)
    derivatives = sp.csr_array((tensor.data, (slot, k)), shape=(len(key), sigma.N))
    return key // basis.N, key % basis.N, derivatives


def _checked_electrodes(mesh: Mesh, electrodes: Sequence[np.ndarray]) -> list[np.ndarray]:
    edges = np.concatenate([mesh.cells[:, [0, i]] for i in range(1, mesh.dim + 1)])
    graph = sp.coo_array((np.ones(len(edges)), edges.T), shape=(mesh.n_nodes,) * 2)
    pieces, _ = connected_components(graph)
    if pieces > 1:
        raise ValueError(f"mesh must be connected, got {pieces} separate pieces")
    if len(electrodes) < 2:
        raise ValueError(f"electrodes must be at least two, got {len(electrodes)}")
    boundary = facet_set(mesh.boundary_facets)
    owner: dict[tuple[int, ...], int] = {}
    checked = []
    for number, facets in enumerate(electrodes):
        name = f"electrodes[{number}]"
        facets = np.sort(validate_facets(name, facets, mesh), axis=1)
        for facet in map(tuple, facets.tolist()):
            if facet not in boundary:
                raise ValueError(f"{name} has facet {facet}, which is not on the mesh's boundary")
            if owner.get(facet) == number:
                raise ValueError(f"{name} holds facet {facet} twice")
            if facet in owner:
                raise ValueError(f"{name} and electrodes[{owner[facet]}] overlap in facet {facet}")
            owner[facet] = number
        checked.append(facets)
    return checked
