"""Static condensation of sparse symmetric positive definite systems onto their last unknowns.

For K = [[A, B], [Bᵀ, C]] the electrodes need only their block of K⁻¹, (C − Bᵀ A⁻¹ B)⁻¹. With their
unknowns ordered last, a Cholesky factorisation of the other columns leaves the Schur complement:
one factorisation serves all injections, without substitutions.

The unknowns are ordered once for a fixed pattern: by minimum degree, or in 3D by nested dissection.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from eitbench.numerics.compiled import compiled_kernels, scratch
from eitbench.numerics.sparse_lu import factorise_no_pivot

_LEAF = 200
"""Largest number of unknowns of a leaf of nested dissection."""
_WIDEST = 1200
"""Largest number of rows of a front with which eight matrices fit into the processor's caches."""


class Condensation:
    """Matrices of one pattern, condensed onto their last unknowns by compiled Cholesky kernels.

    Parameters
    ----------
    pattern : (n, n) sparse
        Symmetric, with a full diagonal.
    n_ports : int
    places : (n − n_ports, d), optional
        Coordinates of the unknowns, for nested dissection. In 3D it needs at most half of the
        operations of minimum degree; in 2D minimum degree is better.

    Attributes
    ----------
    rows, columns : (k,) int
        Positions in K of the values that methods take, in this order.
    batch : int
        Largest number of matrices per call.
    """

    def __init__(self, pattern: sp.csc_array, n_ports: int,
                 places: np.ndarray | None = None) -> None:
        self.n = pattern.shape[0]
        self.n_ports = n_ports
        inner = pattern[:-n_ports, :-n_ports]
        place = _minimum_degree(inner) if places is None else _nested_dissection(inner, places)
        place = np.append(place, np.arange(self.n - n_ports, self.n))
        filled = _filled(_permuted(pattern, place))
        rank = _postorder(_parents(filled), n_ports)
        place = rank[place]
        filled = _permuted(filled, rank)
        permuted = _permuted(pattern, place)
        self._place = place
        self._symbolic = _supernodes(filled, n_ports)
        start, first_row, rows, panel, owner = self._symbolic
        lower = sp.tril(permuted, format="coo")
        key = np.repeat(np.arange(len(panel) - 1), np.diff(first_row)) * self.n + rows
        home = owner[lower.col]
        within = np.searchsorted(key, home * self.n + lower.row) - first_row[home]
        slot = panel[home] + (lower.col - start[home]) * np.diff(first_row)[home] + within
        by_slot = np.argsort(slot)
        self._slot = slot[by_slot]
        self._first_entry = np.searchsorted(self._slot, panel)
        order = np.argsort(place)
        self.rows = order[lower.row[by_slot]]
        self.columns = order[lower.col[by_slot]]
        self._children, self._front_size, self._stack_size = _multifrontal_sizes(*self._symbolic)
        self.batch = 8 if self._front_size <= _WIDEST**2 else 1

    def port_inverse(self, values: np.ndarray) -> np.ndarray:
        """Return the ports' block of K⁻¹: (m, m) for values (k,), (b, m, m) for values (k, b) of
        b ≤ `batch` matrices."""
        if values.ndim == 1 or self.batch == 1:
            inverse = np.linalg.inv(self._schur(self._factorise(values.ravel())))
            return inverse if values.ndim == 1 else inverse[None]
        b = values.shape[1]
        if b < self.batch:
            values = np.pad(values, ((0, 0), (0, self.batch - b)), mode="edge")
        start, first_row, rows, panel, _ = self._symbolic
        memory = scratch((self._front_size + self._stack_size) * self.batch)
        front, stack = np.split(memory, [self._front_size * self.batch])
        compiled_kernels().condense_lanes(start, first_row, rows, panel, self._children,
                                          self._first_entry, self._slot, values.ravel(), front,
                                          stack)
        schur = self._symmetric(front[:self.n_ports**2 * self.batch].reshape(-1, self.batch).T)
        return np.linalg.inv(schur[:b])

    def port_columns(self, values: np.ndarray) -> np.ndarray:
        """Return the ports' columns (n, m) of K⁻¹ for values (k,)."""
        factor = self._factorise(values)
        solution = np.zeros((self.n, -(-self.n_ports // 8) * 8))
        solution[-self.n_ports:, :self.n_ports] = np.linalg.inv(self._schur(factor))
        start, first_row, rows, panel, _ = self._symbolic
        compiled_kernels().substitute_back(start, first_row, rows, panel, factor, solution)
        return solution[self._place, :self.n_ports]

    def _factorise(self, values: np.ndarray) -> np.ndarray:
        factor = scratch(self._symbolic[3][-1] + 8)  # the kernel reads a few numbers beyond the end
        compiled_kernels().factorise(*self._symbolic, self._first_entry, self._slot, values, factor)
        return factor

    def _schur(self, factor: np.ndarray) -> np.ndarray:
        panel = self._symbolic[3]
        return self._symmetric(factor[panel[-2]:panel[-1]])

    def _symmetric(self, columns: np.ndarray) -> np.ndarray:
        """Return (..., m, m) from (..., m·m) with the lower triangle by columns."""
        block = columns.reshape(*columns.shape[:-1], self.n_ports, self.n_ports)
        return np.triu(block) + np.swapaxes(np.triu(block, 1), -1, -2)


def _filled(pattern: sp.csc_array) -> sp.csc_array:
    """Return the Cholesky factor's pattern, from SuperLU for a matrix without cancellation."""
    factors = factorise_no_pivot(_diagonally_dominant(pattern), "NATURAL")
    back = np.argsort(factors.perm_c)      # SuperLU may have postordered the elimination tree
    lower = factors.L.tocoo()
    i, j = back[lower.row], back[lower.col]
    places = np.maximum(i, j), np.minimum(i, j)
    return _sorted_pattern(places, pattern.shape)


def _parents(filled: sp.csc_array) -> np.ndarray:
    """Return the elimination tree: the first row below the diagonal of each column, or −1."""
    last = filled.indptr[1:] - filled.indptr[:-1] == 1
    return np.where(last, -1, filled.indices[np.minimum(filled.indptr[:-1] + 1, filled.nnz - 1)])


def _postorder(parents: np.ndarray, n_last: int) -> np.ndarray:
    """Return the new position of each column, such that every subtree is consecutive.

    The ``n_last`` last columns keep their positions.
    """
    n = len(parents) - n_last
    parent = [p if 0 <= p < n else n for p in parents[:n].tolist()]
    size = [1] * n + [0]
    for j in range(n):
        size[parent[j]] += size[j]
    rank = list(range(len(parents)))
    begin = [0] * (n + 1)
    for j in reversed(range(n)):                  # a column has the last position of its subtree
        begin[j] = begin[parent[j]]
        begin[parent[j]] += size[j]
        rank[j] = begin[j] + size[j] - 1
    return np.array(rank)


def _supernodes(filled: sp.csc_array, n_last: int) -> tuple[np.ndarray, ...]:
    """Return start, first_row, rows, panel, owner as in `eitbench.numerics.kernels`.

    The ``n_last`` last columns are one supernode.
    """
    n = filled.shape[0]
    count = np.diff(filled.indptr)
    begins = np.ones(n, dtype=bool)
    begins[1:] = (_parents(filled)[:-1] != np.arange(1, n)) | (count[:-1] != count[1:] + 1)
    begins[n - n_last:] = np.arange(n_last) == 0
    start = np.append(np.flatnonzero(begins), n).astype(np.int64)
    width = np.diff(start)
    height = np.append(count[start[:-2]], n_last).astype(np.int64)
    first_row = np.append(0, np.cumsum(height))
    within = np.arange(first_row[-2]) - np.repeat(first_row[:-2], height[:-1])
    below = filled.indices[np.repeat(filled.indptr[start[:-2]], height[:-1]) + within]
    rows = np.append(below, np.arange(n - n_last, n)).astype(np.int64)
    panel = np.append(0, np.cumsum(height * width))
    return start, first_row, rows, panel, np.repeat(np.arange(len(width)), width)


def _multifrontal_sizes(start: np.ndarray, first_row: np.ndarray, rows: np.ndarray,
                        _panel: np.ndarray, owner: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Return the children of each supernode, and entries of the largest front and stack."""
    width, height = np.diff(start), np.diff(first_row)
    parent = owner[rows[first_row[:-2] + width[:-1]]]             # the owner of the first row below
    children = np.bincount(parent, minlength=len(width))
    left = (height - width) * (height - width + 1) // 2
    waiting: list[int] = []
    fullest = total = 0
    for own, count in zip(left.tolist(), children.tolist(), strict=True):
        total -= sum(waiting[len(waiting) - count:])
        del waiting[len(waiting) - count:]
        waiting.append(own)
        total += own
        fullest = max(fullest, total)
    return children, int(height.max()**2), fullest + 1


def _nested_dissection(pattern: sp.csc_array, places: np.ndarray) -> np.ndarray:
    """Return the position of each unknown in a nested dissection.

    Every cut comes after its two sides; it has the lowest cost of some cuts across the axes of
    ``places`` (n, d).
    """
    graph = sp.csr_array(pattern)
    order: list[np.ndarray] = []
    waiting = [(np.arange(len(places)), False)]
    while waiting:
        part, done = waiting.pop()
        within = graph[part][:, part]
        if done or len(part) <= _LEAF:
            order.append(part[np.argsort(_minimum_degree(sp.csc_array(within)))])
            continue
        best = None
        smallest = np.inf
        for along in places[part].T:
            for share in (0.4, 0.45, 0.5, 0.55, 0.6):
                low = along <= np.quantile(along, share) + 1e-9 * np.ptp(along)
                for side in (low, ~low):
                    cut = side & ((within @ (~side).astype(float)) > 0)
                    rest = np.array([(low & ~cut).sum(), (~low & ~cut).sum()])
                    cost = cut.sum() * (2 * rest.max() / len(part))      # small and central cuts
                    if rest.min() > 0 and cost < smallest:
                        best = (part[low & ~cut], part[~low & ~cut], part[cut])
                        smallest = cost
        if best is None:
            waiting.append((part, True))
        else:
            waiting += [(best[2], True), (best[1], False), (best[0], False)]
    place = np.empty(len(places), np.int64)
    place[np.concatenate(order)] = np.arange(len(places))
    return place


def _minimum_degree(pattern: sp.csc_array) -> np.ndarray:
    """Return the position of each unknown in a fill-reducing order."""
    factors = factorise_no_pivot(_diagonally_dominant(pattern), "MMD_AT_PLUS_A")
    return factors.perm_c.astype(np.int64)


def _permuted(pattern: sp.csc_array, place: np.ndarray) -> sp.csc_array:
    coo = pattern.tocoo()
    return _sorted_pattern((place[coo.row], place[coo.col]), pattern.shape)


def _sorted_pattern(places: tuple[np.ndarray, np.ndarray], shape: tuple[int, int]) -> sp.csc_array:
    pattern = sp.csc_array((np.ones(len(places[0])), places), shape=shape)
    pattern.sort_indices()
    return pattern


def _diagonally_dominant(pattern: sp.csc_array) -> sp.csc_array:
    """Return a matrix with this symmetric pattern that can be factorised in any order."""
    ones = pattern.copy()
    ones.data = np.full(pattern.nnz, -1.0)
    return (ones + sp.diags_array(2.0 + np.diff(pattern.indptr).astype(float))).tocsc()
