"""Contacts of bodies made of loops of particles (2D)."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..device.thread_team import Team
from ..features.feature import Batch, Feature, Knob, Scene, extended
from ..features.regrouping import Regrouping
from ..geometry.ordered import typical
from ..neighbours.neighbour_search import NeighbourSearch
from ..particles import Particles
from .edges import Edges, Outline
from .limits import AHEAD
from .loops import checked, flat, laid, refuse_deep
from .pair_contact import PairContact

SKIN = 0.15  # skin of a vertex, relative to its longer edge


class Polygons(PairContact):
    """Contacts of bodies made of particle loops, and of other particles: vertex against edge, disc against disc (2D).

    C(x) = (x_v - (1 - t) x_a - t x_b) . n - (r_v + (1 - t) r_a + t r_b) >= 0 for a vertex v and the edge from a to b of another
    body. t is the place of v along the edge, n the outward normal. See tiverlet/contact/README.md.

    loops: for each body its particles in order around it, at least 3, either way round. Their radii round the rim. Other
    constraints (Distance, Area, ShapeMatch) hold a body together; it may bend, and stretch by a quarter.
    friction, restitution: as in Contact. Particles in no loop touch as in Contact. There are no impacts in turn.
    skin: how far beyond contact distance pairs are listed [m], "auto" for the median of 0.15 of the longer edge of each vertex,
    and of 0.75 of the radius of each disc in no loop. It affects speed only.
    push_out: largest speed [m/s] at which what overlaps parts; None, the default, for a quarter of a size in a substep.
    loads: has no effect any more: all pairs store the load that they bear.

    Corners that face each other touch as discs, by their radii. A vertex inside of another body leaves through the nearest edge
    that faces its own body, if it is not deeper than half the length of that edge. Particles that start deeper are refused. What
    gets deeper than the middle of a thin body may come out behind it, and has the flag "tunnelling-risk".

    Two sharp corners that have passed each other part over the nearer edge. Other bodies that cross without a corner of one
    inside of the other, such as two bars, are not detected. Walls act on particles: a sharp corner of a wall passes between two.
    """

    host_only = ("loops",)

    _after: Any = None  # the copy with the bodies after a planned edit, see can_regroup()
    neighbours_per_particle = 64  # the particles of near bodies

    def __init__(
        self, loops: Iterable, friction: ArrayLike | Mapping = 0.0, restitution: ArrayLike | Mapping = 0.0, *, skin: float | str =
        "auto", push_out: float | None = None, loads: bool = False,
    ):  # fmt: skip
        self.restitution, self.friction, self.skin, self.push_out, self.loads = restitution, friction, skin, push_out, loads
        self.loops = checked(loops)

    loads = Knob(lambda f, v: checks.flag("Polygons", "loads", v), "Has no effect any more.")

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Turn all loops counterclockwise and measure them. Refuse flat loops, and positions too far out."""
        if particles.dim != 2:
            raise ValueError("Polygons: bodies of particle loops are for 2D worlds; these particles are in 3D.")
        if particles.spins:
            raise ValueError("Polygons: it does not turn particles that spin. Leave out spin, or use tv.Contact for discs alone.")
        x = particles.position
        self.dev.outline = Outline(*laid(self.loops, x))
        sizes = np.where(self.dev.outline.body >= 0, SKIN * self.dev.outline.length, 0.75 * particles.radius)
        self._present_skin = (typical(sizes) or 1.0) if self.skin == "auto" else float(self.skin)
        self._ahead = AHEAD * typical(self.dev.outline.size(particles.radius))
        self._smallest_radius = float((particles.radius + self.dev.outline.reach / 2).min(initial=np.inf))
        can_touch = particles.count > 0 and bool(self.loops or (particles.radius > 0).any())
        self._keep(can_touch=can_touch, table=self.wanted)
        if self.can_touch:
            self.check_range(x)

    def review(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Warn as PairContact.review() does, and of bodies that nothing holds. Refuse particles that start deep inside bodies."""
        super().review(particles, inv_mass)
        refuse_deep(self.loops, particles.position, 0, self._left_out)
        loose = self._loose(inv_mass)
        if len(loose):
            k = int(loose[0])
            checks.warn(
                f"{self!r}: no constraint holds loops[{k}] ({len(loose)} such in all), so its corners move one by one. Add "
                f"tv.ShapeMatch(loops), or links."
            )  # fmt: skip

    def _left_out(self, i: int, loop: np.ndarray) -> bool:
        """Whether constraints tie particle i to all corners of a loop, so that it touches none of them."""
        tied = [np.zeros(0, dtype=np.int32)]
        for b in self.ties:
            who = b.indices.ravel()
            tied.append(who[np.isin(b.owner, b.owner[who == i])])
        return bool(np.isin(loop, np.concatenate(tied)).all())

    def _loose(self, inv_mass: np.ndarray) -> np.ndarray:
        """Return the loops with a particle that moves, of which no constraint has two particles."""
        body, count = self.dev.outline.body, len(self.loops)
        held = np.bincount(body[(body >= 0) & (inv_mass > 0)], minlength=count) == 0
        for b in self.ties:
            own = body[b.indices.ravel()]
            keys, times = np.unique((b.owner * (count + 1) + own)[own >= 0], return_counts=True)
            held[keys[times > 1] % (count + 1)] = True
        return np.flatnonzero(~held)

    def check_added(self, particles: Particles, first: int) -> None:
        """Refuse positions too far out, and added particles deep inside of bodies."""
        bodies = self._after or self
        PairContact.check_added(bodies, particles, first)
        refuse_deep(bodies.loops, particles.position, first)

    def release(self) -> None:
        """Unbind from the world, and drop a planned edit."""
        super().release()
        self._after = None

    @property
    def indices(self) -> np.ndarray:
        """The particles of all bodies, one after the other, (total,)."""
        return np.concatenate([*self.loops, np.zeros(0, dtype=np.int32)])

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Take new particle indices (-1 for removed ones). A body remains if all of its particles do."""
        if self.loops:
            corner, begin, owner = flat(self.loops)
            new, whole = number[corner].astype(np.int32), np.bincount(owner, number[corner] < 0) == 0
            self._hold([new[begin[k] : begin[k + 1]] for k in np.flatnonzero(whole).tolist()])

    def check_extension(self, more: Feature) -> None:
        """Raise unless `more` is a Polygons with the same settings."""
        if not isinstance(more, Polygons):
            raise TypeError(f"World.add: extend: {self!r} cannot take {more!r}, which is of another kind. Add it to features.")
        for name, value in more.arguments.items():
            if name != "loops" and repr(value) != repr(self.arguments.get(name)):
                raise ValueError(f"World.add: extend: {more!r} has a {name} of its own, but all bodies have that of {self!r}.")

    def extend(self, more: "Polygons") -> None:
        """Append the bodies of `more`."""
        both = [*self.loops, *more.loops]
        self._hold(checked(both) if np.isin(more.indices, self.indices).any() else both)

    def _hold(self, loops: list[np.ndarray]) -> None:
        """Store these bodies, in the arguments too."""
        self._keep(loops=loops)
        self.arguments = {**self.arguments, "loops": loops}

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether particles and bodies can come and go in place. If so, plan the edit for regroup().

        Not in a world with Sleep, or if the groups or the neighbour search would differ.
        """
        if not self.can_touch or self.scene.state.sleepers:
            return False
        came, now = change.now.position[change.kept :], change.now
        after: Any = self.copy()
        start = now.placed(change.regrouped_rows(self.start.position, came))
        after.remap_indices(change.number, now.count)
        if self in change.extensions:
            start = extended(after, change.extensions[self], start, now, self.periodic)
        after.start = start
        after.prepare(start, change.inv_mass.copy())
        self._after = after
        reach = after.dev.outline.reach
        return after.can_touch and self.dev.search.can_regroup(change, now.radius, reach)

    def regroup(self, change: Regrouping) -> None:
        """Carry out the planned edit. The thread team already has the new number of particles."""
        dev, after = self.dev, self._after
        self.start, self._present_skin, self._smallest_radius, self._ahead, self._after = (
            after.start, after._present_skin, after._smallest_radius, after._ahead, None,
        )  # fmt: skip
        self._hold(after.loops)
        dev.outline = after.dev.outline
        dev.geometry.set_outline(dev.outline, change.now.radius)
        dev.edge_pair_table.skin = self._present_skin + self._ahead
        self.table.regroup(self.scene, change.now.group)
        dev.search.regroup(change, self._present_skin, change.now.radius, dev.outline.reach, self._ahead)
        dev.impulses.regroup(change.now.count)
        dev.rows.ahead = self._ahead

    def rods(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the edges (k, 2) of all bodies, and their numbers (k,), counted from body to body. Rays meet them."""
        edges = [np.stack([loop, np.roll(loop, -1)], axis=1) for loop in self.loops]
        ends = np.concatenate([np.zeros((0, 2), dtype=np.int64), *edges])
        return ends, np.arange(len(ends))

    def make_search(self, scene: Scene, batches: list[Batch], team: Team) -> NeighbourSearch:
        """Declare the fields and the neighbour search, and return the search."""
        return self.declare_rows(scene, batches, team, edges=Edges(scene, self.dev.outline))

    @property
    def bodies(self) -> list[np.ndarray]:  # type: ignore[override]
        """The particles of each body, which sleep and wake together."""
        return self.loops

    @ti.func
    def touched_sleeper(self, i, e, margin):
        """Return the sleeping particle at entry e of the list of i that i touches, or comes nearer to than `margin` [m]; else -1.

        A driven particle i also reaches a sleeping particle on which it pressed in the substep before.
        """
        j, out = self.dev.list.neighbour[e], -1
        other, before = self.dev.geometry.pressed_particle(j), self.dev.geometry.before(i)
        if not self.dev.state.awake(other):
            met = self.dev.geometry.touches(i, j, margin)
            if self.dev.w[i] == 0:
                met = met or self.dev.rows.is_set(self.dev.rows.memory.field[e])
            if met:
                out = other
        if out < 0 and before >= 0:
            if not self.dev.state.awake(j):
                if self.dev.geometry.touches(j, i, margin) or self.dev.geometry.touches(j, before, margin):
                    out = j
        return out
