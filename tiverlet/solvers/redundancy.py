"""Links that others imply: a body needs no more links than hold it."""

from typing import TYPE_CHECKING, Any

import numpy as np

from .corners import components, corners_of

if TYPE_CHECKING:
    from ..features.feature import Scene

CONSISTENT = 1e-5  # of its length: a link violated by more contradicts the others, which then imply nothing
FIRM = 1e-10  # the least square of a row across all rows chosen before it; of a beam of 8 cells the last one has 1e-4
MOST = 300  # links of a body up to which it is examined
RIGID_MOTIONS = {2: (3, 1, 0), 3: (6, 3, 1, 0)}  # of a body with 0, 1, 2, ... fixed particles, by dimension


def implied_links(links: "list[Any]", scene: "Scene") -> np.ndarray:
    """Return which constraints of these batches others imply, numbered through, (m,).

    These are rigid links of connected pieces that move as rigid bodies: links with directions u between n movable particles,
    rows (u, -u) of J, of which rank J = dim n - (rigid motions) are independent. They hold all distances, so that any further
    link has its length anyway. Solved with the others it would make a matrix without inverse. Of the rows, each next one is that
    with the largest part orthogonal to those before (QR with pivots).
    """
    counts = [b.count for b in links]
    out = np.zeros(sum(counts), dtype=bool)
    owner, item = corners_of(links)
    w = scene.inv_mass
    acts = np.bincount(owner, w[item] > 0, len(out)) > 0
    fit = np.concatenate([_may_be_implied(b, scene) for b in links])
    piece = components(len(out), owner[w[item] > 0], item[w[item] > 0])
    refused = np.bincount(piece, acts & ~fit, len(out)) > 0
    sizes = np.bincount(piece, acts, len(out))
    some = np.flatnonzero(acts & ~refused[piece] & (sizes[piece] <= MOST))
    if not len(some):
        return out
    pair, along = np.full((len(out), 2), -1), np.zeros((len(out), scene.particles.dim))
    of_pairs = np.repeat([b.arity == 2 for b in links], counts)
    pair[of_pairs] = np.concatenate([b.indices for b in links if b.arity == 2])
    ends = np.concatenate([b.placed(b.start.position) for b in links if b.arity == 2])
    along[of_pairs] = ends[:, 0] - ends[:, 1]
    same: dict[tuple[int, bytes], list[np.ndarray]] = {}  # the links of bodies of one structure
    some = some[np.argsort(piece[some], kind="stable")]
    for rows in np.split(some, np.flatnonzero(np.diff(piece[some])) + 1):
        particles, local = np.unique(pair[rows], return_inverse=True)
        if len(particles) > 2 and len(rows) > _most_independent(w[particles] > 0, scene.particles.dim):
            key = (w[particles] > 0).tobytes() + local.astype(np.int32).tobytes()
            same.setdefault((len(particles), key), []).append(rows)
    for bodies in same.values():
        rows = np.stack(bodies)
        particles, local = np.unique(pair[rows[0]], return_inverse=True)
        out[rows[_implied_in(along[rows], local.reshape(-1, 2), w[particles] > 0)]] = True
    return out


def _implied_in(along: np.ndarray, local: np.ndarray, movable: np.ndarray) -> np.ndarray:
    """Return which links others imply in bodies of one structure, (bodies, links).

    along: (bodies, links, dim), the links as vectors. local: (links, 2), their ends. movable: which particles can move.
    """
    count, m, dim = along.shape
    J, k, body = np.zeros((count, m, len(movable), dim)), np.arange(m), np.arange(count)
    J[:, k, local[:, 0]] = along / np.linalg.norm(along, axis=2, keepdims=True)
    J[:, k, local[:, 1]] = -J[:, k, local[:, 0]]
    J = J[:, :, movable].reshape(count, m, -1)
    chosen, is_rigid = np.zeros((count, m), dtype=bool), np.ones((count, 1), dtype=bool)
    for _ in range(_most_independent(movable, dim)):
        size = np.where(chosen, -1.0, (J**2).sum(axis=2))
        best = np.argmax(size, axis=1)
        largest = size[body, best, None]
        is_rigid &= largest > FIRM
        chosen[body, best] = True
        q = J[body, best] / np.sqrt(np.maximum(largest, FIRM))
        J -= (J @ q[:, :, None]) * q[:, None]
    return is_rigid & ~chosen


def _most_independent(movable: np.ndarray, dim: int) -> int:
    """Return how many links hold a body of three or more particles. movable: which of them can move."""
    motions, fixed = RIGID_MOTIONS[dim], int((~movable).sum())
    return dim * int(movable.sum()) - motions[min(fixed, len(motions) - 1)]


def _may_be_implied(b: Any, scene: "Scene") -> np.ndarray:
    """Return which constraints are rigid links with constant lengths that they have at the start, (m,)."""
    if b.arity != 2 or not b.quantity.is_distance or b.side or b.breaks or b.driven:
        return np.zeros(b.count, dtype=bool)
    x = b.start.position
    return (b.compliance == 0) & (b.goal > 0) & (np.abs(b.violation(x)) * b.inverse_size(x) <= CONSISTENT)
