"""Contacts of discs and spheres."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..device.thread_team import Team
from ..features.feature import Batch, Knob, Scene
from ..features.material import is_elastic, refuse_turning
from ..features.regrouping import Regrouping
from ..geometry.ordered import typical
from ..neighbours.neighbour_search import NeighbourSearch
from ..particles import Particles
from .answers import answer_at_once
from .limits import AHEAD
from .pair_contact import PairContact

CRADLE = 0.97  # coefficient of restitution above which a world lets impacts pass on one after the other
THROWN = 0.5  # of the median radius: how far impacts in turn may throw something in a substep and it still meets others


class Contact(PairContact):
    """Contacts of discs and spheres: no two of them overlap.

    C(x) = |x_i - x_j| - (r_i + r_j) >= 0 for all pairs, with Coulomb friction and restitution. See tiverlet/contact/README.md for
    the law. Above a restitution of 0.97 impacts pass on from particle to particle, as in Newton's cradle.

    friction: Coulomb friction, a number, (static, dynamic) or (static, dynamic, rolling, twisting), or a mapping from pairs of
    groups to these: {(0, 1): 0.5}. Friction turns particles that spin. rolling, twisting: against rolling, a moment of up to
    rolling * r times the normal force with r = r_i r_j / (r_i + r_j), and against spinning about the normal (Luding 2008).
    restitution: 0 to 1, (normal, tangential), or such a mapping. A bounce keeps the square of it of the energy along the normal,
    whatever the substep. tangential: points that touch leave across the normal at -tangential times their velocity, as far as
    friction holds it; 0 grips, 1 is a super ball (Walton 1993).
    groups: the pairs of groups that touch, None for all.
    skin: how far beyond contact distance pairs are listed [m], "auto" for 0.75 of the median radius. It affects speed only, never
    the result.
    push_out: largest speed [m/s] at which two particles part that overlap; None, the default, for a quarter of the smaller radius
    in a substep. In a cluster the rim moves as many times faster as there are pairs on the way to it.
    events: whether World.events() reports which pairs met and parted.
    sensors: pairs of groups that do not touch. World.events() reports which particles of the second group, the sensors, overlap
    particles of the first group. It costs least where sensors are few.
    loads: has no effect any more: all pairs store the load that they bear.

    Two particles in the same place part in a direction computed from their indices. Linked particles (Distance, Rope, Spacer) do
    not touch, nor do particles that a chain of links holds closer than the sum of their radii, see tiverlet/contact/README.md.
    """

    def __init__(
        self, friction: ArrayLike | Mapping = 0.0, restitution: ArrayLike | Mapping = 0.0, *, skin: float | str = "auto",
        groups=None, push_out: float | None = None, events: bool = False, sensors=(), loads: bool = False,
    ):  # fmt: skip
        self.groups, self.sensors, self.restitution, self.friction = groups, sensors, restitution, friction
        self.skin, self.push_out, self.events, self.loads = skin, push_out, events, loads

    events = Knob(lambda f, v: checks.flag("Contact", "events", v), "Whether World.events() tells of pairs.", compiled=True)
    loads = Knob(lambda f, v: checks.flag("Contact", "loads", v), "Has no effect any more.")
    sensors: Any = Knob(lambda f, v: f._surface("sensors", v), "The pairs of groups of which the second senses.", built=True)
    groups: Any = Knob(lambda f, v: f._surface("groups", v), "The pairs of groups that touch; None for all.", built=True)

    compiled_for = (*PairContact.compiled_for, "in_turn")

    @property
    def in_turn(self) -> bool:
        """Whether impacts pass on from particle to particle, see impacts.py."""
        bounces = [self.restitution, *(w.restitution for w in self.walls)]
        values = [e for v in bounces for e in (v.values() if isinstance(v, Mapping) else [v])]
        return any(float(np.ravel(e)[0]) > CRADLE for e in values)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Choose the skin, and refuse positions too far out for the cells."""
        if self.wanted.turns and not particles.spins:
            refuse_turning("Contact")
        self._measure(particles.radius)
        self._keep(can_touch=bool((particles.radius > 0).any()), table=self.wanted)
        if self.can_touch:
            self.check_range(particles.position)

    def _measure(self, radius: np.ndarray) -> None:
        """Store the skin [m] and the smallest radius [m] of particles with these radii (n,) [m]."""
        size = typical(radius)
        self._present_skin = (0.75 * size or 1.0) if self.skin == "auto" else float(self.skin)
        self._ahead = (THROWN if self.in_turn else AHEAD) * size
        self._smallest_radius = float(radius.min(initial=np.inf))

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether particles can come and go in place: not if the blocks or the neighbour search would differ."""
        some = bool((change.now.radius > 0).any())
        if not self.can_touch:
            return not some
        return some and self.dev.search.can_regroup(change, change.now.radius)

    def regroup(self, change: Regrouping) -> None:
        """Resize the fields after particles came and went. The thread team already has the new number."""
        if not self.can_touch:
            return
        dev = self.dev
        self._measure(change.now.radius)
        self.table.regroup(self.scene, change.now.group)
        dev.search.regroup(change, self._present_skin, change.now.radius, ahead=self._ahead)
        dev.impulses.regroup(change.now.count)
        dev.rows.ahead = self._ahead

    def make_search(self, scene: Scene, batches: list[Batch], team: Team) -> NeighbourSearch:
        """Declare the fields and the neighbour search, and return the search."""
        return self.declare_rows(scene, batches, team, in_turn=self.in_turn and answer_at_once(scene, batches))

    @property
    def conserves(self) -> bool:
        """Whether pairs leave each other with the energy that they had."""
        return is_elastic(self.friction, self.restitution)

    @ti.func
    def touched_sleeper(self, i, e, margin):
        """Return the particle at entry e of the list of i if it sleeps and i is within `margin` [m] of it, else -1.

        A driven particle i also reaches a sleeping particle that it touched as the substep began.
        """
        j, out = self.dev.list.neighbour[e], -1
        if not self.dev.state.awake(j):
            met = self.dev.geometry.touches(i, j, margin)
            if self.dev.w[i] == 0:
                r, distance = self.dev.state.separation(i, j) - self.dev.state.d[i], self.dev.geometry.contact_distance(i, j)
                met = met or r.dot(r) < distance * distance
            out = ti.select(met, j, -1)
        return out
