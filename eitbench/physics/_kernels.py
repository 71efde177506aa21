"""Compiled kernels: sparse Cholesky factors on a fixed pattern, and products of gradients.

The factor is stored in supernodes, runs of columns with the same pattern below them: supernode s holds the columns
start[s] … start[s+1]−1 and the rows rows[first_row[s] : first_row[s+1]], as a dense panel, column after column, from
panel[s] on. Of the last supernode only its right-hand side is made: the Schur complement of all before.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from eitbench.physics._lanes import WIDTH, inverse_root, load, splat, store, subtract_product, times


@njit(cache=True)
def factorise(start, first_row, rows, panel, owner, first_entry, slot, values, factor):
    """Left-looking supernodal Cholesky; lower entries ``values`` go to the places ``slot`` of ``factor``."""
    n_super = len(start) - 1
    head, after, done = np.full(n_super, -1), np.full(n_super, -1), np.zeros(n_super, np.int64)
    place, target = np.empty(len(owner), np.int64), np.empty(len(owner), np.int64)
    column = np.empty(len(owner) + WIDTH)
    for s in range(n_super):
        width, height, here = start[s + 1] - start[s], first_row[s + 1] - first_row[s], panel[s]
        for i in range(height):
            place[rows[first_row[s] + i]] = i
        for i in range(here, here + height * width):
            factor[i] = 0.0
        for e in range(first_entry[s], first_entry[s + 1]):
            factor[slot[e]] = values[e]
        d = head[s]                                    # earlier supernodes with rows among these columns
        while d >= 0:
            following = after[d]
            rows_d, height_d, there = first_row[d], first_row[d + 1] - first_row[d], panel[d]
            begin = end = done[d]
            for a in range(begin, height_d):
                target[a] = place[rows[rows_d + a]]
                if rows[rows_d + a] < start[s + 1]:
                    end = a + 1
            for b in range(begin, end):
                for a in range(b, height_d, WIDTH):    # may read beyond the panel, into numbers that are not used
                    total = splat(0.0)
                    for k in range(there, there + (start[d + 1] - start[d]) * height_d, height_d):
                        total = subtract_product(total, load(factor, k + a), splat(factor[k + b]))
                    store(column, a, total)
                for a in range(b, height_d):
                    factor[here + target[b] * height + target[a]] += column[a]
            _enlist(d, end, rows_d, height_d, rows, owner, head, after, done)
            d = following
        if s == n_super - 1:
            break
        for j in range(here, here + width * height, height):
            p = (j - here) // height
            for k in range(here, j, height):
                pivot = factor[k + p]
                for i in range(p, height):
                    factor[j + i] -= factor[k + i] * pivot
            scale = 1.0 / math.sqrt(factor[j + p])
            for i in range(p, height):
                factor[j + i] *= scale
        _enlist(s, width, first_row[s], height, rows, owner, head, after, done)


@njit(cache=True)
def factorise_lanes(start, first_row, rows, panel, owner, first_entry, slot, values, factor):
    """`factorise` for eight matrices side by side: their values lie next to each other, in and out."""
    n_super = len(start) - 1
    head, after, done = np.full(n_super, -1), np.full(n_super, -1), np.zeros(n_super, np.int64)
    place, target = np.empty(len(owner), np.int64), np.empty(len(owner), np.int64)
    for s in range(n_super):
        width, height, here = start[s + 1] - start[s], first_row[s + 1] - first_row[s], panel[s]
        for i in range(height):
            place[rows[first_row[s] + i]] = i
        for i in range(here, here + height * width):
            store(factor, i * WIDTH, splat(0.0))
        for e in range(first_entry[s], first_entry[s + 1]):
            store(factor, slot[e] * WIDTH, load(values, e * WIDTH))
        d = head[s]
        while d >= 0:
            following = after[d]
            rows_d, height_d, there = first_row[d], first_row[d + 1] - first_row[d], panel[d]
            begin = end = done[d]
            for a in range(begin, height_d):
                target[a] = place[rows[rows_d + a]]
                if rows[rows_d + a] < start[s + 1]:
                    end = a + 1
            for b in range(begin, end):
                for a in range(b, height_d):
                    i = (here + target[b] * height + target[a]) * WIDTH
                    total = load(factor, i)
                    for k in range(there, there + (start[d + 1] - start[d]) * height_d, height_d):
                        total = subtract_product(total, load(factor, (k + a) * WIDTH), load(factor, (k + b) * WIDTH))
                    store(factor, i, total)
            _enlist(d, end, rows_d, height_d, rows, owner, head, after, done)
            d = following
        if s == n_super - 1:
            break
        for j in range(here, here + width * height, height):
            p = (j - here) // height
            for k in range(here, j, height):
                pivot = load(factor, (k + p) * WIDTH)
                for i in range(p, height):
                    to = (j + i) * WIDTH
                    store(factor, to, subtract_product(load(factor, to), load(factor, (k + i) * WIDTH), pivot))
            scale = inverse_root(load(factor, (j + p) * WIDTH))
            for i in range(p, height):
                store(factor, (j + i) * WIDTH, times(load(factor, (j + i) * WIDTH), scale))
        _enlist(s, width, first_row[s], height, rows, owner, head, after, done)


@njit(inline="always")
def _enlist(s, end, rows_s, height, rows, owner, head, after, done):
    """Supernode s is finished with its first ``end`` rows: the owner of the next one will need it."""
    done[s] = end
    if end < height:
        next_one = owner[rows[rows_s + end]]
        after[s] = head[next_one]
        head[next_one] = s


@njit(cache=True)
def substitute_back(start, first_row, rows, panel, factor, solution):
    """Solve Lᵀ x = 0 upwards from the last supernode's rows of ``solution``, (n, 8·k) flattened per 8·k."""
    n_super = len(start) - 1
    width = solution.shape[1]
    flat = solution.reshape(-1)
    for s in range(n_super - 2, -1, -1):
        height, first = first_row[s + 1] - first_row[s], first_row[s]
        for p in range(start[s + 1] - start[s] - 1, -1, -1):
            column = panel[s] + p * height
            scale = splat(1.0 / factor[column + p])
            for lane in range(0, width, WIDTH):
                total = splat(0.0)
                for i in range(p + 1, height):
                    above = load(flat, rows[first + i] * width + lane)
                    total = subtract_product(total, splat(factor[column + i]), above)
                store(flat, (start[s] + p) * width + lane, times(total, scale))


