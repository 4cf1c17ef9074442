"""What World.events() and World.wall_events() return: which contacts began, ended and lasted in a frame."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from .. import checks

BEFORE, NEVER = 0, -1  # numbers of substeps, which count from 1: it touched when the frame began; not yet


@dataclass(frozen=True)
class Touches:
    """Pairs that touched in a frame, each once, in the order of their indices.

    pairs: (m, 2), i < j. normal: (m, dim), from j to i. point: (m, dim) [m], in the middle between the two surfaces. Both as the
    pair met; where it touched before the frame, as it touched last, or once it has parted as it is when the frame ends. impulse:
    (m,) [N s] along the normal, the sum over all substeps of the frame, where that of World.contacts is of the last one alone,
    without friction; i got impulse * normal, and j the opposite. 0 for sensors, and for what sleeps. A substep has what was given
    from the middle of the one before to its own, so that a frame whose substeps h follow others of h_old has (h_old - h) / 2 of a
    steady force more, and sums over frames miss no more than half a substep. speed: (m,) [m/s], the highest at which the pair
    came together where it met in this frame, before the impact; 0 where it did not meet. began: (m,) [s], when it first met in
    this frame; NaN where it touched before. ended: (m,) [s], when it was apart again; NaN where it still touches. Times are those
    of the ends of substeps.

    Of walls, pairs are a particle and the number of the wall in world.features, and normals point from the wall to the particle,
    in corners and in hollows along the sum of what the wall gave from all sides;
    of what left a wall as the frame began neither normal nor point are known, they are 0.
    """

    pairs: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    impulse: np.ndarray
    speed: np.ndarray
    began: np.ndarray
    ended: np.ndarray

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, rows: Any) -> "Touches":
        """Some rows, by a mask, indices or a slice."""
        return Touches(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True)
class ContactEvents:
    """What touched in the last frame.

    A pair is in `begun` if it did not touch in the last substep before the frame, and in `ended` if it does not in the last one
    of it; a ball that bounces within a frame is in both. It is in `lasting` if it touched before and after, whatever happened in
    between: a speed above 0 tells that it met again. So (touching | begun) - ended is what touches now. Each pair is in `touches`
    once, so that sums count nothing twice.

    A pair touches in a substep if it overlaps in it before it is pushed apart, and so does what is at rest under a load. What
    falls asleep touching, see Sleep, stays in `lasting` while it sleeps, with an impulse of 0.
    """

    touches: Touches

    @property
    def begun(self) -> Touches:
        """Contacts that did not touch before the frame."""
        return self.touches[~np.isnan(self.touches.began)]

    @property
    def ended(self) -> Touches:
        """Contacts that do not touch after it."""
        return self.touches[~np.isnan(self.touches.ended)]

    @property
    def lasting(self) -> Touches:
        """Contacts that touched before and after."""
        return self.touches[np.isnan(self.touches.began) & np.isnan(self.touches.ended)]

    def __len__(self) -> int:
        return len(self.touches)

    def among(self, group: np.ndarray, groups: Iterable | None) -> "ContactEvents":
        """Those between pairs of groups. group: (n,), of each particle; groups: None for all."""
        if groups is None:
            return self
        wanted = checks.rows("World.events", "groups", groups, "a list of pairs of groups, such as [(0, 1)],")
        some, (a, b) = np.zeros(len(self), dtype=bool), group[self.touches.pairs.T]
        for pair in wanted:
            one, other = checks.group_pair("World.events", "groups", pair)
            some |= ((a == one) & (b == other)) | ((a == other) & (b == one))
        return ContactEvents(self.touches[some])

    def renumbered(self, first: np.ndarray, second: np.ndarray) -> "ContactEvents":
        """With new numbers of those that come first and second in pairs, in the same order; without what goes, -1."""
        if not len(self):
            return self
        pairs = np.stack([first[self.touches.pairs[:, 0]], second[self.touches.pairs[:, 1]]], axis=1)
        return ContactEvents(replace(self.touches, pairs=pairs)[(pairs >= 0).all(axis=1)])


def no_events(dim: int) -> ContactEvents:
    """Events of a frame in which nothing touched."""
    pairs, vectors, numbers = np.zeros((0, 2), dtype=np.int64), np.zeros((0, dim)), np.zeros(0)
    return ContactEvents(Touches(pairs, vectors, vectors, numbers, numbers, numbers, numbers))


def joined(parts: list[Touches]) -> Touches:
    """All of these contacts, in the order of their pairs."""
    out = Touches(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Touches)))
    return out[np.lexsort(out.pairs.T[::-1])]


def span(when: np.ndarray, substeps: int, h: float, time: float) -> tuple[np.ndarray, np.ndarray]:
    """When contacts began and ended, as in Touches. when: (m, 2), the substeps of a frame, from 1 to `substeps`, in which they
    began to touch and touched last, or BEFORE; h: of a substep [s]; time: when the frame ended [s]."""
    began = np.where(when[:, 0] == BEFORE, np.nan, time - (substeps - when[:, 0]) * h)
    return began, np.where(when[:, 1] == substeps, np.nan, time - (substeps - 1 - when[:, 1]) * h)
