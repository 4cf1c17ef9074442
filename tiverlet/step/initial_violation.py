"""Places at which rigid constraints are met, for particles that the user put elsewhere.

A pass takes out whatever violation it finds, in one substep: as a spring of stiffness 1 / (W h^2) would, with the energy
C^2 / (2 W h^2), which no shorter substep bounds. Nobody supplied it. So what is placed anew first goes to where its rigid
constraints are met, by Newton's method with the least moves in the metric of the masses, and its velocities stay:

    x += s w J^T lam,  (J w J^T + mu) lam = -C

for each body by itself, that is, for constraints that hang together by particles that can move. s is halved until the violation
falls; no particle moves further in a step than its body is large, and no leg of an angle changes by more than half. From afar
an angle is flat: Newton's step, pi r^2 / L for one that has to be straight between two pins L apart, would throw its corner away,
or into one of the pins. Where constraints contradict each other, the violation gets as small as it can, and the report says so;
links that do stay where they are, for their passes find the compromise between them. Walls have the last word: what they stop
goes on from there, in turns.
"""

from collections.abc import Callable

import numpy as np

from ..constraints.core.scalar import Scalar
from ..features.feature import Batch, Scene
from ..neighbours.queries import between
from .jacobian import Jacobian, bodies_of

ENOUGH = 0.2  # of its size: a violation from where on it is taken out before the first substep
DONE = 1e-6  # of its size: a violation that is none
NEWTON = 60  # steps at most
TURNS = 16  # with walls, at most: a link that stands on one halves its violation in each
LEAST = 1e-2  # part of a step: where even less does not help, nothing does
BETTER = 0.99  # of its square: a violation that falls by less in a step contradicts others


def remove(scene: Scene, batches: list[Batch], placed: int, stop: Callable[[np.ndarray], None]) -> np.ndarray | None:
    """Move bodies to where their rigid constraints are met, or as near to it as they get; those that are there stay.

    placed: the first of the particles that were placed anew; bodies without any stay as they are. stop: lets walls stop what has
    moved from some places, (n, dim). Returns how far each particle went [m], (n,); None where nothing moved.
    """
    w, state, memory = scene.inv_mass, scene.state, scene.memory
    rigid = [b for b in batches if isinstance(b, Scalar) and b.count and (b.compliance == 0).any() and not b.broken.any()]
    if not rigid:
        return None
    x = state.get(memory)
    if not np.isfinite(x).all() or not any(_off(b, x) for b in rigid):
        return None
    body, bodies = _bodies(rigid, w)
    going = np.bincount(body[placed:], minlength=bodies) > 0
    rows = Rows(rigid, x, w)
    going &= _violation(rows, body, bodies)[0] > ENOUGH
    if going.any():
        new, moving = x, going.copy()
        for _ in range(TURNS):
            old = new
            state.put(memory, met(rows, body, moving))
            sent = state.get(memory)
            stop(old)
            new = state.get(memory)
            rows = rows.at(new)
            stopped = np.bincount(body, (sent != new).any(axis=1), minlength=bodies) > 0
            moving &= stopped & (_violation(rows, body, bodies)[0] > DONE)
            if not moving.any():
                break
        for b in rigid:
            lam = memory.read(b.dev.lam)[: b.count]
            here = np.logical_or.reduceat(going[body[b.indices.ravel()]], np.searchsorted(b.owner, np.arange(b.count)))
            memory.write(b.dev.lam, np.where(here, 0.0, lam))  # they bear nothing there yet
        return np.linalg.norm(new - x, axis=1)
    return None


def _off(batch: Scalar, x: np.ndarray) -> bool:
    """Whether any of its constraints is violated by more than rounding: what is asked of every scene, so it is quick."""
    C = batch.violation(x)
    return bool(((np.abs(C) if batch.side == 0 else C * batch.side) > DONE * np.maximum(np.abs(batch.goal), DONE)).any())


def met(rows: "Rows", body: np.ndarray, going: np.ndarray) -> np.ndarray:
    """Places near those of the rows, (n, dim), at which their constraints are met. Links that contradict each other stay.

    body: that of each particle (n,). going: which bodies move.
    """
    going, bodies, start = going.copy(), len(going), rows.x
    x = start
    far = np.ones(bodies)
    for _ in range(NEWTON):
        worst, size = _violation(rows, body, bodies)
        going &= worst > DONE
        if not going.any():
            break
        move = rows.newton()
        move *= _within(move, rows, body, bodies)[:, None]
        tried = going.copy()
        while tried.any():
            x = np.where(tried[body][:, None], rows.x + far[body][:, None] * move, x)
            tried &= _violation(rows.at(x), body, bodies)[1] > BETTER * size
            far[tried] /= 2
            stuck = tried & (far < LEAST)
            x = np.where(stuck[body][:, None], rows.x, x)
            going &= ~stuck
            tried &= ~stuck
        far = np.minimum(1.0, 2 * far)
        rows = rows.at(x)
    stays = (_violation(rows, body, bodies)[0] > ENOUGH) & ~_curved(rows, body, bodies)
    return np.where(stays[body][:, None], start, x)


