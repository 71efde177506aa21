"""Compiled kernels: sparse Cholesky and LU factors on a fixed pattern, products of gradients,
sub-steps of a linear evolution, and weights of particles.

All code that requires numba is in this file, which `eitbench.numerics.compiled` imports on demand.

The factor is stored in supernodes, runs of columns with the same pattern below them: supernode s
holds the columns start[s] … start[s+1]−1 and the rows rows[first_row[s] : first_row[s+1]], as a
dense panel, column after column, from panel[s] on. For the last supernode only the right-hand side
is computed: the Schur complement of all earlier ones.

The compiler does not vectorise loops over eight neighbours inside one array, since it cannot prove
that they do not overlap. Therefore the kernels process eight doubles at a time, by intrinsics for a
type that numba lacks, which is 3 to 5 times faster. The intrinsics are in this file because numba
caches compiled code per file of the kernel: it would not notice a change in another file.
"""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

WIDTH = 8
WIDE = 32
"""Lanes for hundreds of right-hand sides. The additions of a lane depend on each other, so several
registers are used in turn; more do not fit if a register holds four doubles."""


class Lanes(types.Type):
    """<width x double>, held in registers."""

    def __init__(self, width: int) -> None:
        self.width = width
        self.vector = ir.VectorType(ir.DoubleType(), width)
        super().__init__(name=f"Lanes{width}")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, kind.vector)


def _loader(lanes):
    @intrinsic
    def load(_typing, array, index):
        """array[index : index + width]"""
        def code(context, builder, signature, arguments):
            vector = builder.load(_address(context, builder, signature, arguments, lanes))
            vector.align = 8
            return vector
        return lanes(array, types.intp), code
    return load


def _splatter(lanes):
    @intrinsic
    def splat(_typing, number):
        """number in every lane"""
        def code(_context, builder, _signature, arguments):
            nothing = ir.Constant(lanes.vector, ir.Undefined)
            first = builder.insert_element(nothing, arguments[0], ir.Constant(ir.IntType(32), 0))
            zeros = ir.Constant(ir.VectorType(ir.IntType(32), lanes.width), [0] * lanes.width)
            return builder.shuffle_vector(first, nothing, zeros)
        return lanes(types.float64), code
    return splat


load, load_wide = (_loader(Lanes(width)) for width in (WIDTH, WIDE))
splat, splat_wide = (_splatter(Lanes(width)) for width in (WIDTH, WIDE))


@intrinsic
def store(_typing, array, index, vector):
    """array[index : index + width] = vector"""
    def code(context, builder, signature, arguments):
        address = _address(context, builder, signature, arguments, vector)
        written = builder.store(arguments[2], address)
        written.align = 8
        return context.get_dummy_value()
    return types.void(array, types.intp, vector), code


@intrinsic
def subtract_product(_typing, total, a, b):
    """total − a·b"""
    def code(_context, builder, _signature, arguments):
        fma = _function(builder, "fma", total, 3)
        return builder.call(fma, [builder.fneg(arguments[1]), arguments[2], arguments[0]])
    return total(total, a, b), code


def _binary(instruction):
    @intrinsic
    def apply(_typing, a, b):
        """a·b or a + b"""
        def code(_context, builder, _signature, arguments):
            return getattr(builder, instruction)(*arguments)
        return a(a, b), code
    return apply


times, plus = (_binary(instruction) for instruction in ("fmul", "fadd"))


@intrinsic
def inverse_root(_typing, a):
    """1/√a"""
    def code(_context, builder, _signature, arguments):
        root = builder.call(_function(builder, "sqrt", a, 1), arguments)
        return builder.fdiv(ir.Constant(a.vector, [1.0] * a.width), root)
    return a(a), code


def _address(context, builder, signature, arguments, lanes):
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    return builder.bitcast(builder.gep(array.data, [arguments[1]]), lanes.vector.as_pointer())


def _function(builder, name, lanes, count):
    kind = ir.FunctionType(lanes.vector, [lanes.vector] * count)
    return cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{lanes.width}f64")


# -- kernels --------------------------------------------------------------------------------------


