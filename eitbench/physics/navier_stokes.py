"""Steady flow in 2D: v·∇v − ν∆v + ∇p = f, ∇·v = 0; Taylor–Hood elements (P2 for v, P1 for p)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import skfem
from scipy.sparse.linalg import splu
from skfem.helpers import grad

from eitbench import _check
from eitbench.numerics.fem import basis as basis_on
from eitbench.numerics.fem import facet_numbers, integral, laplace
from eitbench.numerics.mesh import Mesh, facet_set, validate_facets
from eitbench.physics.transport import VelocityField

_EDGES = np.array([[0, 1], [1, 2], [2, 0]])  # of a triangle; their midpoints are its nodes 3, 4, 5
_NEWTON_STEPS = 15
_TOLERANCE = 1e-9  # relative size of the last step; the remaining error is about its square


@dataclass(frozen=True, eq=False)
class SteadyFlow:
    """A velocity field on a mesh, from `steady_flow`: points (k, 2) in m -> (k, 2) in m/s.

    At points outside the mesh it is the velocity at the nearest point of the boundary.
    """

    mesh: Mesh
    cell_velocity: np.ndarray
    """(n_cells, 6, 2) velocity in m/s at each cell's nodes and midpoints of edges 01, 12 and 20."""
    pressure: np.ndarray
    """(n_nodes,) kinematic pressure (pressure over density) in m²/s²."""

    def __call__(self, points: np.ndarray) -> np.ndarray:
        cells, b = self.mesh.locate(points)
        shape = np.concatenate([b * (2.0 * b - 1.0), 4.0 * b[:, _EDGES].prod(axis=2)], axis=1)
        return np.einsum("ki,kid->kd", shape, self.cell_velocity[cells])


def steady_flow(mesh: Mesh, viscosity: float, walls: Sequence[tuple[np.ndarray, VelocityField]], *,
                force: VelocityField | None = None) -> SteadyFlow:
    """Compute a steady flow by Newton's method from the Stokes flow or a more viscous flow.

    The error is of third order in the cell size for the velocity and of second for the pressure (L2
    norms). Terms are not upwinded: a mesh too coarse for the Reynolds number leads to oscillations
    or no solution. If several steady flows exist, the result is one of them, stable or not.
    ``ValueError`` naming the argument if the mesh is not 2D, if a value is out of range, of the
    wrong shape or not finite, if a facet is not on the boundary, or if the net flux through closed
    walls exceeds 10⁻⁴ of the largest speed times the perimeter. (A smaller flux is interpolation
    error, and distributed as a uniform divergence.) ``RuntimeError`` if no steady flow was found.

    Parameters
    ----------
    mesh : Mesh
        2D.
    viscosity : float
        Kinematic viscosity ν in m²/s, > 0.
    walls : sequence of (facets, velocity)
        Boundary facets, (k, 2) node numbers as from `Mesh.facets_where`, and the velocity imposed
        on them: points (k, 2) in m -> velocity (k, 2) in m/s, evaluated at the ends and the middle
        of each facet. A node that several entries share takes the value of the last entry: walls
        should come after a moving lid or an inlet. All other boundary facets are outflow,
        ν∂v/∂n − pn = 0; without an outflow the pressure has mean zero.
    force : callable, optional
        Force per mass, points (k, 2) in m -> acceleration (k, 2) in m/s²; default: none.
    """
    if mesh.dim != 2:
        raise ValueError(f"mesh must be 2D, got {mesh.dim}D")
    viscosity = _check.number("viscosity", viscosity, low=0.0, open_low=True, units="m²/s")
    equations = _discretise(mesh, walls, force)
    found = _continuation(equations, viscosity)
    velocity = found[:-mesh.n_nodes].reshape(2, -1).T
    pressure = found[-mesh.n_nodes:]
    if equations.closed:
        pressure = pressure - equations.weights @ pressure / equations.weights.sum()
    return SteadyFlow(mesh, velocity[equations.cell_dofs], pressure)


# -- equations -------------------------------------------------------------------------------------

