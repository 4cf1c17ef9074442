"""Places at which rigid constraints are met, for particles that the user put elsewhere.

A pass takes out whatever violation it finds, in one substep: as a spring of stiffness 1 / (W h^2) would, with the energy
C^2 / (2 W h^2), which no shorter substep bounds. Nobody supplied it. So what is placed anew first goes to where its rigid
constraints are met, by Newton's method with the least moves in the metric of the masses, and its velocities stay:

    x += s w J^T lam,  (J w J^T + mu W) lam = -C,  W = sum_j n_j w_j |grad_j C|^2

for each body by itself, that is, for constraints that hang together by particles that can move. s is halved until the violation
falls; no particle moves further in a step than its body is large, and no leg of an angle changes by more than half. From afar
an angle is flat: Newton's step, pi r^2 / L for one that has to be straight between two pins L apart, would throw its corner away,
or into one of the pins. Where constraints contradict each other, bodies go to where sum C^2 / W is least, that is, where passes,
which split masses, find nothing to do, and the report says what is left. Newton's steps know J alone, so across what is pulled in
a line they do not get there; the last of the way is gone in passes. Systems soften all rows alike, so theirs have the same
weight. A straight rope that is too long for its two pins has no direction to give way in, so a body whose links are pushed bulges
first: across all in which it extends, and down where it can. Walls have the last word: what they stop goes on, in turns.

In a world that runs, part of a violation bears the load of the last substep, -W lam, or less of it in a shorter one. That part
stays, of constraints whose particles were put nowhere else.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ..constraints.core.scalar import Scalar
from ..device import ti
from ..features.feature import Batch, Feature, Scene
from ..neighbours.queries import between
from ..solvers.corners import bodies_of, corners_of
from .clock import MET
from .jacobian import Jacobian

SEEN = 1e-3  # of its size: a violation from where on the report says that it was taken out
ENOUGH = 0.2  # of its size: a violation after which loads are others
ROUNDING = {ti.f32: 8 * 2.0**-24, ti.f64: 8 * 2.0**-53}  # of coordinates: what lengths lose, and the Newton steps with them
NEWTON = 60  # steps at most
STEPS, LEFT = 1000, 1e-8  # of conjugate gradients in each, at most; what of r . z they may leave
PASSES, FLAT = 300, 1e-10  # after them, at most; what sum C^2 / W falls by in one, of it, where it is least
TURNS = 16  # with walls, at most: a link that stands on one halves its violation in each
LEAST = 1e-2  # part of a step: where even less does not help, nothing does
BETTER = 0.999  # of its square: a violation that falls by less in a step contradicts others
THIN = 1e-3  # of the longest: an axis along which a body does not extend


def forget(scene: Scene, batches: list[Batch], x: np.ndarray) -> None:
    """Before particles are put to x, (n, dim): of constraints that this changes no load is known."""
    for b in _rigid(batches):
        lam = scene.memory.read(b.dev.equation.lam)
        if lam.any():
            old = scene.state.get(scene.memory)
            off = np.abs(b.violation(x) - b.violation(old)) * b.inverse_size(b.start.position) > SEEN
            lam[: b.count][off] = 0.0
            scene.memory.write(b.dev.equation.lam, lam)
            b.forget_loads(off)


def left(batches: list[Batch], x: np.ndarray) -> list[tuple[Batch, np.ndarray]]:
    """By how much rigid constraints that act both ways are off at x, (n, dim), as shares of their sizes, (m,), where above SEEN;
    else 0. Where remove() leaves that, they contradict each other."""
    some = [b for b in _rigid(batches) if b.side == 0]
    off = [(b, np.abs(b.violation(x) * b.inverse_size(x) * (b.compliance == 0) * ~b.broken)) for b in some]
    return [(b, np.where(share > SEEN, share, 0.0)) for b, share in off]


def first_off(features: list[Feature], x: np.ndarray) -> int | None:
    """The first particle of rigid constraints that are off by more than SEEN at x, (n, dim); None where none is."""
    rigid = _rigid([f for f in features if isinstance(f, Batch)])
    return min((i for b in rigid for i in _off_corners(b, x, b.compliance == 0)), default=None)


def first_stiffened(features: Sequence[Feature], x: np.ndarray) -> int | None:
    """The same of those that are springs on the device, and rigid by what was assigned: they would be blows."""
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
    """The particles of those of its constraints, of the mask `some`, that are off by more than SEEN at x, (n, dim)."""
    if not some.any():
        return []
    C = batch.violation(x) * batch.inverse_size(x) * some
    off = (np.abs(C) if batch.side == 0 else C * batch.side) > SEEN
    return batch.indices.ravel()[off[batch.owner]].tolist()


def _rigid(batches: list[Batch]) -> list[Scalar]:
    """Those with rigid constraints."""
    return [b for b in batches if isinstance(b, Scalar) and b.count and (b.compliance == 0).any()]


def tied(scene: Scene, batches: list[Batch], placed: int) -> np.ndarray:
    """Which particles are of bodies of which any was placed anew, a mask (n,). placed: the first of those that were."""
    body, bodies = _bodies([b for b in batches if isinstance(b, Scalar) and b.count], scene.inv_mass)
    going = np.bincount(body[placed:], minlength=bodies) > 0
    return (going[body] & (scene.inv_mass > 0)) | (np.arange(len(body)) >= placed)


def remove(
    scene: Scene, batches: list[Batch], placed: int, ratio: float, stop: Callable[[np.ndarray], None]
) -> tuple[np.ndarray, float] | None:
    """Move bodies to where their rigid constraints are met, or as near to it as they get; those that are there stay.

    placed: the first of the particles that were placed anew; bodies without any stay as they are. ratio: of the coming substep to
    the last. stop: lets walls stop what has moved from some places, (n, dim). Returns how far each particle went [m], (n,), and
    the violation of the worst constraint that was taken out, as a share of its size; None where nothing moved.
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
        rows = rows.towards(_borne(scene, rigid, x, going[body], min(1.0, ratio**2)))
    going = (np.bincount(body[placed:], minlength=bodies) > 0) & _open(rows, body, bodies)
    if not going.any():
        return None
    far, _ = _violation(rows, body, bodies)
    new, moving = x, going.copy()
    for _ in range(TURNS):
        old = new
        state.put(memory, met(rows, body, moving))
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
        memory.write(b.dev.equation.lam, np.where(here, 0.0, lam))  # they bear nothing there yet
        b.forget_loads(here)
    return np.linalg.norm(new - x, axis=1), float(far[going].max())


