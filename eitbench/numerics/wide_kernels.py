"""Compiled sub-steps of a linear evolution, for WIDE columns side by side.

Numba keeps compiled code by the file of the kernel: who changes a vector instruction in
`eitbench.numerics.kernels` touches this file too.
"""

from __future__ import annotations

from numba import njit

from eitbench.numerics.kernels import (
    WIDE,
    load_wide,
    plus,
    splat_wide,
    store,
    subtract_product,
    times,
)


@njit(cache=True)
def advance_wide(mass, explicit, implicit_inlet, lower, upper, scale, row_place, unknown, inlet,
                 substeps, rate, state, before, slope, inflow, source, sourced, work):
    """All sub-steps of `WideSubsteps` for ``state`` (n, WIDE), in place.

    Matrices are (pointers, indices, values) by rows: L and U in the order of elimination, in which
    row r of the others stands at row_place[r], and node unknown[i] is the i-th unknown. Blocks
    (…, WIDE) are flattened: the inflow at first and what it changes by in a sub-step, room for the
    present one, f if there is one (``sourced``), and room to work.
    """
    for k in range(substeps + 1):
        time = float(k) if k else 0.5
        for j in range(0, len(inflow), WIDE):
            change = times(splat_wide(time), load_wide(slope, j))
            store(inflow, j, plus(load_wide(before, j), change))
        halved = k < 2
        _right_side(mass if halved else explicit, rate if halved else 1.0, implicit_inlet,
                    (0.5 if halved else 1.0) * sourced, row_place, state, inflow, source, work)
        _substitute(lower, upper, scale, unknown, work, state)
        for j in range(len(inlet)):
            store(state, inlet[j] * WIDE, load_wide(inflow, j * WIDE))


@njit
def _right_side(matrix, rate, implicit_inlet, weight, row_place, state, inflow, source, work):
    """rate·(matrix c) − I c_in + weight·f, in the order of elimination."""
    for r in range(len(row_place)):
        total = times(splat_wide(rate), _row_product(matrix, r, state))
        given = _row_product(implicit_inlet, r, inflow)
        total = plus(total, times(splat_wide(-1.0), given))
        if weight:
            total = plus(total, times(splat_wide(weight), load_wide(source, r * WIDE)))
        store(work, row_place[r] * WIDE, total)


@njit
def _substitute(lower, upper, scale, unknown, work, state):
    """Solve with L and U, and put each unknown where it belongs."""
    for i in range(len(scale)):
        store(work, i * WIDE, _rest(lower, i, work))
    for i in range(len(scale) - 1, -1, -1):
        total = times(_rest(upper, i, work), splat_wide(scale[i]))
        store(work, i * WIDE, total)
        store(state, unknown[i] * WIDE, total)


@njit(inline="always")
def _row_product(matrix, r, block):
    """Row r times a block; product and sum are rounded apart, as scipy rounds them."""
    pointer, index, value = matrix
    total = splat_wide(0.0)
    for e in range(pointer[r], pointer[r + 1]):
        total = plus(total, times(splat_wide(value[e]), load_wide(block, index[e] * WIDE)))
    return total


@njit(inline="always")
def _rest(matrix, i, block):
    """Row i of a block less row i of a matrix times the block, rounded as in `solve_lu`."""
    pointer, index, value = matrix
    total = load_wide(block, i * WIDE)
    for e in range(pointer[i], pointer[i + 1]):
        total = subtract_product(total, splat_wide(value[e]), load_wide(block, index[e] * WIDE))
    return total