@njit(cache=True)
def factorise(start, first_row, rows, panel, owner, first_entry, slot, values, factor):
    """Left-looking supernodal Cholesky; lower entries ``values`` go to ``factor``'s ``slot``."""
    n_super = len(start) - 1
    head = np.full(n_super, -1)
    after = np.full(n_super, -1)
    done = np.zeros(n_super, np.int64)
    place = np.empty(len(owner), np.int64)
    target = np.empty(len(owner), np.int64)
    column = np.empty(len(owner) + WIDTH)
    second = np.empty(len(owner) + WIDTH)
    for s in range(n_super):
        width = start[s + 1] - start[s]
        height = first_row[s + 1] - first_row[s]
        here = panel[s]
        for i in range(height):
            place[rows[first_row[s] + i]] = i
        for i in range(here, here + height * width):
            factor[i] = 0.0
        for e in range(first_entry[s], first_entry[s + 1]):
            factor[slot[e]] = values[e]
        d = head[s]                              # earlier supernodes with rows among these columns
        while d >= 0:
            following = after[d]
            rows_d = first_row[d]
            height_d = first_row[d + 1] - first_row[d]
            there = panel[d]
            begin = end = done[d]
            for a in range(begin, height_d):
                target[a] = place[rows[rows_d + a]]
                if rows[rows_d + a] < start[s + 1]:
                    end = a + 1
            width_d = start[d + 1] - start[d]
            for b in range(begin, end, 2):      # two columns at a time, which share loaded values
                twin = min(b + 1, end - 1)
                # may read numbers beyond the panel, which are not used
                for a in range(b, height_d, WIDTH):
                    total = splat(0.0)
                    other = splat(0.0)
                    k = there
                    for _ in range(width_d):
                        rows_here = load(factor, k + a)
                        total = subtract_product(total, rows_here, splat(factor[k + b]))
                        other = subtract_product(other, rows_here, splat(factor[k + twin]))
                        k += height_d
                    store(column, a, total)
                    store(second, a, other)
                to = here + target[b] * height
                for a in range(b, height_d):
                    factor[to + target[a]] += column[a]
                if twin > b:
                    to = here + target[twin] * height
                    for a in range(twin, height_d):
                        factor[to + target[a]] += second[a]
            _enlist(d, end, rows_d, height_d, rows, owner, head, after, done)
            d = following
        if s == n_super - 1:
            break
        for p in range(width):
            j = here + p * height
            for i in range(p, height, WIDTH):
                total = load(factor, j + i)
                k = here
                for _ in range(p):
                    total = subtract_product(total, load(factor, k + i), splat(factor[k + p]))
                    k += height
                if i + WIDTH <= height:
                    store(factor, j + i, total)
                else:
                    store(column, 0, total)
                    for r in range(i, height):
                        factor[j + r] = column[r - i]
            scale = 1.0 / math.sqrt(factor[j + p])
            for i in range(p, height):
                factor[j + i] *= scale
        _enlist(s, width, first_row[s], height, rows, owner, head, after, done)


@njit(inline="always")
def _enlist(s, end, rows_s, height, rows, owner, head, after, done):
    """Mark the first ``end`` rows of supernode s as done, and add s to the list of the supernode
    that owns its next row."""
    done[s] = end
    if end < height:
        next_one = owner[rows[rows_s + end]]
        after[s] = head[next_one]
        head[next_one] = s