class _Equations(NamedTuple):
    """(νL + C(v)) v − Bᵀp = load and −Bv = source, for x = (v₁, v₂, p), v given on walls."""

    basis: skfem.Basis
    """Scalar P2, n unknowns."""
    laplace: sp.csr_array
    """(n, n) ∫∇φᵢ·∇φⱼ."""
    divergence: sp.csr_array
    """(n_nodes, 2n) B, ∫ψᵢ ∇·v."""
    load: np.ndarray
    """(2n,) ∫φᵢ f."""
    source: np.ndarray
    """(n_nodes,) uniform source that balances the net flux of closed walls; otherwise 0."""
    given: np.ndarray
    """(2n + n_nodes,) wall values, zero elsewhere."""
    free: np.ndarray
    """Numbers of the unknowns that walls do not prescribe."""
    weights: np.ndarray
    """(n_nodes,) ∫ψᵢ."""
    closed: bool
    """True without outflow: the pressure is determined up to a constant, and one value is fixed."""
    cell_dofs: np.ndarray
    """(n_cells, 6) numbers of the scalar unknowns at the nodes and edge midpoints of each cell."""


@skfem.BilinearForm
def _slope_x(u, v, _w):
    return grad(u)[0] * v


@skfem.BilinearForm
def _slope_y(u, v, _w):
    return grad(u)[1] * v


@skfem.BilinearForm
def _convection(u, v, w):
    return (w["x"] * grad(u)[0] + w["y"] * grad(u)[1]) * v


@skfem.BilinearForm
def _reaction(u, v, w):
    return w["rate"] * u * v


@skfem.LinearForm
def _load(v, w):
    return w["force"] * v


def _discretise(mesh: Mesh, walls: Sequence[tuple[np.ndarray, VelocityField]],
                force: VelocityField | None) -> _Equations:
    basis = basis_on(mesh, 2, intorder=5)  # exact for v·∇v
    linear = basis_on(mesh, 1, intorder=5)
    n = basis.N
    value, on_wall, closed = _wall_values(mesh, basis, walls)
    slopes = [form.assemble(basis, linear) for form in (_slope_x, _slope_y)]
    divergence = sp.csr_array(sp.hstack(slopes))
    weights = integral.assemble(linear)
    load = np.zeros(2 * n)
    source = np.zeros(mesh.n_nodes)
    given = np.append(value.T.ravel(), source)
    if force is not None:
        x = np.asarray(basis.global_coordinates())
        f = _sample("force", force, x.reshape(2, -1).T).T.reshape(x.shape)
        load = np.concatenate([_load.assemble(basis, force=component) for component in f])
    fixed = [on_wall, n + on_wall]
    if closed:
        net = (divergence @ given[:2 * n]).sum()
        ends = mesh.points[mesh.boundary_facets]
        perimeter = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
        if abs(net) > 1e-4 * (np.linalg.norm(value, axis=1).max() * perimeter):
            raise ValueError("walls must let as much fluid in as out, as they are all round, "
                             f"got a net outflow of {net:g} m²/s")
        source = -net / weights.sum() * weights
        fixed.append(np.array([2 * n]))
    free = np.setdiff1d(np.arange(len(given)), np.concatenate(fixed))
    middles = basis.facet_dofs[0][facet_numbers(basis.mesh, mesh.cells[:, _EDGES])]
    cell_dofs = np.concatenate([basis.nodal_dofs[0][mesh.cells], middles], axis=1)
    return _Equations(basis, sp.csr_array(laplace.assemble(basis)), divergence, load, source,
                      given, free, weights, closed, cell_dofs)


