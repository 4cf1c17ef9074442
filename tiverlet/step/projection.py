"""Back to the rigid constraints where the substep gets shorter: what is left of them would become energy.

A pass holds a load F by a violation C = D h^2 F, as a spring of stiffness 1 / (D h^2) would. A shorter substep makes that spring
stiffer while it is stretched, and its energy (h / h')^2 times as large. So positions and velocities first go to where constraints
are fulfilled, by the least moves in the metric of the masses:

    x += w J^T lam,  (J w J^T + mu) lam = -C;     v += w J^T lam,  (J w J^T + mu) lam = -J v

for what is violated. Positions move without velocities, as contacts do that an impact left overlapping.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..constraints.core.scalar import Scalar

if TYPE_CHECKING:
    from ..world import World

SHORTER = 0.75  # of what it was: a substep from where on it matters
ENOUGH = 1e-3  # of its size: a violation whose energy in the shorter substep matters, times (h' / h)^2
NEWTON = 20  # steps, at most, and the least part of one
LEAST = 1e-2
DONE = 1e-6  # of its size: a violation that is none
STEPS = 200  # of conjugate gradients in each, at most
SOFT = 1e-6  # of the diagonal: what has hardly a direction to move in stays


def project(world: "World", ratio: float) -> None:
    """Fulfil rigid constraints; d holds velocities. Nothing happens where they are, or where particles would overlap.

    ratio: of the coming substep to the last one.
    """
    enough = ENOUGH * ratio**2
    slots = world._scene.slots
    eliminated = slots and slots.system and not slots.system.steps  # holds loads without a violation
    batches = [b for b in world._batches if isinstance(b, Scalar) and b.joins and b.count and not b.breaks]
    batches = [b for b in batches if not (eliminated and (slots.rows(b) >= 0).any())]
    w, state, memory = world._scene.inv_mass, world._scene.state, world._memory
    if not batches:
        return
    x = before = state.get(memory)
    if not np.isfinite(x).all() or (rows := Rows(batches, x, w)).worst <= enough:
        return
    first, far = rows, 1.0
    for _ in range(NEWTON):
        move = rows.solve(-rows.C, SOFT)
        new = Rows(batches, x + far * move, w)
        while new.size >= rows.size and far > LEAST:
            far /= 2
            new = Rows(batches, x + far * move, w)
        if new.size >= rows.size:
            break
        x, rows, far = new.x, new, min(1.0, 2 * far)
        if rows.worst <= max(0.1 * enough, DONE):
            break
    v = memory.read(state.d).astype(np.float64)
    n = len(x)
    rows = Rows(batches, x, w, first.active)
    v[:n] += rows.solve(-rows.rates(v[:n]), SOFT)
    overlap = _overlap(world)
    state.put(memory, x)
    if overlap is not None and (_overlap(world) or 0.0) > overlap:
        state.put(memory, before)
    else:
        memory.write(state.d, v)


def _overlap(world: Any) -> float | None:
    """That of the worst contact, in radii; None without contacts."""
    if not world._sub.contacts:
        return None
    world._look()
    return world._report().overlap


class Rows:
    """The rigid constraints that act: their violations, and their gradients by corners."""

    def __init__(self, batches: list[Scalar], x: np.ndarray, w: np.ndarray, active: list[np.ndarray] | None = None):
        self.x, self.n, self.dim, self.w = x, len(x), x.shape[1], w
        found = [b.violation(x) for b in batches]
        if active is None:
            active = [
                (b.compliance == 0) & ((C * b.side > 0) if b.side else True) & ~b.idle(w)
                for b, C in zip(batches, found, strict=True)
            ]
        self.active = active
        slopes = [b.slopes(x)[some] for b, some in zip(batches, active, strict=True)]
        self.C = np.concatenate([C[some] for C, some in zip(found, active, strict=True)])
        self.who = np.concatenate([b.indices[some].ravel() for b, some in zip(batches, active, strict=True)])
        arity = np.concatenate([np.full(len(g), b.arity) for b, g in zip(batches, slopes, strict=True)])
        self.row = np.repeat(np.arange(len(self.C)), arity)
        self.J = np.concatenate([g.reshape(-1, self.dim) for g in slopes])
        close = np.concatenate([b.closeness(b.start.position)[some] for b, some in zip(batches, active, strict=True)])
        self.worst, self.size = float(np.abs(self.C * close).max(initial=0.0)), float(((self.C * close) ** 2).sum())
        self.diagonal = np.bincount(self.row, w[self.who] * (self.J**2).sum(axis=1), minlength=len(self.C))

    def rates(self, v: np.ndarray) -> np.ndarray:
        """J v."""
        return np.bincount(self.row, (self.J * v[self.who]).sum(axis=1), minlength=len(self.C))

    def moves(self, lam: np.ndarray) -> np.ndarray:
        """w J^T lam."""
        pull = self.J * lam[self.row][:, None]
        return np.stack([self.w * np.bincount(self.who, pull[:, a], minlength=self.n) for a in range(self.dim)], axis=1)

    def solve(self, right: np.ndarray, soft: float) -> np.ndarray:
        """w J^T lam with (J w J^T + mu) lam = right, by conjugate gradients with the diagonal for a preconditioner.

        mu: `soft` of the diagonal.
        """
        mu = soft * self.diagonal
        scale = np.divide(1, self.diagonal + mu, out=np.zeros_like(mu), where=self.diagonal > 0)
        lam, r = np.zeros_like(right), right
        p = scale * r
        now = first = float(r @ p)
        for _ in range(STEPS):
            if now <= 1e-12 * first:
                break
            q = self.rates(self.moves(p)) + mu * p
            step = now / float(p @ q)
            lam, r = lam + step * p, r - step * q
            z = scale * r
            now, last = float(r @ z), now
            p = z + now / last * p
        return self.moves(lam)
