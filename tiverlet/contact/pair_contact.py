"""The contract of contact features: their common settings, and the methods that a step calls."""

from collections.abc import Sequence
from typing import Any

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
from .answers import Answers
from .edges import EdgePairTable, Edges
from .events import EventLog
from .exclusions import excluded_pairs
from .impulses import Impulses
from .islands import Islands
from .narrow_phase import DiscGeometry
from .places import Places
from .responses import Responses
from .rows import Rows


class PairContact(Feature):
    """A feature that keeps particles from overlapping. A world has at most one.

    bodies: arrays of particles that sleep and wake together. ties: the constraints of its world.

    A subclass defines prepare() and make_search(), which calls declare_rows(). Contacts are rows, see rows.py, and are solved by
    RowPass. `dev.geometry`, a DiscGeometry or Edges, defines what both kinds of contacts need.

    For sleep, touched_sleeper(i, e, margin) returns the sleeping particle at entry e that the awake particle i touches, or nearly
    touches, or -1.
    """

    friction = Knob(lambda f, v: f._surface("friction", v), "Of all pairs, or by pairs of groups.")
    restitution = Knob(lambda f, v: f._surface("restitution", v), "Of all pairs, or by pairs of groups.")
    skin = Knob(lambda f, v: _skin(v), "How far beyond touching pairs are listed [m].", built=True)
    push_out = Knob(
        lambda f, v: None if v is None else checks.number("Contact", "push_out", v, least=0.0), "[m/s], or None.", built=True
    )
    compiled_for = ("has_friction", "has_restitution", "turns", "uniform")
    # The smallest radius, the present skin, and the gap up to which pairs are rows [m].
    _smallest_radius = _present_skin = _ahead = 0.0
    table: Table  # bound to one world
    bodies: Sequence[np.ndarray] = ()
    host_only = ("ties", "walls", "_ahead", "_asked", "_present_skin", "_smallest_radius")
    kept_by_world = (*Feature.kept_by_world, "ties", "walls")
    ties: Sequence[Batch] = ()
    walls: Sequence[Any] = ()  # the colliders of its world
    can_touch = True
    code_size = 3.0
    neighbours_per_particle = 0  # initial list entries per particle, if more than discs need

    def _surface(self, name: str, value):
        """Check one setting of pairs together with the other settings."""
        given = {"friction": 0.0, "restitution": 0.0, "groups": None, "sensors": ()} | vars(self) | {name: value}
        table = Table("Contact", given["friction"], given["restitution"], given["groups"], given["sensors"])
        if name in ("groups", "sensors"):
            return table.touching if name == "groups" else table.sensing
        return tuple(value) if isinstance(value, (list, np.ndarray)) and np.ndim(value) else value

    @property
    def wanted(self) -> Table:
        """A new table of the present settings."""
        return Table("Contact", *self._given)

    @property
    def _given(self) -> tuple:
        """The settings of pairs."""
        return self.friction, self.restitution, vars(self).get("groups"), vars(self).get("sensors", ())

    @property
    def _pairs(self) -> Table:
        """The table of the present settings, bound to no world. It is cached until a setting changes: it is read often."""
        given = self._given
        asked, table = vars(self).get("_asked", ((), None))
        if table is None or any(one is not other for one, other in zip(given, asked, strict=True)):
            table = self.wanted
            self._asked = given, table
        return table

    @property
    def uniform(self) -> bool:
        """Whether all pairs have the same friction and restitution, and touch."""
        return self._pairs.uniform

    @property
    def has_friction(self) -> bool:
        """Whether any pair has friction, or had friction when kernels were compiled."""
        return self._pairs.has_friction or "has_friction" in self.compiled_so_far

    @property
    def has_restitution(self) -> bool:
        """Whether any pair has restitution, or had restitution when kernels were compiled."""
        return self._pairs.has_restitution or "has_restitution" in self.compiled_so_far

    @property
    def turns(self) -> bool:
        """Whether any pair has rolling, twisting or tangential restitution, now or when kernels were compiled."""
        return self._pairs.turns or "turns" in self.compiled_so_far

    @property
    def has_events(self) -> bool:
        """Whether World.events() reports contacts or sensors."""
        return bool(vars(self).get("events") or vars(self).get("sensors"))

    def make_search(self, scene: Scene, batches: list[Batch], team: Team) -> NeighbourSearch:
        """Declare the fields and the neighbour search, and return the search. enter() comes before."""
        raise NotImplementedError

    def declare_rows(
        self, scene: Scene, batches: list[Batch], team: Team, in_turn: bool = False, edges: Edges | None = None
    ) -> NeighbourSearch:
        """Declare the fields of rows and the neighbour search, and return the search. edges: of bodies, or None."""
        dev, face = self.dev, 0
        for group in scene.walls:
            face = group.number_faces(scene, face)
        friction = dev.has_friction or any(w.has_friction for w in self.walls)
        bounces = dev.has_restitution or any(w.has_restitution for w in self.walls)
        self.table.bind(scene, asked=friction or bounces or bool(edges))
        turns = scene.state.spins and friction and (dev.turns or any(w.turns for w in self.walls))
        walls, ahead, skin = scene.walls, self._ahead, self._present_skin
        dev.rows = Rows(scene, self.table, friction, bounces, in_turn, turns, walls, team, self.push_out, ahead, edges)
        dev.answers = Answers(scene, batches, dev.rows) if batches else None
        dev.fast = dev.rows.fast
        dev.responses = Responses(scene, dev.rows, scene.state.spins and friction, dev.answers)
        dev.islands = Islands(scene, dev.rows, dev.responses, team)
        dev.impulses = Impulses(scene, dev.rows, dev.responses, team)
        dev.places = Places(scene, dev.rows, dev.responses, dev.impulses)
        linked = excluded_pairs(batches, scene.particles.radius, edges.outline if edges else None)
        dev.events = EventLog(scene, self.table) if dev.has_events else None
        pair_data = [
            dev.rows.memory,
            *([dev.rows.slid] if friction else []),
            *([dev.rows.touched, dev.rows.given] if bounces else []),
            *([dev.rows.borne_moment] if turns else []),
            *([dev.events.touched] if dev.events else []),
            *(edges.pair_data if edges else []),
        ]
        pairs, reach = self.table, None
        if edges:
            dev.edge_pair_table = pairs = EdgePairTable(edges, self.table, scene.memory.number(skin + ahead, scene.real))
            reach = edges.outline.reach
        dev.search = NeighbourSearch(
            scene, skin, linked, pairs, pair_data, team, dev.responses.push, reach, walls=walls, ahead=ahead
        )
        dev.list = dev.search.list
        discs = DiscGeometry(scene, dev.search, dev.rows.memory, dev.rows.given if bounces else None)
        dev.geometry = edges or discs
        if dev.events:
            dev.events.bind(dev.list, discs)
            dev.rows.events = dev.events if dev.reports else None
        dev.rows.bind(dev.list, discs)
        return dev.search

    def enter(self, scene: Scene) -> None:
        """Store the scene, and fix what kernels contain. Called before fields are declared, and before the impacts of bodies."""
        dev = self.dev
        self.scene, dev.state, dev.w = scene, scene.state, scene.state.w
        dev.has_friction, dev.has_restitution, dev.turns = self.has_friction, self.has_restitution, self.turns
        self.table.set_columns(dev.has_friction, dev.has_restitution, dev.turns)
        # `reports`: whether pairs that push each other are recorded, not only sensors. `events`: an EventLog, or None.
        dev.rows = None
        dev.has_events, dev.reports, dev.events = self.has_events, bool(vars(self).get("events")), None

    def build_values(self) -> dict[str, Any]:
        """Return the settings for which the world was built, and the groups of the table.

        Groups that the settings do not name any more stay in the table, so dropping a name does not rebuild the world.
        """
        named = self._pairs.named
        told = self.table.named if self.scene and self.can_touch else frozenset()
        return super().build_values() | {"named": told if named <= told else named}

    def upload(self) -> None:
        """Write changed friction and restitution to the device."""
        if self.scene:
            self.table.upload(self.scene, self.wanted)

    def review(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Warn if all radii are 0, so that nothing touches."""
        if not self.can_touch and particles.count:
            checks.warn(f"{self!r}: all radii are 0, so nothing touches; give tv.Particles a radius.")

    def check_added(self, particles: Particles, first: int) -> None:
        """Refuse positions too far out for the cells, of all particles after some were added."""
        if self.can_touch:
            self.check_range(particles.position)

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the mask of particles that remain: its fields have a row for each particle."""
        return (number >= 0,)

    def check_range(self, position: np.ndarray) -> None:
        """Raise ValueError if a coordinate is too large for the cells."""
        cell = 2 * self._smallest_radius + self._present_skin
        far = np.abs(position) >= FARTHEST * cell
        if far.any():
            i, k = np.unravel_index(int(np.argmax(far)), far.shape)
            raise ValueError(
                f"Contact: position[{i}, {k}] = {position[i, k]:g} m is {abs(position[i, k]) / cell:.2g} cells of {cell:g} m "
                f"from the origin, but f32 tells only {FARTHEST} apart. Shift the scene towards the origin."
            )

    def release(self) -> None:
        """Unbind from the world, and forget its constraints."""
        super().release()
        self.__dict__.pop("ties", None)
        self.__dict__.pop("walls", None)

    def found(self, x: np.ndarray, h: float) -> Contacts:
        """Return the contacts of particles at x (n, dim) [m] after a substep h [s], for world.contacts."""
        return self.dev.geometry.found(x, h)

    @ti.func
    def overshoots(self, i):
        """Return 1 if particle i moves so far in one substep that a contact may be missed."""
        return self.dev.geometry.overshoots(i)

    @ti.func
    def is_pressed(self, i, e):
        """Whether particle i presses on what stands at entry e of its list."""
        return self.dev.rows.is_set(self.dev.rows.memory.field[e]) or self.dev.geometry.touches(i, self.dev.list.neighbour[e], 0)

    @ti.func
    def pressed_particle(self, j):
        """Return the particle that is pressed where an entry of a list is j."""
        return self.dev.geometry.pressed_particle(j)

    @ti.func
    def note_motion(self, stale, fast):
        """Set the flags of a stale list and of fast particles, see Rows.note_fast()."""
        if stale != 0:
            if self.dev.list.stale[None] == 0:
                self.dev.list.stale[None] = MOVED
        if fast != 0:
            self.dev.rows.note_fast()

    @ti.func
    def reaction(self, i):
        """Return how far loads moved particle i in the last substep of a frame [m]."""
        return self.dev.rows.borne[i]

    @ti.func
    def worst_overlap(self, i):
        """Return the number of pairs that particle i counts for the report, and its worst overlap relative to its size, in which
        walls count, too."""
        touching, worst = self.dev.geometry.worst_overlap(i)
        return touching, ti.max(worst, ti.cast(self.dev.rows.depth_in_walls(i), ti.f64))


def _skin(value):
    return value if isinstance(value, str) and value == "auto" else checks.number("Contact", "skin", value, above=0.0)
