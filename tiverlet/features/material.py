"""Friction and restitution: what users give, checked, and as tables for kernels."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..device import inline, ti
from ..tools import distinct

if TYPE_CHECKING:
    from .feature import Scene


def friction_of(who: str, name: str, value: Any) -> tuple[float, float]:
    """A coefficient of Coulomb friction, or (static, dynamic), as (static, dynamic)."""
    both = value if isinstance(value, (tuple, list)) else (value, value)
    if len(both) != 2:
        raise ValueError(f"{who}: {name} = {value!r}, but a number or (static, dynamic) is needed.")
    static = checks.number(who, f"{name} (static)", both[0], least=0.0)
    dynamic = checks.number(who, f"{name} (dynamic)", both[1], least=0.0)
    if dynamic > static:
        raise ValueError(f"{who}: {name} = {value!r}: dynamic friction must not exceed static friction.")
    return static, dynamic


def restitution_of(who: str, name: str, value: Any) -> float:
    """A coefficient of restitution, 0 (inelastic) to 1 (elastic)."""
    return checks.number(who, name, value, least=0.0, most=1.0)


MOST = 1000  # groups of particles that are told apart
TOUCHES, SENSES, SENSED = 1, 2, 3  # what a particle of a group does with one of another: push it, note it, be noted by it


class Table:
    """For each pair of groups: static friction, dynamic friction, restitution, whether they touch; one row where `uniform`.

    friction, restitution: one value for all, or a mapping from pairs of groups to values, with 0 for pairs that are not in it.
    touching: None for all, or the pairs of groups that touch. sensing: the pairs of groups of which the second notes what of the
    first it overlaps, and does not push; they do not touch.
    """

    kernels_read = ("uniform", "has_friction", "has_restitution", "senses", "groups", "rank", "entries")

    def __init__(self, who: str, friction: Any, restitution: Any, touching: Iterable | None, sensing: Any = ()):
        self.who, self.friction, self.restitution = who, friction, restitution
        self.touching = None
        if touching is not None:
            pairs = checks.rows(who, "groups", touching, "a list of pairs of groups, such as [(0, 1)],")
            self.touching = [self._pair("groups", p) for p in pairs]
        pairs = checks.rows(who, "sensors", sensing, "a list of pairs of groups, such as [(0, 1)],")
        self.sensing = [self._pair("sensors", p) for p in pairs]
        self.senses = bool(self.sensing)
        for a, b in self.sensing:
            if {(a, b), (b, a)} & {*(self.touching or ())}:
                raise ValueError(f"{who}: groups has {(a, b)}, which touch, and so has sensors; leave one of them out.")
        single = not isinstance(friction, Mapping) and not isinstance(restitution, Mapping)
        self.uniform = single and touching is None and not self.senses
        values = friction.values() if isinstance(friction, Mapping) else [friction]
        self.has_friction = any(friction_of(who, "friction", v)[0] > 0 for v in values)
        values = restitution.values() if isinstance(restitution, Mapping) else [restitution]
        self.has_restitution = any(restitution_of(who, "restitution", v) > 0 for v in values)

    def rows(self, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The rank of each particle's group, (n,), and the table, (ranks * ranks, 4)."""
        named = {k for given in (self.friction, self.restitution) if isinstance(given, Mapping) for pair in given for k in pair}
        named |= {k for pair in (*(self.touching or ()), *self.sensing) for k in pair}
        names, which, _ = distinct(group)
        at = {int(name): k for k, name in enumerate(name for name in names if name in named)}
        m = len(at) + (len(at) < len(names))  # all others are one
        if m > MOST:
            raise ValueError(f"{self.who}: {len(at)} groups of particles are named, but there can be {MOST}.")
        rank = np.array([at.get(int(name), len(at)) for name in names], dtype=np.int64)[which]
        table = np.zeros((m, m, 4))
        table[..., 3] = self.touching is None
        for a, b in self.touching or []:
            if a in at and b in at:
                table[at[a], at[b], 3] = table[at[b], at[a], 3] = TOUCHES
        for a, b in self.sensing:
            if a in at and b in at and table[at[a], at[b], 3] != SENSES:
                table[at[a], at[b], 3], table[at[b], at[a], 3] = SENSED, SENSES
        for columns, given, parse in ((slice(0, 2), self.friction, friction_of), (2, self.restitution, restitution_of)):
            if not isinstance(given, Mapping):
                table[..., columns] = parse(self.who, "friction" if parse is friction_of else "restitution", given)
                continue
            for pair, value in given.items():
                a, b = self._pair("friction" if parse is friction_of else "restitution", pair)
                if a in at and b in at:
                    table[at[a], at[b], columns] = table[at[b], at[a], columns] = parse(self.who, f"value of {pair}", value)
        return rank, table.reshape(m * m, 4)

    def bind(self, scene: "Scene", asked: bool = False) -> None:
        """Declare the table and the groups, where they differ. asked: of() is asked even where all rows are 0."""
        rank, rows = self.rows(scene.particles.group)
        self.groups = int(rank.max(initial=0)) + 1
        if self.uniform:
            rows = rows[:1]
        else:
            self.rank = scene.memory.field("Contact.group", len(rank), kind=ti.i32, values=rank)
        if self.has_friction or self.has_restitution or not self.uniform or asked:
            self.entries = scene.memory.field("Contact.table", len(rows), width=4, values=rows)

    def upload(self, scene: "Scene", other: "Table") -> None:
        """Write the values of another table, for the same kernels."""
        if "entries" in vars(self):
            scene.memory.write(self.entries, other.rows(scene.particles.group)[1][: 1 if self.uniform else None])

    @ti.func
    def of(self, i, j):
        """Static friction, dynamic friction and restitution of particles i and j, and TOUCHES, SENSES or SENSED, or 0."""
        row = 0
        if ti.static(not self.uniform):
            row = self.rank[i] * self.groups + self.rank[j]
        return self.entries[row]

    @inline
    def reach(self, radius, i, j):
        """How far from each other particles i and j may touch."""
        return radius.of(i) + radius.of(j)

    def _pair(self, name: str, pair: Any) -> tuple[int, int]:
        if not (isinstance(pair, (tuple, list)) and len(pair) == 2 and all(isinstance(k, (int, np.integer)) for k in pair)):
            raise TypeError(f"{self.who}: {name} has the key {pair!r}, but a pair of groups such as (0, 1) is needed.")
        return int(pair[0]), int(pair[1])
