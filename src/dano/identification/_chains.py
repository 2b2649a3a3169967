"""Normal equations of motions whose windows are to meet."""

import numpy as np

from dano.solvers import NormalEquations


def chained(p, k, owner, jumps, loss, gradient, hessian, jump, slope) -> NormalEquations:
    """Normal equations with one block for each motion, whose windows are tied by their jumps."""
    counts = np.bincount(owner)
    size = int(counts.max()) * k
    place = np.concatenate([np.arange(n) for n in counts])
    m = len(counts)
    shared, shared_hessian = gradient[:, :p].sum(axis=0), hessian[:, :p, :p].sum(axis=0)
    g, b, c = np.zeros((m, size)), np.zeros((m, size, size)), np.zeros((m, size, p))
    # Windows that a shorter motion does not have stay where they are.
    for i, n in enumerate(counts):
        tail = np.arange(n * k, size)
        b[i, tail, tail] = 1.0
    losses = by_owner(owner, loss, jump)
    # The jump falls one to one as the next window's beginning moves towards the end of this one.
    step = 1 / np.asarray(jumps)
    for w, (i, j) in enumerate(zip(owner, place, strict=True)):
        mine = slice(j * k, (j + 1) * k)
        g[i, mine] += gradient[w, p:]
        b[i, mine, mine] += hessian[w, p:, p:]
        c[i, mine] += hessian[w, p:, :p]
        if j + 1 == counts[i]:
            continue
        by_x, by_mine, by_next = slope[w, :, :p], slope[w, :, p:], -np.diag(step)
        following = slice((j + 1) * k, (j + 2) * k)
        shared += by_x.T @ jump[w]
        shared_hessian += by_x.T @ by_x
        for rows, a in ((mine, by_mine), (following, by_next)):
            g[i, rows] += a.T @ jump[w]
            c[i, rows] += a.T @ by_x
            for columns, d in ((mine, by_mine), (following, by_next)):
                b[i, rows, columns] += a.T @ d
    return NormalEquations(float(losses.sum()), shared, shared_hessian, g, b, c, losses)


def by_owner(owner: np.ndarray, loss: np.ndarray, jump: np.ndarray) -> np.ndarray:
    """Loss of each motion, jumps between its windows included."""
    return np.bincount(owner, loss + 0.5 * np.sum(jump**2, axis=1))


def unchained(change: np.ndarray, owner: np.ndarray, k: int) -> np.ndarray:
    """Changes of motions as those of their windows, of k numbers each."""
    counts = np.bincount(owner)
    return np.concatenate([change[i, : n * k].reshape(n, k) for i, n in enumerate(counts)])