@njit(cache=True)
def condense_lanes(start, first_row, rows, panel, children, first_entry, slot, values, front,
                   stack):
    """Compute the Schur complements of eight matrices in ``front``, in lanes.

    Corresponding values of the eight matrices are adjacent. Multifrontal: the factor itself is not
    stored. The update matrix of a supernode stays on a stack until its parent adds it, so that the
    working memory fits into the CPU caches.
    """
    n_super = len(start) - 1
    place = np.empty(start[-1], np.int64)
    target = np.empty(start[-1], np.int64)
    begins = np.zeros(n_super + 1, np.int64)
    waiting = np.zeros(n_super, np.int64)
    depth = 0
    for s in range(n_super):
        width = start[s + 1] - start[s]
        height = first_row[s + 1] - first_row[s]
        for i in range(height):
            place[rows[first_row[s] + i]] = i
        for j in range(height):
            for i in range(j * height + j, (j + 1) * height):
                store(front, i * WIDTH, splat(0.0))
        for e in range(first_entry[s], first_entry[s + 1]):
            store(front, (slot[e] - panel[s]) * WIDTH, load(values, e * WIDTH))
        for _ in range(children[s]):
            depth -= 1
            d = waiting[depth]
            at = begins[depth]
            left = first_row[d] + start[d + 1] - start[d]
            size = first_row[d + 1] - left
            for i in range(size):
                target[i] = place[rows[left + i]]
            for j in range(size):
                for i in range(j, size):
                    to = (target[j] * height + target[i]) * WIDTH
                    left_over = load(stack, at * WIDTH)
                    store(front, to, subtract_product(load(front, to), splat(-1.0), left_over))
                    at += 1
        if s == n_super - 1:
            break
        for p in range(width):
            j = p * height
            for i in range(p, height):
                total = load(front, (j + i) * WIDTH)
                k = 0
                for _ in range(p):
                    pivot = load(front, (k + p) * WIDTH)
                    total = subtract_product(total, load(front, (k + i) * WIDTH), pivot)
                    k += height
                store(front, (j + i) * WIDTH, total)
            scale = inverse_root(load(front, (j + p) * WIDTH))
            for i in range(p, height):
                store(front, (j + i) * WIDTH, times(load(front, (j + i) * WIDTH), scale))
        at = begins[depth]
        waiting[depth] = s
        for j in range(width, height):
            for i in range(j, height, 2):          # two rows at a time, which share loaded values
                twin = min(i + 1, height - 1)
                total = load(front, (j * height + i) * WIDTH)
                other = load(front, (j * height + twin) * WIDTH)
                k = 0
                for _ in range(width):
                    pivot = load(front, (k + j) * WIDTH)
                    total = subtract_product(total, load(front, (k + i) * WIDTH), pivot)
                    other = subtract_product(other, load(front, (k + twin) * WIDTH), pivot)
                    k += height
                store(stack, at * WIDTH, total)
                store(stack, (at + 1) * WIDTH, other)    # overwritten later if i is the last row
                at += 2 if twin > i else 1
        depth += 1
        begins[depth] = at


@njit(cache=True)
def substitute_back(start, first_row, rows, panel, factor, solution):
    """Solve Lᵀ x = 0 upwards from the last supernode's rows of ``solution`` (n, 8·k)."""
    n_super = len(start) - 1
    width = solution.shape[1]
    flat = solution.reshape(-1)
    for s in range(n_super - 2, -1, -1):
        height = first_row[s + 1] - first_row[s]
        first = first_row[s]
        for p in range(start[s + 1] - start[s] - 1, -1, -1):
            column = panel[s] + p * height
            scale = splat(1.0 / factor[column + p])
            for lane in range(0, width, WIDTH):
                total = splat(0.0)
                for i in range(p + 1, height):
                    above = load(flat, rows[first + i] * width + lane)
                    total = subtract_product(total, splat(factor[column + i]), above)
                store(flat, (start[s] + p) * width + lane, times(total, scale))


@njit(cache=True)
def subtract_gradient_products(cells, unknowns, gradient, fields, mixtures, table, G, left):
    """Subtract `Sensitivity`'s integrals from ``table``, cell by cell.

    Weighted gradients by a cell's unknowns (cells, vertices·dim, unknowns per cell); fields
    (unknowns, width), mixtures (k, width) and table (nodes, k, width), with width a multiple of
    eight; without mixtures (0, width), k is width. Working memory: ``G`` of twice
    (vertices, dim, width), and ``left`` of twice (vertices, dim, k) for mixtures.
    """
    n_cells, n_vertices = cells.shape
    n_rows, n_local = gradient.shape[1:]
    dim = n_rows // n_vertices
    width = fields.shape[1]
    mixed = len(mixtures) > 0
    n_left = len(mixtures) if mixed else width
    if not mixed:
        left = G
    u = fields.reshape(-1)
    out = table.reshape(-1)
    size = dim * width                                   # numbers per vertex
    shifted = n_vertices * size                          # start of S + G_j, behind the G_j
    for c in range(n_cells):
        for r in range(n_rows):
            for i in range(0, width, WIDTH):
                total = splat(0.0)
                for k in range(n_local):
                    value = load(u, unknowns[c, k] * width + i)
                    total = subtract_product(total, splat(-gradient[c, r, k]), value)
                store(G, r * width + i, total)
        for i in range(0, size, WIDTH):
            total = splat(0.0)
            for v in range(n_vertices):
                total = subtract_product(total, splat(-1.0), load(G, v * size + i))
            for j in range(n_vertices):
                to = j * size + i
                store(G, shifted + to, subtract_product(total, splat(-1.0), load(G, to)))
        if mixed:
            for r in range(2 * n_rows):
                for m in range(n_left):
                    value = 0.0
                    for i in range(width):
                        value += mixtures[m, i] * G[r * width + i]
                    left[r * n_left + m] = value
        for m in range(n_left):
            for l in range(0, width, 2 * WIDTH):         # sixteen at a time, if width allows
                twin = min(l + WIDTH, width - WIDTH)
                everywhere = splat(0.0)
                everywhere_twin = splat(0.0)
                i = 0
                k = m
                for _ in range(n_rows):
                    first = splat(left[k])
                    everywhere = subtract_product(everywhere, first, load(G, i + l))
                    everywhere_twin = subtract_product(everywhere_twin, first, load(G, i + twin))
                    i += width
                    k += n_left
                for j in range(n_vertices):
                    to = (cells[c, j] * n_left + m) * width
                    total = subtract_product(load(out, to + l), splat(-1.0), everywhere)
                    other = subtract_product(load(out, to + twin), splat(-1.0), everywhere_twin)
                    for r in range(j * dim, j * dim + dim):
                        for part in (r, n_rows + r):
                            first = splat(left[part * n_left + m])
                            i = part * width
                            total = subtract_product(total, first, load(G, i + l))
                            other = subtract_product(other, first, load(G, i + twin))
                    store(out, to + l, total)
                    store(out, to + twin, other)


