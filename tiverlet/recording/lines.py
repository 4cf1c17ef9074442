"""Links as few points: long strips of one colour. Also finds which links form a sheet."""

from collections import defaultdict
from itertools import combinations

import numpy as np

FLAT = 0.1  # the diagonals of a cell pass each other within this share of their length
STRAIGHT = 1e-3  # a link that passes a particle within this share of its length lies on the two links to it


class Lines:
    """Links as strips. pairs: particles, (m, 2).

    Every link is in one strip. Strips are as long as possible, so that most particles occur once. In a frame, a strip ends where
    the colour changes.
    """

    def __init__(self, pairs: np.ndarray):
        self.particles, self._link = trails(pairs)

    def strips(self, hues: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the strips of a frame: the particles of all strips, (k,), their ends, (s + 1,), and their colours as u32, (s,).

        Strip k has the particles from ends[k] to ends[k + 1]. hues: the colour of each link as i64, (m,); -1 for one that is not
        drawn.
        """
        here = np.where(self._link < 0, -1, hues[self._link])  # the colour from each particle to the next
        edge = np.flatnonzero(np.diff(here, prepend=-1, append=-1))
        begin, end = edge[:-1], edge[1:]
        drawn = here[begin] >= 0 if len(begin) else np.zeros(0, dtype=bool)
        begin, end = begin[drawn], end[drawn]
        count = end - begin + 1
        ends = np.concatenate([[0], np.cumsum(count)])
        at = np.arange(ends[-1]) + np.repeat(begin - ends[:-1], count)
        return self.particles[at], ends, here[begin].astype(np.uint32)


def trails(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return walks along links that use each link once: the particles on them, and the link to the next particle, -1 at the end.

    Where it can, a walk continues with the same increment of the particle number. So it follows the rows of a sheet, in the order
    in which particles are sent.
    """
    ways: dict[int, dict[int, int]] = defaultdict(dict)  # for each particle: its neighbours, and the links to them
    again = []  # further links between the same two particles
    for link, (i, j) in enumerate(pairs.tolist()):
        if i == j or j in ways[i]:
            again.append(link)
        else:
            ways[i][j] = ways[j][i] = link
    particles: list[int] = []
    links: list[int] = []
    odd = [i for i in sorted(ways) if len(ways[i]) % 2]
    for start in [*odd, *sorted(ways)]:
        while ways[start]:
            i, step = start, 1
            while ways[i]:
                j = i + step if i + step in ways[i] else next(iter(ways[i]))
                particles.append(i)
                links.append(ways[i].pop(j))
                del ways[j][i]
                i, step = j, j - i
            particles.append(i)
            links.append(-1)
    for link in again:
        particles += pairs[link].tolist()
        links += [link, -1]
    return np.array(particles, dtype=np.int64), np.array(links, dtype=np.int64)


def cells(pairs: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which links are part of a sheet, (m,), and its cells, (c, 4): four particles in order around, with six links."""
    near: dict[int, set[int]] = defaultdict(set)
    for i, j in pairs.tolist():
        near[i].add(j)
        near[j].add(i)
    lies = np.zeros(len(pairs), dtype=bool)
    for link, (i, j) in enumerate(pairs.tolist()):
        both = [*(near[i] & near[j])]
        if both:
            off = np.linalg.norm(x[both] - (x[i] + x[j]) / 2, axis=1).min()
            lies[link] = off < STRAIGHT * np.linalg.norm(x[i] - x[j])
    for i, j in pairs[lies].tolist():
        near[i].discard(j)
        near[j].discard(i)
    found = []
    for i, j in pairs[~lies].tolist():  # i to j as one diagonal; k to m is the other
        for k, m in combinations(sorted(near[i] & near[j]), 2):
            if m in near[k] and min(i, j) < min(k, m):
                off = np.linalg.norm(x[i] + x[j] - x[k] - x[m]) / 2
                if off < FLAT * min(np.linalg.norm(x[i] - x[j]), np.linalg.norm(x[k] - x[m])):
                    found.append([i, k, j, m])
    inside = {tuple(sorted(edge)) for cell in found for edge in combinations(cell, 2)}
    used = lies | np.array([tuple(sorted(pair)) in inside for pair in pairs.tolist()], dtype=bool)
    return used, np.array(found, dtype=np.int64).reshape(-1, 4)
