"""The complete electrode model against closed forms, a semi-analytic disc and an independent dense assembly."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from eitbench.numerics.mesh import Mesh, graded_pipe_mesh
from eitbench.physics.cem import CompleteElectrodeModel
from eitbench.worlds.catalogue import PIPE_2D
from numpy.testing import assert_allclose

from shapes import (
    annulus_resistance,
    dense_solution,
    disc_mesh,
    disc_modes,
    disc_resistance,
    end_facets,
    polar_mesh,
    ring_facets,
    shaken_box,
    shaken_rectangle,
    slab_resistance,
)

IMPEDANCE = np.array([0.3, 0.1, 0.2, 0.05])


@cache
def small(dim: int) -> tuple[Mesh, list[np.ndarray], np.ndarray]:
    """Return mesh, four electrodes (one covers a side, the others parts of a side) and a random conductivity."""
    rng = np.random.default_rng(dim)
    if dim == 2:
        mesh = shaken_rectangle(1.0, 0.6, (5, 4), rng)
        where = [lambda p: p[:, 0] < 1e-9, lambda p: (p[:, 0] > 1 - 1e-9) & (p[:, 1] < 0.31),
                 lambda p: (p[:, 1] < 1e-9) & (p[:, 0] > 0.19) & (p[:, 0] < 0.61),
                 lambda p: (p[:, 1] > 0.6 - 1e-9) & (p[:, 0] > 0.39)]
    else:
        mesh = shaken_box((1.0, 0.8, 0.6), (3, 2, 2), rng)
        where = [lambda p: p[:, 0] < 1e-9, lambda p: (p[:, 0] > 1 - 1e-9) & (p[:, 1] < 0.41),
                 lambda p: (p[:, 2] < 1e-9) & (p[:, 0] > 0.3),
                 lambda p: (p[:, 2] > 0.6 - 1e-9) & (p[:, 1] > 0.39)]
    return mesh, [mesh.facets_where(predicate) for predicate in where], rng.uniform(0.5, 2.0, mesh.n_nodes)


@cache
def small_cem(dim: int, order: int) -> CompleteElectrodeModel:
    mesh, electrodes, _ = small(dim)
    return CompleteElectrodeModel(mesh, electrodes, IMPEDANCE, order)


def patterns(n_electrodes: int, n_random: int = 2) -> np.ndarray:
    """Return all pairs with the first electrode, then random currents."""
    pairs = np.eye(n_electrodes)[:1] - np.eye(n_electrodes)[1:]
    random = np.random.default_rng(7).standard_normal((n_random, n_electrodes))
    return np.concatenate([pairs, random - random.mean(axis=1, keepdims=True)])


every_element = pytest.mark.parametrize(("dim", "order"), [(2, 1), (2, 2), (3, 1), (3, 2)])


@every_element
def test_dense_reference(dim, order):
    """The fast path (fixed pattern, precomputed derivatives, grounded last electrode) solves the
    stated equations, also of a copy with other contacts, which leaves the original unchanged.
    Reciprocity I₁·U(I₂) = I₂·U(I₁) holds, also for the dense solution, which is not symmetrised."""
    mesh, electrodes, sigma = small(dim)
    currents = patterns(4)
    cem = small_cem(dim, order)
    others = IMPEDANCE * np.array([0.5, 1.5, 1.2, 0.8])
    for model, impedance in ((cem.with_contacts(others), others), (cem, IMPEDANCE)):
        dense = dense_solution(mesh, electrodes, impedance, order, sigma, currents)
        voltages = model.voltages(sigma, currents)
        assert_allclose(voltages, dense.voltages, rtol=0, atol=1e-10 * np.abs(voltages).max())
        for mutual in (currents @ voltages.T, currents @ dense.voltages.T):
            assert_allclose(mutual, mutual.T, atol=1e-10 * np.abs(mutual).max())
        assert_allclose(model.contact_impedance, impedance)
    with pytest.raises(ValueError, match="contact_impedance"):
        cem.with_contacts(-others)


@every_element
def test_power_balance(dim, order):
    """The power equals the losses in the volume and in the contacts: I·U = ∫σ|∇u|² + Σ z∫j²; all are positive."""
    mesh, electrodes, sigma = small(dim)
    currents = patterns(4)
    dense = dense_solution(mesh, electrodes, IMPEDANCE, order, sigma, currents)
    voltages, jacobian = small_cem(dim, order).linearise(sigma, currents)
    power = (currents * voltages).sum(axis=1)
    assert_allclose(power, dense.volume_loss + dense.contact_loss, rtol=1e-10)
    assert_allclose(dense.electrode_currents, currents, atol=1e-10)
    assert (dense.volume_loss > 0.05 * power).all() and (dense.contact_loss > 0.05 * power).all()
    # Scaling σ alone: I·(∂U/∂σ)σ = −∫σ|∇u|², so the Jacobian contains the same loss.
    assert_allclose(-np.einsum("kl,kln,n->k", currents, jacobian, sigma), dense.volume_loss, rtol=1e-10)


@every_element
def test_full_end_electrodes(dim, order):
    """A uniform rectangle or box between two full-end electrodes has ΔU = I [L/(σA) + (z₁ + z₂)/A]; u is linear."""
    mesh = small(dim)[0]
    area = 0.6 if dim == 2 else 0.8 * 0.6
    z = (0.02, 0.5)
    cem = CompleteElectrodeModel(mesh, end_facets(mesh), np.array(z), order)
    (first, second), = cem.voltages(np.full(mesh.n_nodes, 0.7), np.array([[3.0, -3.0]]))
    assert_allclose(first - second, 3.0 * slab_resistance(1.0, area, 0.7, z), rtol=1e-10)


def test_uneven_slab():
    """For σ linear along a slab, R → ln(σ₁/σ₀)/(σ₁ − σ₀) + 2z, at order 4 with P2."""
    errors = []
    for cells in (4, 8, 16):
        mesh = shaken_rectangle(1.0, 1.0, (cells, 2), np.random.default_rng(0))
        cem = CompleteElectrodeModel(mesh, end_facets(mesh), 0.1)
        R = cem.transfer_resistance(0.5 + 3.0 * mesh.points[:, 0])
        errors.append((R[0, 0] - R[0, 1]) * 2 / (np.log(3.5 / 0.5) / 3.0 + 0.2) - 1)
    assert 3.5 < np.log2(abs(errors[1] / errors[2])) < 4.5
    assert abs(errors[2]) < 1e-5


def test_annulus():
    """For a radial current in an annulus, R approaches the closed form like h² with P1 elements."""
    a, b, sigma, z = 0.03, 0.1, 0.4, (2e-2, 5e-2)
    errors = []
    for n in (32, 64):
        mesh = polar_mesh(np.geomspace(a, b, n + 1), 2 * np.pi * np.arange(2 * n) / (2 * n))
        cem = CompleteElectrodeModel(mesh, [ring_facets(mesh, a), ring_facets(mesh, b)], np.array(z), order=1)
        (inner, outer), = cem.voltages(np.full(mesh.n_nodes, sigma), np.array([[1.0, -1.0]]))
        errors.append((inner - outer) / annulus_resistance(a, b, sigma, z) - 1)
    assert 1.9 < np.log2(errors[0] / errors[1]) < 2.1
    assert abs(errors[1]) < 2e-4


RADIUS, SALINE = 0.1, 0.3
CENTRES, HALF_ANGLES = 2 * np.pi * (np.arange(5) + 0.5) / 5, np.array([0.20, 0.30, 0.25, 0.35, 0.15])
SPANS = np.stack([CENTRES - HALF_ANGLES, CENTRES + HALF_ANGLES], axis=1)
CONTACTS = 5e-3 * np.array([1.0, 2.0, 3.0, 1.5, 0.5])


def inclusion(r: np.ndarray) -> np.ndarray:
    """Return a concentric inclusion with three times the conductivity and a smooth rim, uniform at the wall."""
    return SALINE * (1.0 + 2.0 * np.exp(-(r / (0.4 * RADIUS))**4))


def test_disc():
    """𝓡 of five unequal electrodes on a disc, homogeneous and with an inclusion, converges like h²."""
    errors, results = [], []
    uniform = RADIUS / (np.arange(1, 41) * SALINE)
    references = np.stack([disc_resistance(RADIUS, SPANS, CONTACTS, modes, SALINE)
                           for modes in (uniform, disc_modes(inclusion, RADIUS))])
    size = np.linalg.norm(references, axis=(1, 2))
    for n in (8, 16, 32):
        mesh, electrodes = disc_mesh(RADIUS, SPANS, n, grading=2.5)
        cem = CompleteElectrodeModel(mesh, electrodes, CONTACTS)
        r = np.hypot(*mesh.points.T)
        results.append(cem.transfer_resistance(np.stack([np.full_like(r, SALINE), inclusion(r)])))
        errors.append(np.linalg.norm(results[-1] - references, axis=(1, 2)) / size)
    rate = np.log2(errors[1] / errors[2])
    assert (rate > 1.8).all() and (rate < 2.2).all(), errors
    assert (errors[2] < 1.5e-4).all(), errors
    # Without the h² term the disc's 𝓡 is the limit.
    limit = (4 * results[2] - results[1]) / 3
    assert (np.linalg.norm(limit - references, axis=(1, 2)) < 2e-5 * size).all()


@every_element
def test_jacobian(dim, order):
    """dU/dσ of each pattern, electrode and node equals central differences to 1e-6 of the row's largest entry; 𝓡 of
    conductivities with two leading axes."""
    cem, sigma = small_cem(dim, order), small(dim)[2]
    currents = patterns(4)
    step = 1e-4 * np.diag(sigma)
    change = np.subtract(*cem.transfer_resistance(np.stack([sigma + step, sigma - step])))
    differences = np.einsum("km,nml->kln", currents, change) / (2e-4 * sigma)
    jacobian = cem.jacobian(sigma, currents)
    error = np.abs(jacobian - differences).max(axis=2) / np.abs(differences).max(axis=2)
    assert (error < 1e-6).all(), error.max()
    voltages, again = cem.linearise(sigma, currents)
    assert_allclose(again, jacobian, rtol=1e-14)
    assert_allclose(voltages, cem.voltages(sigma, currents), rtol=1e-14)
    for k, pattern in enumerate(currents):              # one pattern is computed without the table
        value, row = cem.linearise(sigma, pattern[None])
        assert_allclose(value[0], voltages[k], rtol=1e-14)
        assert_allclose(row[0], jacobian[k], rtol=1e-12, atol=1e-14 * np.abs(jacobian).max())


def slugs(points: np.ndarray) -> np.ndarray:
    """Return two slugs of opposite sign on a wave along the pipe, S/m."""
    x, y = points.T
    blob = np.exp(-((x - 0.11) / 0.03)**2 - ((y - 0.015) / 0.02)**2)
    hole = np.exp(-((x - 0.27) / 0.04)**2 - ((y + 0.02) / 0.02)**2)
    return 0.3 * np.exp(0.35 * blob - 0.35 * hole + 0.1 * np.sin(20 * x))


def test_pipe_meshes_are_fine_enough():
    """The P2 mesh error is below 0.25 noise std for estimators and 0.05 for the truth; the P1 error is too large."""
    pipe = PIPE_2D.vessel
    currents = PIPE_2D.currents
    mesh = graded_pipe_mesh(pipe.length, pipe.half_width, pipe.electrode_spans, 24, 44)
    fine = CompleteElectrodeModel(mesh, pipe.electrodes(mesh), pipe.contact_impedance)
    assert fine.n_unknowns > 60_000
    exact = fine.voltages(slugs(mesh.points), currents)
    model = pipe.electrode_model(fine=False)
    truth = pipe.electrode_model(fine=True)
    first_order = CompleteElectrodeModel(model.mesh, model.electrodes, model.contact_impedance, order=1)
    rms, worst = {}, {}
    for name, cem in (("model", model), ("truth", truth), ("P1", first_order)):
        error = (cem.voltages(slugs(cem.mesh.points), currents) - exact) / PIPE_2D.noise.std(exact)
        rms[name], worst[name] = np.sqrt(np.mean(error**2)), np.abs(error).max()
    assert rms["model"] < 0.25 and rms["truth"] < 0.05, (rms, worst)
    assert worst["model"] < 1.0 and worst["truth"] < 0.25, (rms, worst)
    assert rms["P1"] > 1.0, rms


def test_model_refuses_wrong_electrodes_and_contacts():
    """Every argument of the constructor is checked, and the message names it."""
    mesh, electrodes, _ = small(2)
    boundary = {tuple(facet) for facet in mesh.boundary_facets.tolist()}
    inside = next([edge] for edge in np.sort(mesh.cells, axis=1)[:, :2].tolist() if tuple(edge) not in boundary)
    for wrong, match in (
            (electrodes[:1], "electrodes must be at least two"),
            ([electrodes[0], np.array(inside)], r"electrodes\[1\] has facet .* not on the mesh's boundary"),
            ([electrodes[0], electrodes[1], electrodes[0][:1]], r"electrodes\[2\] and electrodes\[0\] overlap"),
            ([electrodes[0], electrodes[1][:, :1]], r"electrodes\[1\] must be integers of shape")):
        with pytest.raises(ValueError, match=match):
            CompleteElectrodeModel(mesh, wrong, 0.1)
    with pytest.raises(ValueError, match="contact_impedance"):
        CompleteElectrodeModel(mesh, electrodes, np.array([0.1, 0.1, 0.0, 0.1]))
    with pytest.raises(ValueError, match="order must be 1 or 2, got 3"):
        CompleteElectrodeModel(mesh, electrodes, 0.1, order=3)


def test_solver_refuses_wrong_conductivity_and_currents():
    """A conductivity must be finite, positive and one number per node; currents must be (K, L) and sum to zero."""
    cem, sigma = small_cem(2, 2), small(2)[2]
    currents = patterns(4)
    for bad in (np.where(np.arange(len(sigma)) == 5, np.nan, sigma), -sigma, 0.0 * sigma, sigma[:-1]):
        with pytest.raises(ValueError, match="conductivity must"):
            cem.linearise(bad, currents)
    for bad, match in ((currents + 1e-3, "currents must sum to zero"), (currents[:, :3], "currents must have shape"),
                       (np.nan * currents, "currents must be finite")):
        with pytest.raises(ValueError, match=match):
            cem.linearise(sigma, bad)
