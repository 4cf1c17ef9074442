"""What all contact features have in common: their settings, and what a step asks of them."""

import warnings
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from .. import checks
from ..device import ti
from ..device.thread_team import Team
from ..features.feature import Batch, Feature, Knob, Scene
from ..features.material import Table
from ..neighbours.cell_list import FARTHEST
from ..neighbours.neighbour_list import MOVED
from ..neighbours.neighbour_search import NeighbourSearch
from ..neighbours.queries import Contacts
from ..particles import Particles
from .candidates import Candidates


class Geometry(Protocol):
    """What can touch, for one world: who takes part in a contact, how deep it is, in which direction, and how much each moves.

    DiscGeometry and PolygonGeometry also tell their feature the overlap, the normal and the inverse masses of each contact, and
    the neighbour list how far from each other two particles may take part in one.
    """

    shrinks: bool  # whether particles may be smaller than they are, or are allowed to overlap
    store: Any  # the Memory of a field that is made when it is needed, or None
    late: tuple[str, ...]  # the name of such a field in the state

    def overshoots(self, i) -> Any:
        """1 if particle i moves so far in one substep that a contact may be missed."""

    def enable_shrink(self) -> None:
        """From now on overlap may be allowed for a while."""

    def shrink(self, i, first) -> None:
        """Allow the overlap that particle i has with particles from number `first` on."""

    def restore(self, i, h) -> None:
        """Allow less overlap, at push_out."""

    def is_eased(self, i) -> Any:
        """Whether particle i is allowed to overlap."""

    def worst_overlap(self, i) -> Any:
        """For the report: contacts that particle i counts, and the worst overlap, relative to its size."""

    def candidates(self, x: np.ndarray) -> Candidates:
        """What may touch around positions x (n, dim) [m], which were diagnosed, for the host to move apart."""
        ...

    def found(self, x: np.ndarray, h: float) -> Contacts:
        """The contacts of particles at x (n, dim) [m] after a substep h [s], for world.contacts."""
        ...


