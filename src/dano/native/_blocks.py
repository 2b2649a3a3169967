"""Linear systems of 6 × 6 blocks, most of which are empty: bodies that touch few others.

Elimination without exchanges between blocks. The next body is always one that is coupled with the fewest
others, so that little is filled in (minimum degree). Matrices of a step are inertia plus dissipation: their
pivots stay away from singular.
"""

import numpy as np

from dano.native._compiling import kernel, lean


@kernel
def elimination(coupled):
    """Order of elimination, and for each body those eliminated later that it is coupled with by then.

    Args:
        coupled: Which bodies are coupled, symmetric, shape (m, m). It is filled in.

    Returns:
        The order, shape (m,), numbers of later neighbours, shape (m,), and the neighbours, shape (m, m).
    """
    m = coupled.shape[0]
    order, count = np.empty(m, np.int64), np.zeros(m, np.int64)
    later = np.empty((m, m), np.int64)
    left = np.ones(m, np.bool_)
    degree = np.zeros(m, np.int64)
    for i in range(m):
        for j in range(m):
            degree[i] += i != j and coupled[i, j]
    for step in range(m):
        best = -1
        for i in range(m):
            if left[i] and (best < 0 or degree[i] < degree[best]):
                best = i
        left[best] = False
        order[step] = best
        n = 0
        for j in range(m):
            if left[j] and coupled[best, j]:
                later[best, n] = j
                n += 1
        count[best] = n
        for a in range(n):
            i = later[best, a]
            degree[i] -= 1
            for b in range(a + 1, n):
                j = later[best, b]
                if not coupled[i, j]:
                    coupled[i, j] = coupled[j, i] = True
                    degree[i] += 1
                    degree[j] += 1
    return order, count, later


@kernel
def solve_blocks(matrix, right, order, count, later):
    """Solve in place: `right` (m, 6) becomes the solution; `matrix` (m, m, 6, 6) is used up.

    Args:
        matrix: Blocks; those that are not coupled, filled in or on the diagonal are not read.
        right: Right-hand side.
        order: From `elimination`, as are the next two.
        count: Numbers of later neighbours.
        later: The neighbours.
    """
    m = right.shape[0]
    row, swaps = np.empty(6), np.empty(6, np.int64)
    for step in range(m):
        k = order[step]
        pivot = matrix[k, k]
        _invert(pivot, swaps)
        n = count[k]
        for a in range(n):
            i = later[k, a]
            below = matrix[i, k]
            # below ← below · pivot⁻¹
            for r in range(6):
                for c in range(6):
                    s = 0.0
                    for t in range(6):
                        s += below[r, t] * pivot[t, c]
                    row[c] = s
                for c in range(6):
                    below[r, c] = row[c]
                s = 0.0
                for t in range(6):
                    s += below[r, t] * right[k, t]
                right[i, r] -= s
            for b in range(n):
                j = later[k, b]
                _subtract_product(matrix[i, j], below, matrix[k, j])
    for step in range(m - 1, -1, -1):
        k = order[step]
        for a in range(count[k]):
            i = later[k, a]
            for r in range(6):
                s = 0.0
                for t in range(6):
                    s += matrix[k, i, r, t] * right[i, t]
                right[k, r] -= s
        pivot = matrix[k, k]
        for r in range(6):
            s = 0.0
            for t in range(6):
                s += pivot[r, t] * right[k, t]
            row[r] = s
        for r in range(6):
            right[k, r] = row[r]


@lean
def _subtract_product(target, a, b):
    for r in range(6):
        for t in range(6):
            x = a[r, t]
            for c in range(6):
                target[r, c] -= x * b[t, c]


@lean
def _invert(a, swaps):
    """Invert a 6 × 6 matrix in place: Gauss–Jordan with row exchanges; `swaps` are used up."""
    for k in range(6):
        best = k
        for r in range(k + 1, 6):
            if abs(a[r, k]) > abs(a[best, k]):
                best = r
        swaps[k] = best
        if best != k:
            for c in range(6):
                a[k, c], a[best, c] = a[best, c], a[k, c]
        inverse = 1.0 / a[k, k] if a[k, k] != 0.0 else np.nan
        a[k, k] = 1.0
        for c in range(6):
            a[k, c] *= inverse
        for r in range(6):
            if r != k:
                factor = a[r, k]
                a[r, k] = 0.0
                for c in range(6):
                    a[r, c] -= factor * a[k, c]
    for k in range(5, -1, -1):
        if swaps[k] != k:
            for r in range(6):
                a[r, k], a[r, swaps[k]] = a[r, swaps[k]], a[r, k]