def _bodies(batches: list[Scalar], w: np.ndarray) -> tuple[np.ndarray, int]:
    """The body of each particle, the last one for those that no constraint can move; and how many there are."""
    ends = np.cumsum([0] + [b.count for b in batches])
    owner = np.concatenate([b.owner + end for b, end in zip(batches, ends[:-1], strict=True)])
    who = np.concatenate([b.indices.ravel() for b in batches])
    return bodies_of(int(ends[-1]), owner, who, w)[1], int(ends[-1]) + 1


def _violation(rows: "Rows", body: np.ndarray, bodies: int) -> tuple[np.ndarray, np.ndarray]:
    """The largest violation of each body, and the sum of the squares of all, relative to the sizes of the constraints."""
    of = _of(rows, body, bodies)
    C, worst = np.abs(rows.C * rows.close), np.zeros(bodies)
    np.maximum.at(worst, of, C)
    return worst, np.bincount(of, C**2, minlength=bodies)


def _curved(rows: "Rows", body: np.ndarray, bodies: int) -> np.ndarray:
    """Which bodies have constraints that passes cannot take to a compromise."""
    out = np.zeros(bodies, dtype=bool)
    for b in rows.batches:
        if b.curved:
            out[body[b.indices]] = True
    return out


def _within(move: np.ndarray, rows: "Rows", body: np.ndarray, bodies: int) -> np.ndarray:
    """The factor of each move, (n,), with which bodies move no further than they are large, and legs change by half at most."""
    of, x = _of(rows, body, bodies)[rows.row], rows.x[rows.who]
    low, high, longest = np.full((bodies, rows.dim), np.inf), np.full((bodies, rows.dim), -np.inf), np.zeros(bodies)
    np.minimum.at(low, of, x)
    np.maximum.at(high, of, x)
    np.maximum.at(longest, body, np.linalg.norm(move, axis=1))
    size = np.linalg.norm(np.where(high >= low, high - low, 0.0), axis=1)
    out = np.minimum(1.0, np.divide(size, longest, out=np.ones(bodies), where=longest > 0))
    legs = rows.legs
    i, j = rows.who[legs], rows.who[legs + 1]
    change = np.linalg.norm(move[j] - move[i], axis=1)
    leg = np.linalg.norm(between(rows.x[j], rows.x[i], rows.batches[0].periodic), axis=1)
    np.minimum.at(out, of[legs], np.divide(leg / 2, change, out=np.ones(len(leg)), where=(change > 0) & (leg > 0)))
    return out[body]


def _of(rows: "Rows", body: np.ndarray, bodies: int) -> np.ndarray:
    """The body of each row."""
    free = rows.w[rows.who] > 0
    of = np.full(len(rows.C), bodies - 1)
    of[rows.row[free]] = body[rows.who[free]]
    return of


class Rows:
    """The rigid constraints that act at positions x, and their violations C.

    Corner k belongs to row[k] and is particle who[k]. sizes: of each batch, what makes violations shares of its constraints.
    """

    def __init__(self, batches: list[Scalar], x: np.ndarray, w: np.ndarray, sizes: list[np.ndarray] | None = None):
        self.x, self.w, self.dim, self.batches = x, w, x.shape[1], batches
        self.sizes = [b.inverse_size(b.start.position) for b in batches] if sizes is None else sizes
        found = [b.violation(x) for b in batches]
        active = [
            (b.compliance == 0) & ((C * b.side > 0) if b.side else True) & ~b.idle(w) for b, C in zip(batches, found, strict=True)
        ]
        self.corners = [some[b.owner] for b, some in zip(batches, active, strict=True)]
        self.C, self.close = (
            np.concatenate([v[some] for v, some in zip(values, active, strict=True)]) for values in (found, self.sizes)
        )
        self.who = np.concatenate([b.indices.ravel()[some] for b, some in zip(batches, self.corners, strict=True)])
        counts = [np.bincount(b.owner, minlength=b.count)[some] for b, some in zip(batches, active, strict=True)]
        self.row = np.repeat(np.arange(len(self.C)), np.concatenate(counts))

    def at(self, x: np.ndarray) -> "Rows":
        """Those that act at other positions."""
        return Rows(self.batches, x, self.w, self.sizes)

    @property
    def legs(self) -> np.ndarray:
        """The corners of angles from which a leg leads to the next."""
        angle = np.concatenate([
            np.full(some.sum(), b.curved and not b.collapses) for b, some in zip(self.batches, self.corners, strict=True)
        ])  # fmt: skip
        return np.flatnonzero(angle[:-1] & (self.row[:-1] == self.row[1:]))

    def newton(self) -> np.ndarray:
        """The least moves that take C to 0, as far as it is linear."""
        gradients = [b.gradients(self.x).reshape(-1, self.dim) for b in self.batches]
        J = np.concatenate([g[some] for g, some in zip(gradients, self.corners, strict=True)])
        return Jacobian(len(self.C), self.row, self.who, self.w, J).solve(-self.C)
