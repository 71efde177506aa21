"""Assembly of finite-element forms with scikit-fem."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import skfem
from skfem.helpers import dot, grad

from eitbench.numerics.mesh import Mesh

_ELEMENTS = {
    (2, 1): skfem.ElementTriP1, (2, 2): skfem.ElementTriP2,
    (3, 1): skfem.ElementTetP1, (3, 2): skfem.ElementTetP2,
}


def element(dim: int, order: int) -> skfem.Element:
    """Return a Lagrange element of first or second order on triangles or tetrahedra."""
    if (dim, order) not in _ELEMENTS:
        raise ValueError(f"order must be 1 or 2, got {order!r}")
    return _ELEMENTS[dim, order]()


def to_skfem(mesh: Mesh) -> skfem.Mesh:
    """Return a mesh as a scikit-fem mesh with the same order of nodes."""
    kind = skfem.MeshTri if mesh.dim == 2 else skfem.MeshTet
    return kind(np.ascontiguousarray(mesh.points.T), np.ascontiguousarray(mesh.cells.T))


def basis(mesh: Mesh, order: int, intorder: int) -> skfem.CellBasis:
    """Return a basis with a quadrature that is exact for polynomials of degree ``intorder``."""
    return skfem.Basis(to_skfem(mesh), element(mesh.dim, order), intorder=intorder)


@skfem.BilinearForm
def product(u, v, _w):
    """∫φᵢφⱼ."""
    return u * v


@skfem.BilinearForm
def laplace(u, v, _w):
    """∫∇φᵢ·∇φⱼ."""
    return dot(grad(u), grad(v))


@skfem.BilinearForm
def weighted_laplace(u, v, w):
    """∫w ∇φᵢ·∇φⱼ."""
    return w.weight * dot(grad(u), grad(v))


@skfem.LinearForm
def integral(v, _w):
    """∫φᵢ."""
    return v


def facet_numbers(mesh: skfem.Mesh, facets: np.ndarray) -> np.ndarray:
    """Return numbers (...) in a scikit-fem mesh of facets (..., d), given by their nodes."""
    sides = np.sort(mesh.facets, axis=0).T.tolist()
    number = {tuple(side): i for i, side in enumerate(sides)}
    flat = np.sort(facets, axis=-1).reshape(-1, mesh.dim())
    return np.array([number[tuple(facet)] for facet in flat.tolist()]).reshape(facets.shape[:-1])


def mass_matrix(mesh: Mesh) -> sp.csr_array:
    """Return the P1 mass matrix (n, n) ∫φᵢφⱼ in m^d."""
    return sp.csr_array(product.assemble(basis(mesh, 1, intorder=2)))


def stiffness_matrix(mesh: Mesh) -> sp.csr_array:
    """Return the P1 stiffness matrix (n, n) ∫∇φᵢ·∇φⱼ in m^(d-2)."""
    return sp.csr_array(laplace.assemble(basis(mesh, 1, intorder=1)))


def diffusivity_matrix(mesh: Mesh, c: np.ndarray, smoothing: float) -> sp.csr_array:
    """Return the stiffness matrix (n, n) ∫∇φᵢ·∇φⱼ/√(|∇c|² + smoothing²), whose quadratic form at c
    (n,) is the total variation of c, for ``smoothing`` ≪ |∇c|."""
    elements = basis(mesh, 1, intorder=1)
    steepness = np.sqrt((elements.interpolate(c).grad**2).sum(axis=0) + smoothing**2)
    return sp.csr_array(weighted_laplace.assemble(elements, weight=1.0 / steepness))