class PairContact(Feature):
    """Particles that do not overlap. A world has at most one.

    bodies: of particles, that sleep and wake as one.

    A subclass gives prepare() and join(), which makes `dev.geometry` and `dev.forces`, and for a pass of a substep, in this
    order: detect(i, first), where it `detects`; count(begin, end) and busy(begin), by blocks of particles; relax(i, now);
    choose(i) and apply(i) of its `dev.restitution`, in rounds while `dev.hit` is set, where any pair has restitution;
    apply_corrections(i, first); and at the end of a substep finish_substep(i, now). For what sleeps: presses(i, e), whether there
    is a contact at entry e of the list of particle i, with held_by(j) of the other one; and reached(i, e, margin), whom of those
    that sleep particle i, which is awake, touches there, or nearly, -1 for none.
    """

    friction = Knob(lambda f, v: f._surface("friction", v), "Of all pairs, or by pairs of groups.")
    restitution = Knob(lambda f, v: f._surface("restitution", v), "Of all pairs, or by pairs of groups.")
    skin = Knob(lambda f, v: _skin(v), "How far beyond touching pairs are listed [m].", built=True)
    push_out = Knob(lambda f, v: checks.number("Contact", "push_out", v, least=0.0), "[m/s].", built=True)
    compiled_for = ("has_friction", "has_restitution", "turns", "uniform")
    _finest = _listed = 0.0  # the smallest radius, and how far beyond touching pairs are listed now [m]
    table: Table  # bound to one world
    bodies: Sequence[np.ndarray] = ()
    matters = True
    bulk = 3.0
    room = 0  # entries of the list for each particle, at first, if that is more than discs have
    detects = False  # looks for all contacts once in each pass, before they are counted
    projects = False  # knows which pairs bear a load, see velocity_projection.py

    def _surface(self, name: str, value):
        """Check a setting of pairs together with the others that are given."""
        if name in ("groups", "sensors") and value is not None:
            value = checks.rows("Contact", name, value, "a list of pairs of groups, such as [(0, 1)],")
        elif isinstance(value, list):
            value = tuple(value)
        given = {"friction": 0.0, "restitution": 0.0, "groups": None, "sensors": ()} | vars(self) | {name: value}
        Table("Contact", given["friction"], given["restitution"], given["groups"], given["sensors"])
        return value

    @property
    def wanted(self) -> Table:
        """The table that the settings ask for."""
        return Table("Contact", *self._given)

    @property
    def _given(self) -> tuple:
        """The settings of pairs."""
        return self.friction, self.restitution, vars(self).get("groups"), vars(self).get("sensors", ())

    @property
    def _pairs(self) -> Table:
        """The same table, made once for each assignment and bound to no world: it is asked many questions."""
        given = self._given
        asked, table = vars(self).get("_asked", ((), None))
        if table is None or any(one is not other for one, other in zip(given, asked, strict=True)):
            table = self.wanted
            self._asked = given, table
        return table

    @property
    def uniform(self) -> bool:
        """Whether all pairs are alike."""
        return self._pairs.uniform

    @property
    def has_friction(self) -> bool:
        """Whether any pair has friction, or had when kernels were compiled."""
        return self._pairs.has_friction or "has_friction" in self.once

    @property
    def has_restitution(self) -> bool:
        """Whether any pair has restitution, or had when kernels were compiled."""
        return self._pairs.has_restitution or "has_restitution" in self.once

    @property
    def takes_along(self) -> bool:
        """Whether particles that bounce off each other take along what they are linked to, see BodyImpacts."""
        return False

    @property
    def turns(self) -> bool:
        """Whether any pair resists rolling, or bounces across the normal, or did when kernels were compiled."""
        return self._pairs.turns or "turns" in self.once

    @property
    def has_events(self) -> bool:
        """Whether World.events() tells of anything."""
        return bool(vars(self).get("events") or vars(self).get("sensors"))

    @property
    def has_loads(self) -> bool:
        """Whether pairs know what they bear."""
        return bool(vars(self).get("loads"))

    @property
    def known(self) -> Any:
        """The KnownLoads of its pairs, in the kernels as they are, or None."""
        return vars(self.dev).get("known")

    @property
    def shrinks(self) -> bool:
        """Whether particles can be smaller than they are, in the kernels as they are."""
        return self.dev.geometry.shrinks

    @property
    def store(self) -> Any:
        """The Memory of what was made when it was needed, or None."""
        return self.dev.geometry.store if "geometry" in vars(self.dev) else None

    @property
    def late(self) -> tuple[str, ...]:
        """The names of fields of the state that enable_shrink() makes, and that are 0 before."""
        return self.dev.geometry.late

    def join(self, scene: Scene, batches: list[Batch], team: Team) -> NeighbourSearch:
        """Declare the fields, among them the neighbour list's, which is returned."""
        raise NotImplementedError

    def enter(self, scene: Scene) -> None:
        """Take the scene, and note what kernels are to have; before fields are declared."""
        dev = self.dev
        self.scene, dev.state, dev.w = scene, scene.state, scene.state.w
        dev.has_friction, dev.has_restitution, dev.turns = self.has_friction, self.has_restitution, self.turns
        self.table.make_room(dev.has_friction, dev.has_restitution, dev.turns)
        # `reports`: pairs that push each other are noted, not only what sensors overlap. `events`: an EventLog, or None.
        dev.has_events, dev.reports, dev.events = self.has_events, bool(vars(self).get("events")), None

    def built_for(self) -> dict[str, Any]:
        """The same, and the groups that are told apart; those that no longer need be go on being."""
        named = self._pairs.named
        told = self.table.named if self.scene and self.matters else frozenset()
        return super().built_for() | {"named": told if named <= told else named}

    def upload(self) -> None:
        """Write friction and restitution."""
        if self.scene:
            self.table.upload(self.scene, self.wanted)

    def review(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Warn of particles that cannot touch."""
        if not self.matters and particles.count:
            warnings.warn(f"{self!r}: all radii are 0, so nothing touches; give tv.Particles a radius.", stacklevel=3)

    def check_added(self, particles: Particles, first: int) -> None:
        """Refuse positions too far out."""
        if self.matters:
            self.check_range(particles.position)

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Its fields are those of the particles."""
        return (number >= 0,)

    def check_range(self, position: np.ndarray) -> None:
        """Raise where coordinates are too large for the cells."""
        cell = 2 * self._finest + self._listed
        far = np.abs(position) >= FARTHEST * cell
        if far.any():
            i, k = np.unravel_index(int(np.argmax(far)), far.shape)
            raise ValueError(
                f"Contact: position[{i}, {k}] = {position[i, k]:g} m is {abs(position[i, k]) / cell:.2g} cells of {cell:g} m "
                f"from the origin, but f32 tells only {FARTHEST} apart. Shift the scene towards the origin."
            )

    def enable_shrink(self) -> None:
        """From now on particles may be smaller than they are."""
        self.dev.geometry.enable_shrink()

    def found(self, x: np.ndarray, h: float) -> Contacts:
        """The contacts of particles at x (n, dim) [m] after a substep h [s], for world.contacts."""
        return self.dev.geometry.found(x, h)

    @ti.func
    def overshoots(self, i):
        """1 if particle i moves so far in one substep that a contact may be missed."""
        return self.dev.geometry.overshoots(i)

    @ti.func
    def note_motion(self, stale, fast):
        """Write down what was noticed; threads that all write to the same place would wait for each other."""
        if stale != 0:
            if self.dev.list.stale[None] == 0:
                self.dev.list.stale[None] = MOVED
        if fast != 0:
            if self.dev.fast[None] == 0:
                self.dev.fast[None] = 1

    @ti.func
    def shrink(self, i, first):
        """Allow the overlap that particle i has with particles from number `first` on."""
        self.dev.geometry.shrink(i, first)

    @ti.func
    def restore(self, i, h):
        """Allow less overlap, after a substep."""
        self.dev.geometry.restore(i, h)

    @ti.func
    def worst_overlap(self, i):
        """For the report: contacts that particle i counts, and the worst overlap, relative to its size."""
        return self.dev.geometry.worst_overlap(i)

    @ti.func
    def start_last_substep(self, i, scale):
        """At the start of the last substep of a frame: keep what shows later which pushes are forces."""
        self.dev.forces.start(i, scale)

    @ti.func
    def reaction(self, i, h):
        """What forces of contacts moved particle i by in the last substep of a frame, h [s] long [m]; asked with a list."""
        return self.dev.forces.sum[i]

    @ti.func
    def busy(self, begin):
        """0 if there is nothing to do for particles that were counted together, from `begin` on."""
        return 1


def _skin(value):
    return value if isinstance(value, str) and value == "auto" else checks.number("Contact", "skin", value, above=0.0)
