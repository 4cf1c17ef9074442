"""Pairs that contacts leave out, because constraints fix the distance of the two particles.

These are the pairs of each constraint, and pairs that a chain of links holds closer than the sum of their radii, with the lengths
l at the start:

    sum l <= r_i + r_j

Such a pair overlaps however the chain bends, as long as the links keep their lengths. Examples are a ball and the rope that ends
inside of it, or a bead and the next but one, if beads are thicker than the links are long. A contact would push against the links
for ever. Links that are compliant, or can break, do not count. For a hub inside of a polygon, its depth there stands for its
radius: so the pin of a hinge touches none of the corners around it.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..features.feature import Batch
from ..geometry.ordered import distinct
from .loops import depth_of

if TYPE_CHECKING:
    from ..particles import Particles
    from .edges import Outline

DIGIT = 1e-6  # relative tolerance of lengths, for beads that just touch
FOLDED = 0.25  # radii of the smaller particle: a link that is shorter at the start counts as folded up, and is skipped


def excluded_pairs(batches: Sequence[Batch], radius: np.ndarray, outline: "Outline | None" = None) -> np.ndarray:
    """Return pairs of particles that contacts leave out, (m, 2). radius: (n,) [m]. outline: None without bodies.

    Linked corners of two bodies are not left out: a link fixes their distance, not on which side of an edge of the other body
    each of them is. Boxes in a row, on two rods each, folded into each other. Only corners whose rims the link holds inside each
    other are left out. A particle of no body, as the hub of a plank, touches no body whose corners are in its cluster.
    """
    own = [b.excluded_pairs(b.start) for b in batches]
    limits = [b.max_distances() for b in batches]
    links, lengths = (np.concatenate(some) for some in zip((np.zeros((0, 2), dtype=np.int32), np.zeros(0)), *limits, strict=True))
    if outline and batches:
        body, x = outline.body, batches[0].start.position
        own = [pairs if b.clusters else pairs[~_joins(pairs, b.start, body)] for b, pairs in zip(batches, own, strict=True)]
        own += [_hubs(b.indices.ravel(), b.owner, body) for b in batches if b.clusters]
        own.append(_pins(np.concatenate(own), links, lengths, x, radius, outline))
    return np.concatenate([np.zeros((0, 2), dtype=np.int32), *own, _inside(links, lengths, radius)])


def _joins(pairs: np.ndarray, start: "Particles", body: np.ndarray) -> np.ndarray:
    """Return which pairs (m, 2) are corners of two bodies whose rims are not inside each other, (m,)."""
    i, j = pairs.T
    reach, distance = start.radius[i] + start.radius[j], np.linalg.norm(start.position[i] - start.position[j], axis=1)
    return (body[i] != body[j]) & (np.minimum(body[i], body[j]) >= 0) & ((reach == 0) | (distance > (1 + DIGIT) * reach))


def _hubs(who: np.ndarray, owner: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Return pairs of a particle in no body and a corner of a body in the same cluster. who: members; owner: their clusters."""
    inner, rim = np.flatnonzero(body[who] < 0), np.flatnonzero(body[who] >= 0)
    rim = rim[np.argsort(owner[rim], kind="stable")]
    first, last = (np.searchsorted(owner[rim], owner[inner], side) for side in ("left", "right"))
    each = np.repeat(np.arange(len(inner)), last - first)
    place = np.arange(len(each)) - np.repeat(np.cumsum(last - first) - last, last - first)
    return np.stack([who[inner[each]], who[rim[place]]], axis=1).astype(np.int32)


def _pins(
    pairs: np.ndarray, links: np.ndarray, lengths: np.ndarray, x: np.ndarray, radius: np.ndarray, outline: "Outline"
) -> np.ndarray:
    """Return pairs of a particle in no body and a corner of a body in which links of a hub hold it, as the pin of a hinge.

    pairs: (m, 2) that are left out; a hub is left out with all corners of its body. links, lengths: see _inside(). x: (n, 2) [m].
    """
    body, size, out = outline.body, radius.copy(), [np.zeros((0, 2), dtype=np.int32)]
    apart = (body[links] < 0).all(axis=1)
    links, lengths = links[apart], lengths[apart]
    inner, rim = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0).T
    some = (body[inner] < 0) & (body[rim] >= 0) & np.isin(inner, links)
    ties, count = np.unique(np.stack([inner, body[rim]], axis=1)[some], axis=0, return_counts=True)
    hubs = []
    for hub, k in ties[count == np.bincount(body[body >= 0])[ties[:, 1]]].tolist():
        loop = [int(np.argmax(body == k))]
        while (after := int(outline.ends[loop[-1], 0])) != loop[0]:
            loop.append(after)
        depth, _edge = depth_of(x[hub], x[loop])
        if depth > 0:
            hubs.append((hub, loop))
            size[hub] = depth
    near = np.concatenate([links[lengths <= size[links].sum(axis=1)], _inside(links, lengths, size)])
    for hub, loop in hubs:
        held = near[(near == hub).any(axis=1)].sum(axis=1) - hub
        out.append(np.stack([np.repeat(held, len(loop)), np.tile(loop, len(held))], axis=1).astype(np.int32))
    return np.concatenate(out)


def _inside(links: np.ndarray, lengths: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return pairs that chains of two or more links hold closer than the sum of their radii.

    links: (m, 2). lengths: (m,) [m]. radius: (n,) [m]. Paths start at the larger particle of a pair, and end when they are longer
    than its diameter.
    """
    some = lengths >= FOLDED * radius[links].min(axis=1)
    if lengths[some].min(initial=np.inf) > (1 + DIGIT) * radius.max(initial=0.0):
        return np.zeros((0, 2), dtype=np.int32)
    i, j = np.concatenate([links[some], links[some][:, ::-1]]).T.astype(np.int64)
    n, far = len(radius), np.tile(lengths[some], 2) * (1 - DIGIT)
    order = np.argsort(i, kind="stable")
    i, j, far = i[order], j[order], far[order]
    begin, degree = np.searchsorted(i, np.arange(n)), np.bincount(i, minlength=n)
    least = np.full(n, np.inf)
    np.minimum.at(least, i, far)
    known, ways = np.zeros(0, dtype=np.int64), np.zeros(0)  # a * n + b of each path from a to b, and its length
    a, b, way = i, j, far
    while len(a):
        goes = way + least[b] <= 2 * radius[a]
        a, b, way = a[goes], b[goes], way[goes]
        each = np.repeat(np.arange(len(a)), degree[b])
        link = begin[b[each]] + np.arange(len(each)) - np.repeat(np.cumsum(degree[b]) - degree[b], degree[b])
        a, b, way = a[each], j[link], way[each] + far[link]
        near = (way <= 2 * radius[a]) & (a != b)
        before = len(known)
        key, length = np.concatenate([known, a[near] * n + b[near]]), np.concatenate([ways, way[near]])
        shortest = np.lexsort([length, key])
        shortest = shortest[np.concatenate([[True], np.diff(key[shortest]) > 0])] if len(key) else shortest
        known, ways, new = key[shortest], length[shortest], shortest >= before
        a, b, way = known[new] // n, known[new] % n, ways[new]
    a, b = known // n, known % n
    close = (ways <= radius[a] + radius[b]) & (radius[b] <= radius[a])
    return distinct(np.sort(np.stack([a, b], axis=1)[close], axis=1))[0].astype(np.int32)
