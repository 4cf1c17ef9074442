"""Initial violation: moves particles that the user has placed to where their rigid constraints are satisfied.

A pass removes any violation that it finds in one substep, like a spring of stiffness 1 / (W h^2) with the energy
C^2 / (2 W h^2). No shorter substep bounds that energy, and nothing supplied it. So placed particles first move to where their
rigid constraints are satisfied, by Newton's method with the least moves in the metric of the masses. Velocities stay:

    x += s w J^T lam,  (J w J^T + mu W) lam = -C,  W = sum_j n_j w_j |grad_j C|^2

Each body, of constraints that movable particles connect, is solved by itself. s is halved until the violation falls. In a step no
particle moves further than the size of its body, and no leg of an angle changes by more than half. That is because the gradient
of an angle is small far away: the Newton step for an angle that must be straight between two pins L apart is pi r^2 / L, and
would throw its corner away, or into one of the pins.

Where constraints contradict each other, bodies move to the least sum C^2 / W. There, passes, which split masses, have nothing
left to do, and the report gives the remaining violation. Newton steps use J alone, so they do not get there across links pulled
in a line; passes do the rest. Systems soften all rows alike, so their rows have the same weight. A straight rope that is too long
for its two pins has no direction to give way in. So a body with compressed links bulges first: across all directions in which it
extends, and downwards if possible. Bodies that walls stop move again, in turns.

In a running world, part of a violation, -W lam, bears the load of the last substep; in a shorter substep a smaller part does.
That part stays for constraints whose particles were not placed.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ..constraints.core.scalar import Scalar
from ..constraints.path import Path
from ..device import ti
from ..features.feature import Batch, Feature, Scene
from ..neighbours.queries import between
from ..solvers.corners import bodies_of, corners_of
from .clock import MET
from .jacobian import Jacobian
from .sideways_rows import SidewaysRows

SEEN = 1e-3  # of its size: a violation from which on the report says that it was removed
ENOUGH = 0.2  # of its size: a violation after which known loads are reset
ROUNDING = {ti.f32: 8 * 2.0**-24, ti.f64: 8 * 2.0**-53}  # of coordinates: the error of lengths, and so of Newton steps
NEWTON = 60  # steps, at most
STEPS, LEFT = 1000, 1e-8  # of conjugate gradients in each, at most; the share of r . z at which they end
PASSES, FLAT = 300, 1e-10  # after them, at most; the relative decrease of sum C^2 / W in a pass at which they end
TURNS = 16  # with walls, at most: a link that stands on a wall halves its violation in each
LEAST = 1e-2  # smallest part of a Newton step that is tried
BETTER = 0.999  # of its square: a violation that falls by less in a step contradicts others
THIN = 1e-3  # of the longest axis: below, a body does not extend along an axis


def forget(scene: Scene, batches: list[Batch], x: np.ndarray) -> None:
    """Reset the known loads of constraints whose violation changes, before particles are put to x, (n, dim) [m]."""
    for b in _rigid(batches):
        lam = scene.memory.read(b.dev.equation.lam)
        if lam.any():
            old = scene.state.get(scene.memory)
            off = np.abs(b.violation(x) - b.violation(old)) * b.inverse_size(b.start.position) > SEEN
            lam[: b.count][off] = 0.0
            scene.memory.write(b.dev.equation.lam, lam)
            b.forget_loads(off)


def left(batches: list[Batch], x: np.ndarray) -> list[tuple[Batch, np.ndarray]]:
    """Return the violations of rigid two-sided constraints at x, (n, dim), by batch: shares of their sizes, (m,), 0 up to SEEN.

    Constraints that remove() leaves violated contradict each other.
    """
    some = [b for b in _rigid(batches) if b.side == 0]
    off = [(b, np.abs(b.violation(x) * b.inverse_size(x) * (b.compliance == 0) * ~b.broken)) for b in some]
    return [(b, np.where(share > SEEN, share, 0.0)) for b, share in off]


def first_off(features: list[Feature], x: np.ndarray) -> int | None:
    """Return the first particle of rigid constraints that are violated by more than SEEN at x, (n, dim); None without any."""
    rigid = _rigid([f for f in features if isinstance(f, Batch)])
    return min((i for b in rigid for i in _off_corners(b, x, b.compliance == 0)), default=None)


def first_stiffened(features: Sequence[Feature], x: np.ndarray) -> int | None:
    """Return the first particle of constraints that become rigid and are violated at x, (n, dim); None without any.

    These are still springs on the device, but a compliance of 0 was assigned. Their violations would act as blows.
    """
    stiffened = []
    for b in _rigid([f for f in features if isinstance(f, Batch) and f.acts]):
        if b.dev.spring.soft:
            alpha = b.scene.memory.read(b.dev.spring.alpha)[: b.count]
            stiffened += _off_corners(b, x, (b.compliance == 0) & (alpha > 0))
    for b in features:
        if isinstance(b, Batch) and b.clusters and b.acts and b.dev.spring.soft:  # type: ignore[attr-defined]
            alpha = b.scene.memory.read(b.dev.spring.alpha)[: b.count]
            stiffened += b.indices[((b.compliance == 0) & (alpha > 0))[b.owner]].tolist()  # type: ignore[attr-defined]
    return min(stiffened, default=None)


def _off_corners(batch: Scalar, x: np.ndarray, some: np.ndarray) -> list[int]:
    """Return the particles of constraints in the mask `some`, (m,), that are violated by more than SEEN at x, (n, dim)."""
    if not some.any():
        return []
    C = batch.violation(x) * batch.inverse_size(x) * some
    off = (np.abs(C) if batch.side == 0 else C * batch.side) > SEEN
    return batch.indices.ravel()[off[batch.owner]].tolist()


def _rigid(batches: list[Batch]) -> list[Scalar]:
    """Return the batches with rigid constraints."""
    return [b for b in batches if isinstance(b, Scalar) and b.count and (b.compliance == 0).any()]


def tied(scene: Scene, batches: list[Batch], placed: int) -> np.ndarray:
    """Return a mask of the particles whose body has any placed particle, (n,). placed: the first placed particle."""
    body, bodies = _bodies([b for b in batches if isinstance(b, Scalar) and b.count], scene.inv_mass)
    going = np.bincount(body[placed:], minlength=bodies) > 0
    return (going[body] & (scene.inv_mass > 0)) | (np.arange(len(body)) >= placed)


def move_to_curves(scene: Scene, batches: list[Batch], placed: int) -> tuple[np.ndarray, float] | None:
    """Move placed particles on rigid curves that are off by more than SEEN to where the curve is nearest.

    placed: the first placed particle. Returns what remove() does.
    """
    x = scene.state.get(scene.memory) if any(isinstance(b, Path) and not b.is_kinematic for b in batches) else np.zeros((0, 0))
    new, share = x.copy(), 0.0
    for b in batches:
        if isinstance(b, Path) and not b.is_kinematic:
            i, offset = b.indices[:, 0], b.offset(x)
            off = np.linalg.norm(offset, axis=1) / b.length * ((b.compliance == 0) & (i >= placed) & (scene.inv_mass[i] > 0))
            some = off > SEEN
            new[i[some]] -= offset[some]
            share = max(share, float(off.max(initial=0.0)))
    if not share > SEEN:
        return None
    scene.state.put(scene.memory, new)
    return np.linalg.norm(new - x, axis=1), share


def remove(
    scene: Scene, batches: list[Batch], placed: int, ratio: float, stop: Callable[[np.ndarray], None], steps: int = NEWTON
) -> tuple[np.ndarray, float] | None:
    """Move bodies to where their rigid constraints are satisfied, or as near as possible. Bodies that satisfy them stay.

    placed: the first placed particle; only bodies with a placed particle move. ratio: of the coming substep to the last. stop:
    lets walls stop particles that have moved from given positions, (n, dim). steps: of Newton's method, at most. Returns how far
    each particle moved, (n,) [m], and the worst violation that was removed, as a share of its size; None where nothing moved.
    """
    w, state, memory = scene.inv_mass, scene.state, scene.memory
    rigid = [b for b in _rigid(batches) if not b.broken.any()]
    if not rigid:
        return None
    x = state.get(memory)
    if not np.isfinite(x).all() or not any(_off(b, x) for b in rigid):
        return None
    rows = Rows(rigid, x, w, ROUNDING[ti.f64 if state.sums else scene.real])
    body, bodies = _bodies(rigid, w)
    far, _ = _violation(rows, body, bodies)
    going = far > ENOUGH
    if any(memory.read(b.dev.equation.lam).any() for b in rigid):
        rows = rows.with_goal(_borne(scene, rigid, x, going[body], min(1.0, ratio**2)))
    going = (np.bincount(body[placed:], minlength=bodies) > 0) & _open(rows, body, bodies)
    if not going.any():
        return None
    far, _ = _violation(rows, body, bodies)
    new, moving = x, going.copy()
    for _ in range(TURNS):
        old = new
        state.put(memory, met(rows, body, moving, steps))
        sent = state.get(memory)
        stop(old)
        new = state.get(memory)
        rows = rows.at(new)
        stopped = np.bincount(body, (sent != new).any(axis=1), minlength=bodies) > 0
        moving &= stopped & _open(rows, body, bodies)
        if not moving.any():
            break
    for b in rigid:
        lam = memory.read(b.dev.equation.lam)[: b.count]
        others = (going & (far > ENOUGH))[body[b.indices.ravel()]]
        here = np.logical_or.reduceat(others, np.searchsorted(b.owner, np.arange(b.count)))
        memory.write(b.dev.equation.lam, np.where(here, 0.0, lam))  # these constraints bear no load there yet
        b.forget_loads(here)
    return np.linalg.norm(new - x, axis=1), float(far[going].max())


def _off(batch: Scalar, x: np.ndarray) -> bool:
    """Whether any of its constraints is violated by more than rounding. A fast test, because every scene takes it."""
    C = batch.violation(x)
    return bool(((np.abs(C) if batch.side == 0 else C * batch.side) > MET * np.maximum(np.abs(batch.goal), MET)).any())


def _borne(scene: Scene, batches: list[Scalar], x: np.ndarray, others: np.ndarray, part: float) -> list[np.ndarray]:
    """Return the violations -part W lam by which passes bear the load of the last substep, (m,) for each batch.

    part: what a shorter substep leaves of them. They are 0 for systems, which bear loads without violations, and for constraints
    with a particle in the mask `others`, (n,).
    """
    split, out = scene.memory.read(scene.slots.split)[: len(x)].astype(np.float64), []
    for b in batches:
        who, W = b.indices.ravel(), b.weights(x, split)
        gone = np.bincount(b.owner, others[who], minlength=b.count) > 0
        lam = b.sagging  # several passes leave less than W lam
        borne = part * -np.sign(lam) * np.minimum(W * np.abs(lam), np.abs(b.violation(x)))
        out.append(np.where((scene.slots.rows(b) >= 0) | gone, 0.0, borne))
    return out


def met(rows: "Rows", body: np.ndarray, going: np.ndarray, steps: int = NEWTON) -> np.ndarray:
    """Return positions near those of the rows, (n, dim), at which their constraints are satisfied as far as possible.

    body: the body of each particle, (n,). going: mask of the bodies that move. steps: of Newton's method; with fewer than usual,
    nothing else is tried where constraints contradict each other.
    """
    rows = _newton(rows, body, going, steps)
    if steps < NEWTON:
        return rows.x
    rows = _relaxed(rows, body, going)
    worst, left = _violation(rows, body, len(going))
    pushed = going & (worst > SEEN) & _pushed(rows, body, len(going))
    if pushed.any():
        bulged = _relaxed(_newton(rows.at(_bulged(rows, body, pushed, worst)), body, pushed), body, pushed)
        better = pushed & (_violation(bulged, body, len(going))[1] < BETTER * left)
        return np.where(better[body][:, None], bulged.x, rows.x)
    return rows.x


def _newton(rows: "Rows", body: np.ndarray, going: np.ndarray, steps: int = NEWTON) -> "Rows":
    """Return the rows at the positions where Newton's method ends."""
    going, bodies = going.copy(), len(going)
    x = rows.x
    far = np.ones(bodies)
    for _ in range(steps):
        _, size = _violation(rows, body, bodies)
        going &= _open(rows, body, bodies)
        if not going.any():
            break
        move = rows.newton()
        move[~np.isfinite(move)] = 0.0  # a function that is NaN here says nothing of where to go
        move *= _within(move, rows, body, bodies)[:, None]
        tried = going.copy()
        while tried.any():
            x = np.where(tried[body][:, None], rows.x + far[body][:, None] * move, x)
            tried &= ~(_violation(rows.at(x), body, bodies)[1] <= BETTER * size)  # a function may be NaN there
            far[tried] /= 2
            stuck = tried & (far < LEAST)
            x = np.where(stuck[body][:, None], rows.x, x)
            going &= ~stuck
            tried &= ~stuck
        far = np.minimum(1.0, 2 * far)
        rows = rows.at(x)
    return rows


