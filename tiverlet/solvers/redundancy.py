"""Links that others imply: a body needs no more links than hold it."""

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from .corners import components

if TYPE_CHECKING:
    from ..features.feature import Scene

CONSISTENT = 1e-5  # of its length: a link violated by more contradicts the others, which then imply nothing
FIRM = 1e-10  # the least square of a row across all rows chosen before it; of a beam of 8 cells the last one has 1e-4
MOST = 300  # links of a body up to which it is examined
RIGID_MOTIONS = {2: (3, 1, 0), 3: (6, 3, 1, 0)}  # of a body with 0, 1, 2, ... fixed particles, by dimension


def implied_links(links: "list[Any]", scene: "Scene") -> np.ndarray:
    """Return which constraints of these batches others imply, numbered through, (m,).

    These are rigid links of bodies that move as one. Of the rows (u, -u) of J, with directions u of links between n movable
    particles, rank J = dim n - (rigid motions) are independent. They hold all distances, so that any further link has its length
    anyway. Solved with the others it would make a matrix without inverse. Of the rows, each next one is that with the largest
    part orthogonal to those before (QR with pivots). What else holds or joins bodies does not matter.
    """
    counts = [b.count for b in links]
    out = np.zeros(sum(counts), dtype=bool)
    dim, w = scene.particles.dim, scene.inv_mass
    pair, along = np.full((len(out), 2), -1), np.zeros((len(out), dim))
    of_pairs = np.repeat([b.arity == 2 for b in links], counts)
    if not of_pairs.any():
        return out
    pair[of_pairs] = np.concatenate([b.indices for b in links if b.arity == 2])
    ends = np.concatenate([b.placed(b.start.position) for b in links if b.arity == 2])
    along[of_pairs] = ends[:, 0] - ends[:, 1]
    fit = np.concatenate([_may_be_implied(b) for b in links])
    some = _core(np.flatnonzero(fit & (w[pair] > 0).any(axis=1)), pair, w > 0, dim)
    if not len(some):
        return out
    owner, item = np.repeat(np.arange(len(some)), 2), pair[some].ravel()
    piece = components(len(some), owner[w[item] > 0], item[w[item] > 0])
    order = np.argsort(piece, kind="stable")
    same: dict[tuple[int, bytes], list[np.ndarray]] = {}  # the links of pieces of one structure
    for rows in np.split(some[order], np.flatnonzero(np.diff(piece[order])) + 1):
        particles, local = np.unique(pair[rows], return_inverse=True)
        if len(rows) <= MOST:
            key = (w[particles] > 0).tobytes() + local.astype(np.int32).tobytes()
            same.setdefault((len(particles), key), []).append(rows)
    for pieces in same.values():
        rows = np.stack(pieces)
        ground = _links_between_fixed(pair[rows[0]], w)
        held = scene.particles.position[ground[:, 0]] - scene.particles.position[ground[:, 1]]
        for body in _bodies(np.concatenate([pair[rows[0]], ground]), np.concatenate([along[rows[0]], held]), rows.shape[1]):
            particles, local = np.unique(pair[rows[0, body]], return_inverse=True)
            if len(particles) > 2 and len(body) > _most_independent(w[particles] > 0, dim):
                some = rows[:, body]
                out[some[_implied_in(along[some], local.reshape(-1, 2), w[particles] > 0)]] = True
    return out