def _wall_values(mesh: Mesh, basis: skfem.Basis,
                 walls: Sequence[tuple[np.ndarray, VelocityField]],
                 ) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the wall velocity (n, 2), its unknowns, and whether the walls are closed."""
    if not len(walls):
        raise ValueError("walls must hold at least one pair of facets and velocity")
    value = np.zeros((basis.N, 2))
    on_wall = np.zeros(basis.N, dtype=bool)
    boundary = facet_set(mesh.boundary_facets)
    rest = set(boundary)
    for i, (facets, velocity) in enumerate(walls):
        facets = validate_facets(f"walls[{i}] must begin with facets, which", facets, mesh)
        here = facet_set(np.sort(facets, axis=1))
        if here - boundary:
            raise ValueError(f"walls[{i}] must hold facets of the boundary, "
                             f"got {min(here - boundary)}")
        rest -= here
        middles = basis.facet_dofs[0][facet_numbers(basis.mesh, facets)]
        dofs = np.concatenate([basis.nodal_dofs[0][facets].ravel(), middles])
        ends = mesh.points[facets]
        points = np.concatenate([ends.reshape(-1, 2), ends.mean(axis=1)])
        value[dofs] = _sample(f"walls[{i}] velocity", velocity, points)
        on_wall[dofs] = True
    return value, np.flatnonzero(on_wall), not rest


def _sample(name: str, field: VelocityField, points: np.ndarray) -> np.ndarray:
    return _check.array(f"{name}(points)", field(points), points.shape)


# -- solution --------------------------------------------------------------------------------------

def _continuation(equations: _Equations, viscosity: float) -> np.ndarray:
    """Return the solution x at this viscosity, if necessary by continuation from higher ones."""
    at = viscosity
    ratio = 4.0
    found = _newton(equations, at)
    while found is None and at < 1e12 * viscosity:
        at *= ratio
        found = _newton(equations, at)
    if found is None:
        raise RuntimeError("no steady flow was found at any viscosity: the mesh may be too coarse "
                           "near its corners")
    while at > viscosity:
        lower = max(viscosity, at / ratio)
        result = _newton(equations, lower, found)
        if result is not None:
            found = result
            at = lower
        elif ratio > 1.02:
            ratio = math.sqrt(ratio)
        else:
            raise RuntimeError(f"no steady flow was found at a viscosity of {viscosity:g} m²/s, "
                               f"only down to {at:g}: the mesh may be too coarse, or the flow "
                               "not steady")
    return found


def _newton(equations: _Equations, viscosity: float,
            start: np.ndarray | None = None) -> np.ndarray | None:
    """Return x by Newton's method from ``start`` (default: Stokes flow); None if it diverges."""
    x = _linear_solution(equations, viscosity, None) if start is None else start
    last = math.inf
    for k in range(_NEWTON_STEPS):
        if x is None:
            return None
        before = x
        x = _linear_solution(equations, viscosity, x)
        if x is not None:
            velocity, pressure = np.split(x, [len(equations.load)])
            step = np.abs(velocity - before[:len(velocity)]).max()
            # √p is a velocity scale of the pressure: v of a fluid at rest is only rounding error.
            if step <= _TOLERANCE * max(np.abs(velocity).max(), math.sqrt(np.abs(pressure).max())):
                return x
            if k > 1 and step > last:  # the second step may well be larger than the first
                return None
            last = step
    return None


def _linear_solution(equations: _Equations, viscosity: float,
                     around: np.ndarray | None) -> np.ndarray | None:
    """Solve the equations linearised about ``around`` (None: rest); return None if singular."""
    basis = equations.basis
    free = equations.free
    viscous = viscosity * equations.laplace
    momentum: list[list[sp.csr_array | None]] = [[viscous, None], [None, viscous]]
    load = equations.load
    if around is not None:
        # v·∇v ≈ w·∇v + v·∇w − w·∇w for v near w
        w = around[:2 * basis.N].reshape(2, -1)
        field = [basis.interpolate(component) for component in w]
        x, y = map(np.asarray, field)
        convection = sp.csr_array(_convection.assemble(basis, x=x, y=y))
        reaction = [[sp.csr_array(_reaction.assemble(basis, rate=slope)) for slope in each.grad]
                    for each in field]
        momentum = [[viscous + convection + reaction[0][0], reaction[0][1]],
                    [reaction[1][0], viscous + convection + reaction[1][1]]]
        load = load + (convection @ w.T).T.ravel()
    matrix = sp.csc_array(sp.block_array([[sp.block_array(momentum), -equations.divergence.T],
                                          [-equations.divergence, None]]))
    x = equations.given.copy()
    right = np.concatenate([load, equations.source]) - matrix @ x
    try:
        # Diagonal pivots where they are not too small: as accurate, with 10–30 % less fill.
        x[free] = splu(matrix[free][:, free], diag_pivot_thresh=0.1).solve(right[free])
    except RuntimeError:                                  # exactly singular
        return None
    return x if np.isfinite(x).all() else None