def _relaxed(rows: "Rows", body: np.ndarray, going: np.ndarray) -> "Rows":
    """Return the rows after passes over the bodies whose constraints contradict each other.

    Bodies with a curved f are excluded: there, passes do not remove violations.
    """
    worst, size = _violation(rows, body, len(going))
    curved = np.concatenate([np.full(some.sum(), b.quantity.curved or b.quantity.collapses > 0) for b, some in rows.active])
    going = going & (worst > SEEN) & (np.bincount(_of(rows, body, len(going)), curved, minlength=len(going)) == 0)
    for _ in range(PASSES):
        if not going.any():
            break
        tried = rows.at(rows.x + np.where(going[body][:, None], rows.relaxed(), 0.0))
        _, less = _violation(tried, body, len(going))
        better = going & (less < size)
        rows = tried if (better == going).all() else rows.at(np.where(better[body][:, None], tried.x, rows.x))
        going, size = better & (less < (1 - FLAT) * size), np.where(better, less, size)
    return rows


def _bodies(batches: list[Scalar], w: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the body of each particle, and the number of bodies. The last body has all particles that no constraint can move."""
    m = sum(b.count for b in batches)
    return bodies_of(m, *corners_of(batches), w)[1], m + 1


def _violation(rows: "Rows", body: np.ndarray, bodies: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest violation of each body, as a share of the constraint's size, and the energy sum C^2 / W of each body."""
    of = _of(rows, body, bodies)
    worst = np.zeros(bodies)
    np.maximum.at(worst, of, np.abs(rows.C * rows.close))
    return worst, np.bincount(of, (rows.C * rows.scale) ** 2, minlength=bodies)


def _open(rows: "Rows", body: np.ndarray, bodies: int) -> np.ndarray:
    """Return a mask of the bodies with a violation beyond rounding."""
    return np.bincount(_of(rows, body, bodies), rows.open, minlength=bodies) > 0


def _pushed(rows: "Rows", body: np.ndarray, bodies: int) -> np.ndarray:
    """Return a mask of the bodies with compressed links."""
    short = (rows.C < 0) & np.concatenate([np.full(some.sum(), b.arity == 2) for b, some in rows.active])
    return np.bincount(_of(rows, body, bodies), short, minlength=bodies) > 0


def _bulged(rows: "Rows", body: np.ndarray, pushed: np.ndarray, strain: np.ndarray) -> np.ndarray:
    """Return positions at which bodies bulge like an arc longer than its chord by `strain`: by sqrt(3 / 8 strain) of it."""
    x = rows.x.copy()
    for b in np.flatnonzero(pushed):
        who = np.unique(rows.who[_of(rows, body, len(pushed))[rows.row] == b])
        r = between(x[who], x[who[0]], rows.batches[0].periodic)
        r = r - (r.max(axis=0) + r.min(axis=0)) / 2
        _, axes = np.linalg.eigh(r.T @ r)
        along = r @ axes
        half = np.abs(along).max(axis=0)
        wide = half > THIN * half.max()
        across = np.eye(rows.dim)[[1, 0, *range(2, rows.dim)]] * np.where(np.arange(rows.dim) == 0, -1.0, 1.0)[:, None]
        across = across - across @ axes[:, wide] @ axes[:, wide].T
        size = np.linalg.norm(across, axis=1)
        if size.max() > THIN:
            first = int(np.argmax(size > THIN))
            shape = np.prod(1 - (along[:, wide] / half[wide]) ** 2, axis=1) * half.max()
            shape *= 2 * np.sqrt(3 / 8 * min(strain[b], 1.0)) * (rows.w[who] > 0)
            x[who] += shape[:, None] * across[first] / size[first]
    return x


def _within(move: np.ndarray, rows: "Rows", body: np.ndarray, bodies: int) -> np.ndarray:
    """Return the factor of each move, (n,), with which no particle moves further than its body's size, nor a leg by half.

    A body whose particles are all in one place, such as a single bead, has no size: its moves are only as short as `far` says.
    """
    of, x = _of(rows, body, bodies)[rows.row], rows.x[rows.who]
    low, high, longest = np.full((bodies, rows.dim), np.inf), np.full((bodies, rows.dim), -np.inf), np.zeros(bodies)
    np.minimum.at(low, of, x)
    np.maximum.at(high, of, x)
    np.maximum.at(longest, body, np.linalg.norm(move, axis=1))
    size = np.linalg.norm(np.where(high >= low, high - low, 0.0), axis=1)
    out = np.minimum(1.0, np.divide(size, longest, out=np.ones(bodies), where=(longest > 0) & (size > 0)))
    legs = rows.leg_corners
    i, j = rows.who[legs], rows.who[legs + 1]
    change = np.linalg.norm(move[j] - move[i], axis=1)
    leg = np.linalg.norm(between(rows.x[j], rows.x[i], rows.batches[0].periodic), axis=1)
    np.minimum.at(out, of[legs], np.divide(leg / 2, change, out=np.ones(len(leg)), where=(change > 0) & (leg > 0)))
    return out[body]


def _of(rows: "Rows", body: np.ndarray, bodies: int) -> np.ndarray:
    """Return the body of each row."""
    free = rows.w[rows.who] > 0
    of = np.full(len(rows.C), bodies - 1)
    of[rows.row[free]] = body[rows.who[free]]
    return of


class Rows:
    """The rigid constraints that act at positions x, and their violations C.

    Corner k belongs to row[k] and is particle who[k]. rounding: of coordinates, relative. borne: for each batch, the violations
    that bear loads, which stay. sizes, weights: for each batch, the factors that turn violations into shares of the constraint's
    size, and W at the start.
    """

    def __init__(
        self, batches: list[Scalar], x: np.ndarray, w: np.ndarray, rounding: float, borne=None, sizes=None, weights=None
    ):  # fmt: skip
        self.x, self.w, self.dim, self.batches, self.rounding, self.borne = x, w, x.shape[1], batches, rounding, borne
        self.sizes = [b.inverse_size(b.start.position) for b in batches] if sizes is None else sizes
        gradients = [b.gradients(x).reshape(-1, self.dim) for b in batches]
        self.weights = self._weights(gradients) if weights is None else weights
        found = [b.violation(x) for b in batches]
        active = [
            (b.compliance == 0) & ((C * b.side > 0) if b.side else True) & ~b.immovable(w)
            for b, C in zip(batches, found, strict=True)
        ]
        self.active = list(zip(batches, active, strict=True))
        self.corners = [some[b.owner] for b, some in self.active]
        if borne is not None:
            found = [C - np.clip(C, np.minimum(some, 0), np.maximum(some, 0)) for C, some in zip(found, borne, strict=True)]
        none, nobody = np.zeros(0), np.zeros(0, dtype=np.int64)  # there may be no batches
        self.C, self.close, W = (
            np.concatenate([none, *(v[some] for v, some in zip(values, active, strict=True))])
            for values in (found, self.sizes, self.weights)
        )
        self.who = np.concatenate([nobody, *(b.indices.ravel()[some] for b, some in zip(batches, self.corners, strict=True))])
        counts = np.concatenate([nobody, *(np.bincount(b.owner, minlength=b.count)[some] for b, some in self.active)])
        self.row = np.repeat(np.arange(len(self.C)), counts)
        self.first = np.cumsum(counts) - counts  # corner of each row
        self.J = np.concatenate([x[:0], *(g[some] for g, some in zip(gradients, self.corners, strict=True))])
        self.scale = np.divide(1, np.sqrt(W), out=np.zeros(len(W)), where=W > 0)

    def _weights(self, gradients: list[np.ndarray]) -> list[np.ndarray]:
        """Return W of each batch. Rows of a system have the same W, because it softens all rows alike."""
        split = self.w * sum(np.bincount(b.indices.ravel(), minlength=len(self.w)) for b in self.batches)
        out = []
        for b, g in zip(self.batches, gradients, strict=True):
            W = np.bincount(b.owner, split[b.indices.ravel()] * (g**2).sum(axis=1), minlength=b.count)
            together = b.scene.slots.rows(b) >= 0
            out.append(np.where(together, W[together].mean() if together.any() else 0.0, W))
        return out

    def at(self, x: np.ndarray) -> "Rows":
        """Return the rows that act at positions x."""
        return Rows(self.batches, x, self.w, self.rounding, self.borne, self.sizes, self.weights)

    def with_goal(self, borne: list[np.ndarray]) -> "Rows":
        """Return these rows with the violations `borne`, which bear loads, as their goal."""
        return Rows(self.batches, self.x, self.w, self.rounding, borne, self.sizes, self.weights)

    @property
    def open(self) -> np.ndarray:
        """Mask of the rows that are violated by more than rounding, (rows,).

        Rounding of coordinates of size X changes C by about rounding * X |grad C|.
        """
        slope = np.sqrt(np.bincount(self.row, (self.J**2).sum(axis=1), minlength=len(self.C)))
        X = np.abs(self.x[self.who[self.first]]).max(axis=1, initial=0.0)
        return np.abs(self.C) * self.close > MET + self.rounding * X * slope * self.close

    @property
    def leg_corners(self) -> np.ndarray:
        """The corners of angles from which a leg leads to the next corner."""
        angles = [b.quantity.curved and not b.quantity.collapses for b in self.batches]
        angle = np.repeat(angles, [some.sum() for some in self.corners])
        return np.flatnonzero(angle[:-1] & (self.row[:-1] == self.row[1:]))

    def newton(self) -> np.ndarray:
        """Return the least moves that take the linearised C to 0, (n, dim), and bend no straight path across its plane."""
        m, row, who, J = len(self.C), [self.row], [self.who], [self.J * self.scale[self.row, None]]
        for (b, some), W in zip(self.active, self.weights, strict=True):
            if (straight := some & (W > 0) & b.straight).any():
                more = SidewaysRows(b, straight)
                row, who = [*row, m + more.owner], [*who, more.indices.ravel()]
                J.append((more.gradients(self.x) / np.sqrt(W[straight])[:, None, None]).reshape(-1, self.dim))
                m += more.count
        right = np.zeros(m)
        right[: len(self.C)] = -self.C * self.scale
        return Jacobian(m, np.concatenate(row), np.concatenate(who), self.w, np.concatenate(J)).solve(
            right, enough=LEFT, steps=STEPS
        )

    def relaxed(self) -> np.ndarray:
        """Return the moves of one pass, -w J^T C / W, (n, dim)."""
        scaled = Jacobian(len(self.C), self.row, self.who, self.w, self.J * self.scale[self.row, None])
        return scaled.moves(-self.C * self.scale)