def _substitution(width, load, splat):
    @njit(inline="always")
    def rest(matrix, i, block):
        """Return row i of a block minus row i of a matrix times the block."""
        pointer, index, value = matrix
        total = load(block, i * width)
        for e in range(pointer[i], pointer[i + 1]):
            total = subtract_product(total, splat(value[e]), load(block, index[e] * width))
        return total

    @njit
    def substitute(lower, upper, scale, place, work, result):
        """Solve with L and U, whose diagonals are 1 and 1/``scale``; unknown i goes to place[i]."""
        for i in range(len(scale)):
            store(work, i * width, rest(lower, i, work))
        for i in range(len(scale) - 1, -1, -1):
            total = times(rest(upper, i, work), splat(scale[i]))
            store(work, i * width, total)
            store(result, place[i] * width, total)

    return substitute


_substitute = _substitution(WIDTH, load, splat)
_substitute_wide = _substitution(WIDE, load_wide, splat_wide)


@njit(cache=True)
def solve_lu(row_perm, place, lower, upper, scale, right, work, solution):
    """Solve A x = b for eight right-hand sides (n, 8).

    L and U are (pointers, indices, values) by rows.
    """
    for i in range(len(scale)):
        store(work, row_perm[i] * WIDTH, load(right, i * WIDTH))
    _substitute(lower, upper, scale, place, work, solution)


@njit(cache=True)
def advance_wide(mass, explicit, implicit_inlet, lower, upper, scale, row_perm, unknown, inlet,
                 substeps, rate, state, before, slope, inflow, source, has_source, work):
    """Compute all sub-steps of `ConvectionDiffusion` for ``state`` (n, WIDE), in place.

    Matrices are (pointers, indices, values) by rows: L and U in the order of elimination, in which
    row r of the others has the position row_perm[r], and node unknown[i] is the i-th unknown.
    Blocks (…, WIDE) are flattened: initial inflow ``before``, its change ``slope`` per sub-step,
    memory for the present ``inflow``, ``source`` f if ``has_source``, and working memory.
    """
    for k in range(substeps + 1):
        time = float(k) if k else 0.5
        for j in range(0, len(inflow), WIDE):
            change = times(splat_wide(time), load_wide(slope, j))
            store(inflow, j, plus(load_wide(before, j), change))
        halved = k < 2
        _right_side(mass if halved else explicit, rate if halved else 1.0, implicit_inlet,
                    (0.5 if halved else 1.0) * has_source, row_perm, state, inflow, source, work)
        _substitute_wide(lower, upper, scale, unknown, work, state)
        for j in range(len(inlet)):
            store(state, inlet[j] * WIDE, load_wide(inflow, j * WIDE))


