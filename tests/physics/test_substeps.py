"""Sub-steps of many columns side by side, against dense matrices, and against each column alone."""

import numpy as np
import pytest
from eitbench.numerics.compiled import scratch
from eitbench.numerics.mesh import rectangle_mesh
from eitbench.physics.flow import PlaneChannelFlow
from eitbench.physics.transport import MANY, ConvectionDiffusion, _supg_matrices
from numpy.testing import assert_allclose, assert_array_equal

MESH = rectangle_mesh(np.linspace(0.0, 1.0, 13), np.linspace(-0.25, 0.25, 7))
FLOW = PlaneChannelFlow(1.0, 0.25)
SETTINGS = {"diffusivity": 4e-3, "time_step": 0.1, "substeps": 3}
N = 91
INLET = 7


def channel():
    return ConvectionDiffusion(MESH, FLOW, inlet=np.arange(INLET), **SETTINGS)


def columns(k):
    """Concentrations (91, k), inflows before and after (7, k)."""
    rng = np.random.default_rng(1)
    return [rng.normal(size=(size, 100))[:, :k] for size in (N, INLET, INLET)]


def dense_step(c, before, after, source):
    """The scheme that `ConvectionDiffusion` describes, with full matrices; source (91, k) per s."""
    M, K = (matrix.toarray() for matrix in _supg_matrices(MESH, FLOW, SETTINGS["diffusivity"]))
    dt = SETTINGS["time_step"] / SETTINGS["substeps"]
    free = np.arange(INLET, N)
    c = np.concatenate([before, c[INLET:]])
    times = np.array([0.5, 1.0, 2.0, 3.0])
    for k, time in enumerate(times):
        step, implicit = (0.5 * dt, 1.0) if k < 2 else (dt, 0.5)
        new = np.zeros_like(c)
        new[:INLET] = before + time / SETTINGS["substeps"] * (after - before)
        right = (M / step - (1 - implicit) * K) @ c + M @ source
        A = M / step + implicit * K
        right -= A[:, :INLET] @ new[:INLET]
        new[free] = np.linalg.solve(A[np.ix_(free, free)], right[free])
        c = new
    return c


@pytest.mark.parametrize("k", [MANY, 31, 32, 33, 70])
def test_step_of_many_is_that_of_full_matrices(k):
    """Panels that are full and ones that are not, with an inflow that changes."""
    c, before, after = columns(k)
    expected = dense_step(c, before, after, np.zeros((N, k)))
    assert np.abs(expected - dense_step(c, before, before, np.zeros((N, k)))).max() > 0.1
    assert_allclose(channel().step(c, before, after), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("k", [MANY, 31, 32, 33, 70])
def test_each_column_is_what_it_would_be_alone(k):
    """To the bit, though alone it takes another way; the arguments stay as they are."""
    model, arguments = channel(), columns(k)
    kept = [array.copy() for array in arguments]
    together = model.step(*arguments)
    for j in range(k):
        assert_array_equal(model.step(*(array[:, j] for array in arguments)), together[:, j])
    for array, copy in zip(arguments, kept, strict=True):
        assert_array_equal(array, copy)


def test_evolution_model_is_that_of_full_matrices():
    """F, Y and H from unit columns; H is what a source of 1/Δt adds."""
    F, Y, H = channel().evolution_model()
    nothing = np.zeros((INLET, N))
    unit = np.eye(N)
    assert_allclose(F, dense_step(unit, unit[:INLET], nothing, 0 * unit), rtol=0, atol=1e-12)
    assert_allclose(Y, dense_step(np.zeros((N, INLET)), 0.0 * np.eye(INLET), np.eye(INLET),
                                  np.zeros((N, INLET))), rtol=0, atol=1e-12)
    assert_allclose(H, dense_step(0 * unit, nothing, nothing, unit / SETTINGS["time_step"]), rtol=0,
                    atol=1e-12)
    assert np.abs(H).max() > 0.1


def test_memory_used_before_leaves_no_trace():
    """What is left in working memory, even NaN, does not enter a panel that is not full."""
    arguments = columns(33)
    expected = channel().step(*arguments)
    scratch(10**5)[:] = np.nan
    assert_array_equal(channel().step(*arguments), expected)