def _off(batch: Scalar, x: np.ndarray) -> bool:
    """Whether any of its constraints is violated by more than rounding: what is asked of every scene, so it is quick."""
    C = batch.violation(x)
    return bool(((np.abs(C) if batch.side == 0 else C * batch.side) > MET * np.maximum(np.abs(batch.goal), MET)).any())


def _borne(scene: Scene, batches: list[Scalar], x: np.ndarray, others: np.ndarray, part: float) -> list[np.ndarray]:
    """The violations by which passes bear the load of the last substep, -W lam, a part of them in a shorter one; none in systems,
    which bear it without, nor where the particle is one of the `others`, (n,)."""
    split, out = scene.memory.read(scene.slots.split)[: len(x)].astype(np.float64), []
    for b in batches:
        g = b.gradients(x).reshape(-1, x.shape[1])
        who = b.indices.ravel()
        W = np.bincount(b.owner, split[who] * (g**2).sum(axis=1), minlength=b.count)
        gone = np.bincount(b.owner, others[who], minlength=b.count) > 0
        lam = b.sagging
        out.append(np.where((scene.slots.rows(b) >= 0) | gone, 0.0, -part * W * lam))
    return out


def met(rows: "Rows", body: np.ndarray, going: np.ndarray) -> np.ndarray:
    """Places near those of the rows, (n, dim), at which their constraints are met, or as nearly as they can be.

    body: that of each particle (n,). going: which bodies move.
    """
    rows = _relaxed(_newton(rows, body, going), body, going)
    worst, left = _violation(rows, body, len(going))
    pushed = going & (worst > SEEN) & _pushed(rows, body, len(going))
    if pushed.any():
        bulged = _relaxed(_newton(rows.at(_bulged(rows, body, pushed, worst)), body, pushed), body, pushed)
        better = pushed & (_violation(bulged, body, len(going))[1] < BETTER * left)
        return np.where(better[body][:, None], bulged.x, rows.x)
    return rows.x


def _newton(rows: "Rows", body: np.ndarray, going: np.ndarray) -> "Rows":
    """The rows where Newton's method ends."""
    going, bodies = going.copy(), len(going)
    x = rows.x
    far = np.ones(bodies)
    for _ in range(NEWTON):
        _, size = _violation(rows, body, bodies)
        going &= _open(rows, body, bodies)
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
    return rows


def _relaxed(rows: "Rows", body: np.ndarray, going: np.ndarray) -> "Rows":
    """The rows where passes leave those bodies whose constraints contradict each other. Where an f is curved, passes do not take
    out what violations there are."""
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
    """The body of each particle, the last one for those that no constraint can move; and how many there are."""
    m = sum(b.count for b in batches)
    return bodies_of(m, *corners_of(batches), w)[1], m + 1


