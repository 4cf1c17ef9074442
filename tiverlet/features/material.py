"""Friction and restitution: what users give, checked, and as tables for kernels."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .. import checks
from ..device import inline, ti
from ..geometry.ordered import distinct

if TYPE_CHECKING:
    from .feature import Scene


class Coefficients(NamedTuple):
    """Of Coulomb friction: static and dynamic; and of the resistance to rolling and to twisting, see Contact."""

    static: float
    dynamic: float
    rolling: float = 0.0
    twisting: float = 0.0


class Bounce(NamedTuple):
    """Coefficients of restitution along the normal, and across it of what spins."""

    normal: float
    tangential: float = 0.0


def friction_of(who: str, name: str, value: Any) -> Coefficients:
    """A coefficient of Coulomb friction, or (static, dynamic), with rolling and twisting behind them or not."""
    given = value if isinstance(value, (tuple, list)) else (value, value)
    if not 2 <= len(given) <= 4:
        raise ValueError(
            f"{who}: {name} = {value!r}, but a number, (static, dynamic) or (static, dynamic, rolling, twisting) is needed."
        )
    out = Coefficients(
        *(checks.number(who, f"{name} ({kind})", v, least=0.0) for kind, v in zip(Coefficients._fields, given, strict=False))
    )
    if out.dynamic > out.static:
        raise ValueError(f"{who}: {name} = {value!r}: dynamic friction must not exceed static friction.")
    return out


def restitution_of(who: str, name: str, value: Any) -> Bounce:
    """A coefficient of restitution, 0 (inelastic) to 1 (elastic), or (normal, tangential)."""
    given = value if isinstance(value, (tuple, list)) else (value, 0.0)
    if len(given) != 2:
        raise ValueError(f"{who}: {name} = {value!r}, but a number or (normal, tangential) is needed.")
    normal = checks.number(who, name, given[0], least=0.0, most=1.0)
    return Bounce(normal, checks.number(who, f"{name} (tangential)", given[1], least=0.0, most=1.0))


def as_given(value: Any) -> Any:
    """A number or a tuple of numbers that was checked, as the user is to see it."""
    return tuple(float(v) for v in value) if isinstance(value, (tuple, list)) else float(value)


def refuse_turning(who: str) -> None:
    """Raise: particles that do not spin have no use for what resists or reverses it."""
    raise ValueError(
        f"{who}: resistance to rolling and tangential restitution are for particles that spin. Leave them out, or give "
        "tv.Particles a spin."
    )


@ti.func
def limited(v, most, length):
    """A vector that is no longer than `most`; else it in this length: what friction can take back of a slip v."""
    size = v.norm()
    if size > most:
        v *= length / size
    return v


MOST = 1000  # groups of particles that are told apart
TOUCHES, SENSES, SENSED = 1, 2, 3  # what a particle of a group does with one of another: push it, note it, be noted by it


class Table:
    """For each pair of groups: static friction, dynamic friction, restitution, whether they touch; and of what spins (`turns`)
    the resistance to rolling, to twisting, and the tangential restitution. One row where `uniform`.

    friction, restitution: one value for all, or a mapping from pairs of groups to values, with 0 for pairs that are not in it.
    touching: None for all, or the pairs of groups that touch. sensing: the pairs of groups of which the second notes what of the
    first it overlaps, and does not push; they do not touch.
    """

    kernels_read = ("uniform", "has_friction", "has_restitution", "turns", "senses", "groups", "rank", "entries")

    def __init__(self, who: str, friction: Any, restitution: Any, touching: Iterable | None, sensing: Any = ()):
        self.who, self.friction, self.restitution = who, friction, restitution
        self.touching = None
        if touching is not None:
            pairs = checks.rows(who, "groups", touching, "a list of pairs of groups, such as [(0, 1)],")
            self.touching = self._pairs("groups", pairs)
        pairs = checks.rows(who, "sensors", sensing, "a list of pairs of groups, such as [(0, 1)],")
        self.sensing = noting = self._pairs("sensors", pairs)
        self.senses = bool(noting)
        for a, b in noting:
            if {(a, b), (b, a)} & {*(self.touching or ())}:
                raise ValueError(f"{who}: groups has {(a, b)}, which touch, and so has sensors; leave one of them out.")
        single = not isinstance(friction, Mapping) and not isinstance(restitution, Mapping)
        self.uniform = single and touching is None and not self.senses
        values = friction.values() if isinstance(friction, Mapping) else [friction]
        rub = [friction_of(who, "friction", v) for v in values]
        values = restitution.values() if isinstance(restitution, Mapping) else [restitution]
        bounce = [restitution_of(who, "restitution", v) for v in values]
        self.has_restitution = any(v.normal > 0 for v in bounce)
        self.turns = any(v.rolling > 0 or v.twisting > 0 for v in rub) or any(v.tangential > 0 for v in bounce)
        self.has_friction = any(v.static > 0 for v in rub) or self.turns

    def pushing(self, group: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Which pairs (m, 2) of particles of these groups push each other, (m,)."""
        if not self.senses and self.touching is None:
            return np.ones(len(pairs), dtype=bool)
        rank, table = self.rows(group)
        m = rank.max() + 1
        return table.reshape(m, m, -1)[rank[pairs[:, 0]], rank[pairs[:, 1]], 3] == TOUCHES

    @property
    def named(self) -> frozenset[int]:
        """The groups that are named."""
        given = [v for v in (self.friction, self.restitution) if isinstance(v, Mapping)]
        return frozenset(k for pairs in (*given, self.touching or (), self.sensing) for pair in pairs for k in pair)

    def rows(self, group: np.ndarray, also: frozenset[int] = frozenset()) -> tuple[np.ndarray, np.ndarray]:
        """The rank of each particle's group, (n,), and the table, (ranks * ranks, 7). also: groups to tell apart beside those
        that are named."""
        named = self.named | also
        names, which, _ = distinct(group)
        at = {int(name): k for k, name in enumerate(name for name in names if name in named)}
        m = len(at) + (len(at) < len(names))  # all others are one
        if m > MOST:
            raise ValueError(f"{self.who}: {len(at)} groups of particles are named, but there can be {MOST}.")
        rank = np.array([at.get(int(name), len(at)) for name in names], dtype=np.int64)[which]
        table = np.zeros((m, m, 7))
        table[..., 3] = self.touching is None
        for a, b in self.touching or []:
            if a in at and b in at:
                table[at[a], at[b], 3] = table[at[b], at[a], 3] = TOUCHES
        for a, b in self.sensing:
            if a in at and b in at and table[at[a], at[b], 3] != SENSES:
                table[at[a], at[b], 3], table[at[b], at[a], 3] = SENSED, SENSES
        for name, columns, given, parse in (
            ("friction", [0, 1, 4, 5], self.friction, friction_of), ("restitution", [2, 6], self.restitution, restitution_of),
        ):  # fmt: skip
            if not isinstance(given, Mapping):
                table[..., columns] = parse(self.who, name, given)
                continue
            for pair, value in given.items():
                a, b = self._pair(name, pair)
                if a in at and b in at:
                    row = parse(self.who, f"value of {pair}", value)
                    table[at[a], at[b], columns] = table[at[b], at[a], columns] = row
        return rank, table.reshape(m * m, 7)

    def make_room(self, has_friction: bool, has_restitution: bool, turns: bool) -> None:
        """Have columns for what kernels ask for, though all of it may be 0."""
        self.has_friction, self.has_restitution, self.turns = has_friction, has_restitution, turns

    def bind(self, scene: "Scene", asked: bool = False) -> None:
        """Declare the table and the groups, where they differ. asked: of() is asked even where all rows are 0."""
        rank, rows = self.rows(scene.particles.group)
        self.groups = int(rank.max(initial=0)) + 1
        if self.uniform:
            rows = rows[:1]
        else:
            self.rank = scene.memory.field("Contact.group", scene.count, kind=ti.i32, values=rank)
        if self.has_friction or self.has_restitution or not self.uniform or asked:
            self.width = 7 if self.turns else 4  # of a row on the device
            self.entries = scene.memory.field("Contact.table", len(rows), width=self.width, values=rows[:, : self.width])

    def can_be(self, before: np.ndarray, now: np.ndarray) -> bool:
        """Whether the rows for particles of the groups before are those for the groups now."""
        return self.uniform or np.array_equal(self.rows(before)[1], self.rows(now)[1])

    def regroup(self, scene: "Scene", group: np.ndarray) -> None:
        """Particles have these groups now, as can_be() says."""
        if not self.uniform:
            scene.memory.write(self.rank, self.rows(group)[0])

    def upload(self, scene: "Scene", other: "Table") -> None:
        """Write the values of another table, which names no other groups, for the same kernels."""
        if "entries" in vars(self):
            rows = other.rows(scene.particles.group, self.named)[1][: 1 if self.uniform else None]
            scene.memory.write(self.entries, rows[:, : self.width])

    @ti.func
    def of(self, i, j):
        """Static friction, dynamic friction and restitution of particles i and j, and TOUCHES, SENSES or SENSED, or 0; and where
        it `turns` the resistance to rolling, to twisting, and the tangential restitution."""
        row = 0
        if ti.static(not self.uniform):
            row = self.rank[i] * self.groups + self.rank[j]
        return self.entries[row]

    @ti.func
    def held(self, i, j, n, normal, slip):
        """The part of a slip [m] of particles i and j that friction takes back, for a normal displacement along n [m]: up to
        friction times that (Cundall and Strack 1979)."""
        s, row = slip - slip.dot(n) * n, self.of(i, j)
        return limited(s, row[0] * normal, row[1] * normal)

    @inline
    def reach(self, radius, i, j):
        """How far from each other particles i and j may touch."""
        return radius.of(i) + radius.of(j)

    def _pairs(self, name: str, pairs: list) -> list[tuple[int, int]]:
        """Pairs of groups, checked; where there are thousands, one by one takes ten times as long."""
        if {*map(type, pairs)} == {tuple} and {*map(len, pairs)} == {2} and {type(k) for pair in pairs for k in pair} == {int}:
            return pairs
        return [self._pair(name, pair) for pair in pairs]

    def _pair(self, name: str, pair: Any) -> tuple[int, int]:
        return checks.group_pair(self.who, name, pair, "the key ")
