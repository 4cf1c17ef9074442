"""The results of World.events() and World.wall_events(): the contacts that began, ended and lasted in a frame."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from .. import checks
from ..features.row_table import row_table
from ..features.unknown_names import answer_names

BEFORE, NEVER = 0, -1  # in place of substeps, counted from 1: touched when the frame began; has not touched yet


@answer_names
@dataclass(frozen=True)
class Touches:
    """Pairs that touched in a frame, each once, in the order of their indices.

    pairs: (m, 2), i < j; -1 for what was removed since the frame before. groups: (m, 2), of these particles.
    normal: (m, dim), from j to i. point: (m, dim) [m], in the middle between the two surfaces. Both are those of the time when
    the pair met. For a pair that touched before the frame they are those of the last touch, or of the end of the frame once it
    has parted.
    impulse: (m,) [N s] along the normal, without friction, summed over all substeps of the frame (World.contacts has that of the
    last substep only). i got impulse * normal, and j the opposite. It is 0 for sensors and sleeping particles. The impulse of a
    substep acts from the middle of the substep before to its own middle. So a frame of substeps h after substeps h_old has
    (h_old - h) / 2 of a steady force more, and sums over frames miss no more than half a substep. Walls give the impulse of a
    whole frame, m g dt for what rests, in the first frame and after velocities were given, too; contacts of particles give half a
    substep less there.
    speed: (m,) [m/s], the highest speed of approach at which the pair met in this frame, before the impact; 0 if it did not meet.
    began: (m,) [s], when the pair first met in this frame; NaN if it touched before. ended: (m,) [s], when it was apart again;
    NaN if it still touches. Times are those of the ends of substeps.

    For walls, a pair is a particle and the number of the wall in world.features, of group -1. Normals point from the wall to the
    particle, in corners and hollows along the sum of the impulses from all sides. Normal and point of a particle that left a
    wall as the frame began are not known: they are 0.
    """

    pairs: np.ndarray
    groups: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    impulse: np.ndarray
    speed: np.ndarray
    began: np.ndarray
    ended: np.ndarray

    def __len__(self) -> int:
        return len(self.pairs)

    def __repr__(self) -> str:
        return row_table("Touches", {name: vars(self)[name] for name in ("pairs", "impulse", "speed", "began", "ended", "point")})

    def __getitem__(self, rows: Any) -> "Touches":
        """Return some rows, by a mask, indices or a slice."""
        return Touches(*(getattr(self, f.name)[rows] for f in fields(self)))


@answer_names
@dataclass(frozen=True)
class ContactEvents:
    """The contacts of the last frame.

    A pair is in `begun` if it did not touch in the last substep before the frame. It is in `ended` if it does not touch in the
    last substep of the frame; a ball that bounces within a frame is in both. A pair is in `lasting` if it touched before and
    after, whatever happened in between; a speed above 0 says that it met again. So (touching | begun) - ended is the set of pairs
    that touch now. Each pair is in `touches` once, so that sums count nothing twice.

    A pair touches in a substep if it overlaps before contacts push it apart; a pair at rest under a load does. A pair that falls
    asleep while it touches, see Sleep, stays in `lasting` while it sleeps, with an impulse of 0. A pair that touches when one
    of it is removed is in `ended` of the next frame, with its last point and normal, and an impulse of 0. So each begun pair
    ends.
    """

    touches: Touches

    @property
    def begun(self) -> Touches:
        """Pairs that did not touch before the frame."""
        return self.touches[~np.isnan(self.touches.began)]

    @property
    def ended(self) -> Touches:
        """Pairs that do not touch at the end of the frame."""
        return self.touches[~np.isnan(self.touches.ended)]

    @property
    def lasting(self) -> Touches:
        """Pairs that touched before the frame and at its end."""
        return self.touches[np.isnan(self.touches.began) & np.isnan(self.touches.ended)]

    def __len__(self) -> int:
        return len(self.touches)

    def __repr__(self) -> str:
        counts = (f"{len(getattr(self, name))} {name}" for name in ("begun", "ended", "lasting"))
        return f"ContactEvents: {', '.join(counts)}\n{self.touches!r}"

    def among(self, groups: Iterable | None) -> "ContactEvents":
        """Return the contacts between some pairs of groups, None for all."""
        if groups is None:
            return self
        wanted = checks.rows("World.events", "groups", groups, "a list of pairs of groups, such as [(0, 1)],")
        some, (a, b) = np.zeros(len(self), dtype=bool), self.touches.groups.T
        for pair in wanted:
            one, other = checks.group_pair("World.events", "groups", pair)
            some |= ((a == one) & (b == other)) | ((a == other) & (b == one))
        return ContactEvents(self.touches[some])

    def renumbered(self, first: np.ndarray, second: np.ndarray) -> "ContactEvents":
        """Return the events with new indices.

        first, second: the new indices, by the old ones, of the first and second member of each pair, -1 for removed ones. They
        keep their order.
        """
        old = self.touches.pairs
        new = np.stack([first[old[:, 0]], second[old[:, 1]]], axis=1)
        return ContactEvents(replace(self.touches, pairs=np.where(old >= 0, new, -1)))

    def without_removed(self, first: np.ndarray, second: np.ndarray, time: float) -> tuple["ContactEvents", "ContactEvents"]:
        """Return the same without pairs of which one is removed, and the events of the next frame in which these end.

        time: the present one [s].
        """
        new = self.renumbered(first, second).touches
        gone = ((new.pairs < 0) & (self.touches.pairs >= 0)).any(axis=1)
        lost = new[gone & np.isnan(new.ended)]
        zero = np.zeros(len(lost))
        return ContactEvents(new[~gone]), ContactEvents(
            replace(lost, impulse=zero, speed=zero, began=zero * np.nan, ended=zero + time)
        )


Told = tuple[ContactEvents, ContactEvents]  # of particles, and of walls


def no_events(dim: int) -> ContactEvents:
    """Return the events of a frame without contacts."""
    pairs, vectors, numbers = np.zeros((0, 2), dtype=np.int64), np.zeros((0, dim)), np.zeros(0)
    return ContactEvents(Touches(pairs, pairs, vectors, vectors, numbers, numbers, numbers, numbers))


def joined_events(told: Told, more: Told | None) -> Told:
    """Join more events with those told: of particles, and of walls."""
    if more is None:
        return told
    return ContactEvents(joined([more[0].touches, told[0].touches])), ContactEvents(joined([more[1].touches, told[1].touches]))


def joined(parts: list[Touches]) -> Touches:
    """Join several Touches, in the order of their pairs."""
    out = Touches(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Touches)))
    return out[np.lexsort(out.pairs.T[::-1])]


def span(when: np.ndarray, substeps: int, h: float, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the times when contacts began and ended, as in Touches.

    when: (m, 2), the substeps of the frame, from 1 to `substeps`, in which they began to touch (or BEFORE) and touched last. h:
    length of a substep [s]. time: the end of the frame [s].
    """
    began = np.where(when[:, 0] == BEFORE, np.nan, time - (substeps - when[:, 0]) * h)
    return began, np.where(when[:, 1] == substeps, np.nan, time - (substeps - 1 - when[:, 1]) * h)
