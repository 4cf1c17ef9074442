"""How far rigid constraints and clusters are from being met, as the host sees it: what has to settle, and what is left then."""

from collections.abc import Sequence
from functools import cached_property
from typing import TypeGuard

import numpy as np

from ..constraints.core.scalar import Scalar
from ..constraints.path import Path
from ..device import ti
from ..features.feature import Batch, Feature, Scene
from ..neighbours.queries import between
from ..solvers.corners import bodies_of
from .clock import MET
from .solids import Solids

SEEN = 1e-3  # of its size: a violation from which on the report says that it was removed
ENOUGH = 0.2  # of its size: a violation after which loads are reset
THIN = 1e-3  # of the longest axis: below, a body does not extend along an axis
ROUNDING = {ti.f32: 8 * 2.0**-24, ti.f64: 8 * 2.0**-53}  # of coordinates: the error of lengths


class Bodies:
    """The bodies of a scene, which movable particles connect through constraints, and how far their rigid ones are violated.

    body: the body of each particle, (n,); the last one has all that no constraint can move.
    """

    def __init__(self, scene: Scene, batches: list[Batch]):
        self.scene, self.batches = scene, [b for b in batches if b.count]
        self.count = 1 + sum(b.count for b in self.batches)
        self.of, self.body = bodies_of(self.batches, scene.inv_mass)
        self.solids = Solids(self.batches, scene.inv_mass)
        self.close = {b: b.inverse_size(b.start.position) for b in self.batches if isinstance(b, Scalar)}
        self.rounding = ROUNDING[ti.f64 if scene.state.sums else scene.real]
        self.digit = ROUNDING[scene.real]  # with which the device computes violations, relative to their sizes

    @cached_property
    def size(self) -> np.ndarray:
        """The least size of a constraint of each body [m], (bodies,)."""
        out = np.full(self.count, np.inf)
        for b, of in zip(self.batches, self.of, strict=True):
            if isinstance(b, Scalar):
                np.minimum.at(out, of, np.divide(1, self.close[b], out=np.full(b.count, np.inf), where=self.close[b] > 0))
        if self.solids.count:
            np.minimum.at(out, self.body[self.solids.who], self.solids.radius)
        return out

    def with_any(self, some: np.ndarray) -> np.ndarray:
        """Return a mask of the bodies whose constraints have any particle in the mask `some`, (n,)."""
        out = np.zeros(self.count, dtype=bool)
        for b, of in zip(self.batches, self.of, strict=True):
            out[of[b.owner[some[b.indices.ravel()]]]] = True
        return out

    def longest(self, way: np.ndarray) -> np.ndarray:
        """Return the length of the longest vector, (n, dim), of the particles of each body, (bodies,)."""
        out = np.zeros(self.count)
        np.maximum.at(out, self.body, np.linalg.norm(way, axis=1))
        return out

    def bulged(self, x: np.ndarray) -> np.ndarray:
        """Return positions at which bodies with links too long for where they end bulge like arcs, from x, (n, dim).

        An arc is longer than its chord by the share `strain` if it is sqrt(3 / 8 strain) of it high. Straight and flat bodies
        bulge, across all directions in which they extend, and downwards if possible.
        """
        strain, out, dim = np.zeros((2, self.count)), x.copy(), x.shape[1]  # sums over links, and their numbers
        for b, of in zip(self.batches, self.of, strict=True):
            if isinstance(b, Scalar) and b.arity == 2:
                C = b.violation(x) * self.close[b] * _holds(b) * ~b.broken
                strain += [np.bincount(of, np.maximum(-C, 0), self.count), np.bincount(of, minlength=self.count)]
        strain = strain[0] / np.maximum(strain[1], 1)
        for k in np.flatnonzero(strain > SEEN):
            who = np.unique(
                np.concatenate([b.indices.ravel()[(of == k)[b.owner]] for b, of in zip(self.batches, self.of, strict=True)])
            )
            r = between(x[who], x[who[0]], self.scene.periodic)
            r = r - (r.max(axis=0) + r.min(axis=0)) / 2
            _, axes = np.linalg.eigh(r.T @ r)
            half = np.abs(r @ axes).max(axis=0)
            wide = half > THIN * half.max()
            across = np.eye(dim)[[1, 0, *range(2, dim)]] * np.where(np.arange(dim) == 0, -1.0, 1.0)[:, None]
            across = across - across @ axes[:, wide] @ axes[:, wide].T
            size = np.linalg.norm(across, axis=1)
            if size.max() > THIN:
                first = int(np.argmax(size > THIN))
                shape = np.prod(1 - (r @ axes[:, wide] / half[wide]) ** 2, axis=1) * half.max() * (self.scene.inv_mass[who] > 0)
                out[who] += 2 * np.sqrt(3 / 8 * min(strain[k], 1.0)) * shape[:, None] * across[first] / size[first]
        return out

    def far(self, x: np.ndarray, borne: float = 1.0, met: float = MET) -> np.ndarray:
        """Return how far each body is from its rest at x, (n, dim): (3, bodies).

        These are the largest violation, as a share of the size of a constraint, the sum of squares, and that of user's functions.
        Violations count beyond `met` and rounding. borne: the part of what bears a load in the last
        substep that does not count.
        """
        out = np.zeros((3, self.count))
        for b, of in zip(self.batches, self.of, strict=True):
            if _is_rigid(b):
                share = self._share(b, x, borne, met)
                np.maximum.at(out[0], of, share)
                out[1 : 2 + b.quantity.foreign] += np.bincount(of, share**2, self.count)
            elif isinstance(b, Path) and not b.is_kinematic:
                share = np.linalg.norm(b.offset(x), axis=1) / b.length * (b.compliance == 0)
                np.maximum.at(out[0], of, np.where(share > SEEN, share, 0.0))
        if self.solids.count:
            who, share = self.solids.who, self.solids.far(x)
            size = np.abs(x[who]).max(axis=1)
            rounding = self.rounding * np.divide(size, self.solids.radius, out=0 * size, where=self.solids.radius > 0)
            share = np.where(share > (self.solids.borne if borne else met + rounding), share, 0.0)
            np.maximum.at(out[0], self.body[who], share)
            out[1] += np.bincount(self.body[who], share**2, self.count)
        return out

    def _share(self, b: Scalar, x: np.ndarray, borne: float, met: float) -> np.ndarray:
        """Return the same for the constraints of a batch, (m,)."""
        C, close = b.violation(x), self.close[b]
        acts = _holds(b) & ~b.broken & ~b.immovable(self.scene.inv_mass) & (C * b.side >= 0)
        C = np.where(acts, C, 0.0)
        if borne and (C != 0).any():
            C = C - borne * _borne(self.scene, b, x, C)
        share = np.abs(C) * close
        if not (share > met).any():
            return 0 * share
        squares = (b.gradients(x).reshape(-1, x.shape[1]) ** 2).sum(axis=1)
        far = np.bincount(b.owner, squares * (x[b.indices.ravel()] ** 2).max(axis=1), minlength=b.count)
        return np.where(share > met + self.rounding * np.sqrt(far) * close, share, 0.0)

    def energy(self, x: np.ndarray, h: float) -> float:
        """Return what rigid constraints violated at x, (n, dim), become if one substep h [s] removes them by themselves [J].

        Clusters count, and what a system solves exactly: others stay as soft as they are.
        """
        split, out = self.scene.memory.read(self.scene.slots.split)[: len(x)].astype(np.float64), 0.0
        for b in self.batches:
            if _is_rigid(b):
                C, W = b.violation(x), b.weights(x, split)
                some = _holds(b) & ~b.broken & (C * b.side >= 0) & (W > 0) & (self.scene.slots.sag(b) == 0)
                out += float((C[some] ** 2 / W[some]).sum())
        if self.solids.count:
            out += float((self.solids.m * self.solids.free * (self.solids.far(x) * self.solids.radius) ** 2).sum())
        return out / (2 * h * h)

    def forget_loads(self, some: np.ndarray) -> None:
        """Forget the loads of rigid constraints of the bodies in the mask `some`, which bear none at their new places yet."""
        for b, of in zip(self.batches, self.of, strict=True):
            if _is_rigid(b) and (here := some[of]).any():
                _forget(b, here)