def _violation(rows: "Rows", body: np.ndarray, bodies: int) -> tuple[np.ndarray, np.ndarray]:
    """The largest violation of each body, relative to the sizes of the constraints, and what it stores, sum C^2 / W."""
    of = _of(rows, body, bodies)
    worst = np.zeros(bodies)
    np.maximum.at(worst, of, np.abs(rows.C * rows.close))
    return worst, np.bincount(of, (rows.C * rows.scale) ** 2, minlength=bodies)


def _open(rows: "Rows", body: np.ndarray, bodies: int) -> np.ndarray:
    """Which bodies have a violation beyond rounding."""
    return np.bincount(_of(rows, body, bodies), rows.open, minlength=bodies) > 0


def _pushed(rows: "Rows", body: np.ndarray, bodies: int) -> np.ndarray:
    """Which bodies have links that would be longer."""
    short = (rows.C < 0) & np.concatenate([np.full(some.sum(), b.arity == 2) for b, some in rows.active])
    return np.bincount(_of(rows, body, bodies), short, minlength=bodies) > 0


def _bulged(rows: "Rows", body: np.ndarray, pushed: np.ndarray, strain: np.ndarray) -> np.ndarray:
    """Places of bodies that bulge as an arc does that is longer than its chord by the strain: by sqrt(3 / 8 strain) of it."""
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

    Corner k belongs to row[k] and is particle who[k]. rounding: of coordinates. borne: of each batch, what violations bear.
    sizes, weights: of each batch, what makes violations shares of its constraints, and W at the start.
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
        self.C, self.close = (
            np.concatenate([v[some] for v, some in zip(values, active, strict=True)]) for values in (found, self.sizes)
        )
        self.who = np.concatenate([b.indices.ravel()[some] for b, some in zip(batches, self.corners, strict=True)])
        counts = np.concatenate([np.bincount(b.owner, minlength=b.count)[some] for b, some in self.active])
        self.row = np.repeat(np.arange(len(self.C)), counts)
        self.first = np.cumsum(counts) - counts  # corner of each row
        self.J = np.concatenate([g[some] for g, some in zip(gradients, self.corners, strict=True)])
        W = np.concatenate([v[some] for v, some in zip(self.weights, active, strict=True)])
        self.scale = np.divide(1, np.sqrt(W), out=np.zeros(len(W)), where=W > 0)

    def _weights(self, gradients: list[np.ndarray]) -> list[np.ndarray]:
        """W of each batch; rows of systems, which are softened alike, have the same."""
        split = self.w * sum(np.bincount(b.indices.ravel(), minlength=len(self.w)) for b in self.batches)
        out = []
        for b, g in zip(self.batches, gradients, strict=True):
            W = np.bincount(b.owner, split[b.indices.ravel()] * (g**2).sum(axis=1), minlength=b.count)
            together = b.scene.slots.rows(b) >= 0
            out.append(np.where(together, W[together].mean() if together.any() else 0.0, W))
        return out

    def at(self, x: np.ndarray) -> "Rows":
        """Those that act at other positions."""
        return Rows(self.batches, x, self.w, self.rounding, self.borne, self.sizes, self.weights)

    def towards(self, borne: list[np.ndarray]) -> "Rows":
        """The same, which keep what bears loads."""
        return Rows(self.batches, self.x, self.w, self.rounding, borne, self.sizes, self.weights)

    @property
    def open(self) -> np.ndarray:
        """Which are violated by more than rounding: of coordinates X it changes C by about X |grad C|, (rows,)."""
        slope = np.sqrt(np.bincount(self.row, (self.J**2).sum(axis=1), minlength=len(self.C)))
        X = np.abs(self.x[self.who[self.first]]).max(axis=1, initial=0.0)
        return np.abs(self.C) * self.close > MET + self.rounding * X * slope * self.close

    @property
    def legs(self) -> np.ndarray:
        """The corners of angles from which a leg leads to the next."""
        angles = [b.quantity.curved and not b.quantity.collapses for b in self.batches]
        angle = np.repeat(angles, [some.sum() for some in self.corners])
        return np.flatnonzero(angle[:-1] & (self.row[:-1] == self.row[1:]))

    def newton(self) -> np.ndarray:
        """The least moves that take C to 0, as far as it is linear."""
        return self._scaled.solve(-self.C * self.scale, enough=LEFT, steps=STEPS)

    def relaxed(self) -> np.ndarray:
        """The moves of one pass, -w J^T C / W."""
        return self._scaled.moves(-self.C * self.scale)

    @property
    def _scaled(self) -> Jacobian:
        """J, of C / sqrt(W)."""
        return Jacobian(len(self.C), self.row, self.who, self.w, self.J * self.scale[self.row, None])