@njit(cache=True, fastmath={"contract"})
def products_of_gradients(cells, weight, gradients, table):
    """Add `Sensitivity.products` to ``table``, cell by cell; gradients (cells, vertices, dim, fields)."""
    n_cells, n_vertices, dim, n_fields = gradients.shape
    everywhere = np.empty((n_fields, n_fields))
    shifted = np.empty((dim, n_fields))
    for c in range(n_cells):
        G = gradients[c]
        everywhere[:] = 0.0
        for v in range(n_vertices):
            for k in range(dim):
                for m in range(n_fields):
                    left = weight[c] * G[v, k, m]
                    for l in range(n_fields):
                        everywhere[m, l] += left * G[v, k, l]
        for j in range(n_vertices):
            node = cells[c, j]
            for k in range(dim):
                for m in range(n_fields):
                    total = G[j, k, m]
                    for v in range(n_vertices):
                        total += G[v, k, m]
                    shifted[k, m] = total
            for m in range(n_fields):
                for l in range(n_fields):
                    table[node, m, l] += everywhere[m, l]
                for k in range(dim):
                    first, second = weight[c] * shifted[k, m], weight[c] * G[j, k, m]
                    for l in range(n_fields):
                        table[node, m, l] += first * shifted[k, l] + second * G[j, k, l]


@njit(cache=True)
def solve_lu(row_place, column_place, lower_pointer, lower_index, lower, upper_pointer, upper_index, upper, scale,
             right, work, solution):
    """Solve A x = b for eight right-hand sides (n, 8), with L and U by rows, their diagonals 1 and 1/``scale``."""
    n = len(scale)
    for i in range(n):
        store(work, row_place[i] * WIDTH, load(right, i * WIDTH))
    for i in range(n):
        total = load(work, i * WIDTH)
        for e in range(lower_pointer[i], lower_pointer[i + 1]):
            total = subtract_product(total, splat(lower[e]), load(work, lower_index[e] * WIDTH))
        store(work, i * WIDTH, total)
    for i in range(n - 1, -1, -1):
        total = load(work, i * WIDTH)
        for e in range(upper_pointer[i], upper_pointer[i + 1]):
            total = subtract_product(total, splat(upper[e]), load(work, upper_index[e] * WIDTH))
        store(work, i * WIDTH, times(total, splat(scale[i])))
    for i in range(n):
        store(solution, i * WIDTH, load(work, column_place[i] * WIDTH))


@njit(cache=True)
def sparse_product(pointer, index, data, x, result):
    """result = A x for A by rows, and x and result (n, 8)."""
    for i in range(len(pointer) - 1):
        total = splat(0.0)
        for e in range(pointer[i], pointer[i + 1]):
            total = subtract_product(total, splat(-data[e]), load(x, index[e] * WIDTH))
        store(result, i * WIDTH, total)