@njit
def _right_side(matrix, rate, implicit_inlet, weight, row_perm, state, inflow, source, work):
    """Compute rate·(matrix c) − I c_in + weight·f, in the order of elimination."""
    for r in range(len(row_perm)):
        total = times(splat_wide(rate), _row_product(matrix, r, state))
        given = _row_product(implicit_inlet, r, inflow)
        total = plus(total, times(splat_wide(-1.0), given))
        if weight:
            total = plus(total, times(splat_wide(weight), load_wide(source, r * WIDE)))
        store(work, row_perm[r] * WIDE, total)


@njit(inline="always")
def _row_product(matrix, r, block):
    """Multiply row r by a block; product and sum are rounded separately, as in scipy."""
    pointer, index, value = matrix
    total = splat_wide(0.0)
    for e in range(pointer[r], pointer[r + 1]):
        total = plus(total, times(splat_wide(value[e]), load_wide(block, index[e] * WIDE)))
    return total


@njit(cache=True)
def bilinear_weights(points, spacing, origin, shape, index, weights):
    """Compute grid points ``index`` (N, 4) about ``points`` (N, 2) and their ``weights`` (N, 4), on
    a grid of ``shape`` (columns, rows), x first; the point (0, 0) is at column and row
    ``origin``."""
    columns, rows = shape
    for i in range(len(points)):
        x = points[i, 0] / spacing + origin[0]
        y = points[i, 1] / spacing + origin[1]
        column = min(max(int(x), 0), columns - 2)
        row = min(max(int(y), 0), rows - 2)
        x -= column
        y -= row
        for k in range(4):
            above, right = k // 2, k % 2
            index[i, k] = (row + above) * columns + column + right
            weights[i, k] = (x if right else 1.0 - x) * (y if above else 1.0 - y)


@njit(cache=True)
def particle_likelihoods(signals, index, shares, weights, currents, electrodes, measured, residual,
                         variance, relative_error, logarithm, mean, covariance):
    """Compute log-likelihoods of particles relative to the density of the noise, (B, P), and
    ``mean`` (B, m) and ``covariance`` (B, m, m) of their residuals and noise, all zero before.

    Particle p of episode b changes the voltage at electrode e for a current at d by
    Σ_k shares[b, p, k] signals[L e + d, index[b, p, k]]. ``residual`` and ``variance`` (B, m) are
    those without a particle; ``relative_error`` is a standard deviation relative to the signal.
    """
    B, P, n_cells = index.shape
    m = electrodes.shape[1]
    L = currents.shape[1]
    deviations, growth = np.empty((P, m)), np.empty(P)
    change = np.empty(signals.shape[1])
    for b in range(B):
        driven = np.flatnonzero(currents[b])
        used = np.flatnonzero(measured[b])
        growth[:] = 1.0
        for a in used:
            change[:] = 0.0                         # small enough for the fastest CPU cache
            for d in driven:
                row = L * electrodes[b, a] + d
                for g in range(len(change)):
                    change[g] += currents[b, d] * signals[row, g]
            for p in range(P):
                signal = 0.0
                for k in range(n_cells):
                    signal += shares[b, p, k] * change[index[b, p, k]]
                rest = residual[b, a] - signal
                spread = variance[b, a] + (relative_error * signal)**2
                logarithm[b, p] -= 0.5 * rest * rest / spread
                growth[p] *= spread / variance[b, a]
                deviations[p, a] = rest
                mean[b, a] += weights[b, p] * rest
                covariance[b, a, a] += weights[b, p] * spread
        for p in range(P):
            logarithm[b, p] -= 0.5 * math.log(growth[p])
            for a in used:
                for c in used:
                    covariance[b, a, c] += (weights[b, p] * (deviations[p, a] - mean[b, a])
                                            * (deviations[p, c] - mean[b, c]))


@njit(cache=True)
def add_columns(pointers, rows, values, weights, totals):
    """Add a sparse matrix by columns times ``weights`` (B, columns), most of them zero, to
    ``totals`` (B, rows)."""
    for b in range(len(weights)):
        for j in range(weights.shape[1]):
            if weights[b, j] != 0.0:
                for e in range(pointers[j], pointers[j + 1]):
                    totals[b, rows[e]] += weights[b, j] * values[e]


@njit(cache=True)
def scatter(index, values, totals):
    """Add ``values`` (B, N) to ``totals`` (B, G) at ``index`` (B, N)."""
    for b in range(len(index)):
        for i in range(index.shape[1]):
            totals[b, index[b, i]] += values[b, i]