def _borne(scene: Scene, b: Scalar, x: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return the part -W lam of the violations C, (m,), by which passes bear the load of the last substep."""
    slots = scene.slots
    W, lam = b.weights(x, scene.memory.read(slots.split)[: len(x)].astype(np.float64)), b.multipliers
    held = -np.sign(lam) * np.minimum(W * np.abs(lam), np.abs(C))
    if slots.system:  # systems bear loads without violations, but where they give way or are not solved exactly
        soft = (slots.system.gives_way(b) | (slots.sag(b) > 0)) & (lam != 0)
        held = np.where(slots.rows(b) < 0, held, np.where(soft, C, 0.0))
    return np.clip(held, np.minimum(C, 0), np.maximum(C, 0))


def forget(scene: Scene, batches: list[Batch], x: np.ndarray) -> None:
    """Reset the loads of constraints whose violation changes, before particles are put to x, (n, dim) [m]."""
    for b in _rigid(batches):
        if scene.memory.read(b.dev.equation.lam).any():
            old = scene.state.get(scene.memory)
            _forget(b, np.abs(b.violation(x) - b.violation(old)) * b.inverse_size(b.start.position) > SEEN)


def _forget(b: Scalar, some: np.ndarray) -> None:
    """Forget the loads of the constraints in the mask `some`, (m,)."""
    lam = b.scene.memory.read(b.dev.equation.lam)
    lam[: b.count][some] = 0.0
    b.scene.memory.write(b.dev.equation.lam, lam)


def left(batches: list[Batch], x: np.ndarray) -> list[tuple[Batch, np.ndarray]]:
    """Return the violations of rigid two-sided constraints at x, (n, dim), by batch: shares of their sizes, (m,), 0 up to SEEN.

    Constraints that are violated after settling contradict each other.
    """
    some = [b for b in _rigid(batches) if b.side == 0]
    off = [(b, np.abs(b.violation(x) * b.inverse_size(x) * _holds(b) * ~b.broken)) for b in some]
    return [(b, np.where(share > SEEN, share, 0.0)) for b, share in off]


def first_off(features: list[Feature], x: np.ndarray) -> int | None:
    """Return the first particle of rigid constraints that are violated by more than SEEN at x, (n, dim); None without any."""
    rigid = _rigid([f for f in features if isinstance(f, Batch)])
    return min((i for b in rigid for i in _off_corners(b, x, _holds(b))), default=None)


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
    return [b for b in batches if b.count and _is_rigid(b)]


def _is_rigid(b: Batch) -> TypeGuard[Scalar]:
    """Whether a batch is one of numbers, some of which are rigid."""
    return isinstance(b, Scalar) and bool(_holds(b).any())


def _holds(b: Scalar) -> np.ndarray:
    """Return which constraints hold rigidly, (m,): neither springs, nor drives that give way beyond a largest load."""
    out = b.compliance == 0
    return out & np.isinf(b.course()[2]) if b.driven else out


def tied(scene: Scene, batches: list[Batch], placed: int) -> np.ndarray:
    """Return a mask of the particles whose body has any placed particle, (n,). placed: the first placed particle."""
    some = [b for b in batches if isinstance(b, Scalar) and b.count]
    body = bodies_of(some, scene.inv_mass)[1]
    going = np.bincount(body[placed:], minlength=1 + sum(b.count for b in some)) > 0
    return (going[body] & (scene.inv_mass > 0)) | (np.arange(len(body)) >= placed)
