"""`turbulent_filter`: derivatives of a step by eddies, and propagation of mean and covariance."""

import numpy as np
import pytest
from eitbench.bench.methods import builtin_methods, load_module
from eitbench.estimation import DenseCovariance, InflowWindow
from eitbench.estimation.inflow_response import steady_response
from eitbench.numerics.fem import mass_matrix
from eitbench.physics.turbulence import FluctuatingTransport, RandomEddies
from eitbench.worlds import entry
from eitbench.worlds.task import make_task

PATH = builtin_methods("estimation")["turbulent_filter"]
METHOD = load_module("estimator", PATH, PATH.read_bytes())


@pytest.fixture(scope="module")
def task():
    return make_task(entry("eitbench/Pipe2DTurbulent-v0").world)


def test_eddy_products_are_derivatives_of_the_true_step(task):
    """A weak eddy that the mean flow convects changes smooth concentrations in a step: within 10 % the derivative in
    the middle of the step agrees, in all modes."""
    transport = task.transport
    x, y = transport.mesh.points.T
    blobs = np.exp(-((x[:, None] - np.linspace(0.1, 0.4, 9))**2 + (y[:, None] - 0.02)**2) / 0.03**2)
    blobs[transport.inlet] = 0.0
    mass = mass_matrix(transport.mesh).toarray()
    modes = blobs @ np.linalg.inv(np.linalg.cholesky(blobs.T @ mass @ blobs)).T
    eddies = RandomEddies(0.05, np.array([1e-3]), np.array([[60.0, 30.0]]), np.array([-60.0 * 4.5]), np.array([0.4]))
    fluctuating = FluctuatingTransport(transport, eddies)
    basis = np.hstack([steady_response(transport).basis[:, :20], modes])
    still = basis[transport.inlet]
    change = modes.T @ mass @ (fluctuating.step(basis, still, still) - transport.step(basis, still, still))
    middle = np.array([0.5 * transport.time_step])
    found = METHOD.eddy_products(transport, fluctuating.stream_function(middle), modes)[0]
    found = np.delete(found, slice(20, found.shape[1] - 9), axis=1)
    assert np.linalg.norm(found - change) < 0.1 * np.linalg.norm(change)


def test_propagation_has_the_moments_of_samples(task):
    """Samples of the present state and of the noise give the mean, to second order, and the covariance of the next."""
    random = np.random.default_rng(0)
    space = METHOD.EddyWindow(task, METHOD.Estimator.priors(task)[0], 28.0)
    model, n, (q, p) = space.model, space.n, (space.modes.shape[1], len(space.model["eddy_noise"]))
    mean, P = space.initial()
    root = np.linalg.cholesky(P.array + 1e-12 * np.eye(len(P.array)))
    mixed = random.normal(size=(len(mean), len(mean))) / len(mean)**0.5        # correlates x, z and b
    root = 0.1 * root @ mixed
    mean = mean + 3.0 * root @ random.normal(size=len(mean))
    expected, covariance = space.propagate(mean, DenseCovariance(root @ root.T), 1)
    states = mean + random.normal(size=(4000, len(mean))) @ root.T
    Q = {name: np.linalg.cholesky(model[name] + 1e-12 * np.eye(len(model[name]))) for name in ("noise", "eddy_noise")}
    x, z, b = np.split(states, [n, n + q], axis=1)
    b = b @ model["eddy_transition"].T + random.normal(size=(len(b), p)) @ Q["eddy_noise"].T
    y = InflowWindow.concentration(space, x) / 28.0 - 1.0
    u = np.hstack([y @ space.response().basis, z])
    z = z @ model["transition"].T + np.einsum("sj,jqu,su->sq", b, space.products, u, optimize=True)
    z += METHOD.NOISE_FACTOR**0.5 * random.normal(size=(len(z), q)) @ Q["noise"].T
    sampled = np.hstack([z, b])
    spread = sampled.std(axis=0)
    assert np.abs((sampled.mean(axis=0) - expected[n:]) / spread).max() < 5.0 / 4000**0.5
    ours = covariance.array[n:, n:] / np.outer(spread, spread)
    assert np.abs(ours - np.cov(sampled.T) / np.outer(spread, spread)).max() < 0.1