def _links_between_fixed(pair: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return links that hold the fixed particles of a piece in their places, (k, 2): the ground is a body, too."""
    fixed = np.unique(pair[w[pair] == 0])
    links = [(i, j) for j in fixed for i in fixed[:3] if i < j]
    return np.array(links, dtype=np.int64).reshape(-1, 2)


def _bodies(pair: np.ndarray, along: np.ndarray, count: int) -> list[np.ndarray]:
    """Return the links of each body that moves as one, of connected links `pair` along vectors `along`; of the first `count`."""
    local = np.unique(pair, return_inverse=True)[1].astype(np.int32)
    return _found_bodies(local.tobytes(), along.tobytes(), along.shape[1], count)


@lru_cache(maxsize=64)  # a world that is built anew or copied asks again
def _found_bodies(local: bytes, along: bytes, dim: int, count: int) -> list[np.ndarray]:
    """Return _bodies(), of links between particles that are numbered from 0, as bytes of i32 and f64.

    A body grows from a link, in 3D from a triangle, whose motions are those of a rigid body. Of all motions v that keep lengths,
    J v = 0, those in which the seed stays where it is leave just the particles of its body in their places.
    """
    pair, links = np.frombuffer(local, dtype=np.int32).reshape(-1, 2), np.frombuffer(along).reshape(-1, dim)
    n, motions = int(pair.max()) + 1, RIGID_MOTIONS[dim][0]
    sizes, kept = np.linalg.svd(_rows(links[None], pair, n)[0].reshape(len(pair), -1))[1:]
    free = kept[(sizes**2 > FIRM).sum() :].reshape(-1, n, dim)
    if len(free) == motions:
        return [np.arange(count)]
    joined = np.zeros((n, n), dtype=bool)
    joined[pair[:, 0], pair[:, 1]] = joined[pair[:, 1], pair[:, 0]] = True
    out, left = [], np.ones(len(pair), dtype=bool)
    while left.any():
        link = int(np.argmax(left))
        left[link] = False
        seed = [*pair[link], *np.flatnonzero(joined[pair[link, 0]] & joined[pair[link, 1]])[: dim - 2]]
        if len(seed) == dim:
            moves, size, _ = np.linalg.svd(free[:, seed].reshape(len(free), -1))
            still = moves[:, (size**2 > FIRM).sum() :].T
            body = (np.einsum("ij,jkl->ikl", still, free) ** 2).sum(axis=(0, 2)) <= FIRM
            inside = body[pair].all(axis=1)
            out.append(np.flatnonzero(inside[:count]))
            left &= ~inside
    return out


def _rows(along: np.ndarray, local: np.ndarray, particles: int) -> np.ndarray:
    """Return the rows of J of bodies with links along these vectors, (bodies, links, particles, dim)."""
    J, k = np.zeros((*along.shape[:2], particles, along.shape[2])), np.arange(along.shape[1])
    size = np.linalg.norm(along, axis=2, keepdims=True)
    J[:, k, local[:, 0]] = np.divide(along, size, out=np.zeros_like(along), where=size > 0)
    J[:, k, local[:, 1]] = -J[:, k, local[:, 0]]
    return J


def _core(links: np.ndarray, pair: np.ndarray, movable: np.ndarray, dim: int) -> np.ndarray:
    """Return those of some links that may imply each other: without particles that at most `dim` of them hold, one by one.

    Such a particle follows the others, so that no row depends on those of its links.
    """
    while True:
        degree = np.bincount(pair[links].ravel(), minlength=len(movable))
        stays = ((degree > dim) | ~movable)[pair[links]].all(axis=1)
        if stays.all():
            return links
        links = links[stays]


def _implied_in(along: np.ndarray, local: np.ndarray, movable: np.ndarray) -> np.ndarray:
    """Return which links others imply in bodies of one structure, (bodies, links).

    along: (bodies, links, dim), the links as vectors. local: (links, 2), their ends. movable: which particles can move.
    """
    count, m, dim = along.shape
    J, body = _rows(along, local, len(movable))[:, :, movable].reshape(count, m, -1), np.arange(count)
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
    """Return how many links hold a body of more than two particles. movable: which of them can move."""
    motions, fixed = RIGID_MOTIONS[dim], int((~movable).sum())
    return dim * int(movable.sum()) - motions[min(fixed, len(motions) - 1)]


def _may_be_implied(b: Any) -> np.ndarray:
    """Return which constraints are rigid links with constant lengths that they have at the start, (m,)."""
    if b.arity != 2 or not b.quantity.is_distance or b.side or b.breaks or b.driven:
        return np.zeros(b.count, dtype=bool)
    x = b.start.position
    return (b.compliance == 0) & (b.goal > 0) & (np.abs(b.violation(x)) * b.inverse_size(x) <= CONSISTENT)
