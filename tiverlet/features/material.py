"""Friction and restitution: checked arguments, and tables for kernels."""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .. import checks
from ..device import inline, ti
from ..geometry.ordered import distinct

if TYPE_CHECKING:
    from .feature import Scene


DEGREES = 10.0  # a coefficient from here up to 90 is taken for an angle: no pair of materials has more than about 2


class Coefficients(NamedTuple):
    """Coefficients of static and dynamic Coulomb friction, and of the resistance to rolling and to twisting, see Contact."""

    static: float
    dynamic: float
    rolling: float = 0.0
    twisting: float = 0.0


class Bounce(NamedTuple):
    """Coefficients of restitution along the normal, and, for spinning particles, tangential to it."""

    normal: float
    tangential: float = 0.0


def friction_of(who: str, name: str, value: Any) -> Coefficients:
    """Check a friction coefficient: a number, (static, dynamic), or these with rolling and twisting behind them."""
    given = _several(value)
    given = (value, value) if given is None else given
    if not 2 <= len(given) <= 4:
        raise ValueError(
            f"{who}: {name} = {value!r}, but a number, (static, dynamic) or (static, dynamic, rolling, twisting) is needed."
        )
    out = Coefficients(
        *(checks.number(who, f"{name} ({kind})", v, least=0.0) for kind, v in zip(Coefficients._fields, given, strict=False))
    )
    if DEGREES <= out.static < 90:
        mu = math.tan(math.radians(out.static))
        checks.warn(f"{who}: {name} = {value!r} is a coefficient. Of a slope of {out.static:g} degrees it is {mu:.2g}.")
    if out.dynamic > out.static:
        raise ValueError(f"{who}: {name} = {value!r}: dynamic friction must not exceed static friction.")
    return out


def restitution_of(who: str, name: str, value: Any) -> Bounce:
    """Check a coefficient of restitution, 0 (inelastic) to 1 (elastic), or (normal, tangential)."""
    given = _several(value)
    given = (value, 0.0) if given is None else given
    if len(given) != 2:
        raise ValueError(f"{who}: {name} = {value!r}, but a number or (normal, tangential) is needed.")
    normal = checks.number(who, name, given[0], least=0.0, most=1.0)
    return Bounce(normal, checks.number(who, f"{name} (tangential)", given[1], least=0.0, most=1.0))


def is_elastic(friction: Any, restitution: Any) -> bool:
    """Whether there is no friction, and restitution 1; both as given, or as mappings from pairs of groups."""
    rubs, bounces = (list(v.values()) if isinstance(v, Mapping) else [v] for v in (friction, restitution))
    return all(np.max(v) == 0 for v in rubs) and all(np.ravel(v)[0] == 1 for v in bounces) and len(bounces) > 0


def as_given(value: Any) -> Any:
    """Return a checked number or tuple of numbers as floats, in the form shown to the user."""
    several = _several(value)
    return float(value) if several is None else tuple(float(v) for v in several)


def _several(value: Any) -> tuple | None:
    """Return the numbers of a tuple, list or array; None where it is one number."""
    is_array = isinstance(value, np.ndarray) and value.ndim == 1
    return tuple(value) if is_array or isinstance(value, (tuple, list)) else None


def refuse_turning(who: str) -> None:
    """Raise ValueError: particles that do not spin take no rolling resistance and no tangential restitution."""
    raise ValueError(
        f"{who}: resistance to rolling and tangential restitution are for particles that spin. Leave them out, or give "
        "tv.Particles a spin."
    )


@ti.func
def limit_length(v, most, length):
    """Return a vector v, shortened to `length` if it is longer than `most`: the part of a slip v that friction takes back."""
    size = v.norm()
    if size > ti.max(most, 0):  # a load that is taken back is negative, and v may be 0
        v *= length / size
    return v


MAX_GROUPS = 1000  # groups of particles that the table can distinguish
# The columns of a Table, the last three only where `turns`.
STATIC, DYNAMIC, RESTITUTION, TOUCH, ROLLING, TWISTING, TANGENTIAL = COLUMNS = range(7)
# In column TOUCH: a particle of the one group pushes that of the other, senses it, is sensed by it.
TOUCHES, SENSES, SENSED = 1, 2, 3


class Table:
    """A table of contact coefficients by pairs of groups.

    Columns: static friction, dynamic friction, restitution, whether the groups touch; for spinning particles (`turns`) also the
    resistance to rolling and to twisting, and the tangential restitution. One row where `uniform`.

    friction, restitution: one value for all, or a mapping from pairs of groups to values, with 0 for pairs that are not in it.
    touching: the pairs of groups that touch; None for all. sensing: pairs of groups (a, b): b records overlap with a, without
    pushing; they do not touch.
    """

    kernels_read = ("uniform", "has_friction", "has_restitution", "turns", "senses", "groups", "rank", "entries")

    def __init__(self, who: str, friction: Any, restitution: Any, touching: Iterable | None, sensing: Any = ()):
        self.who, self.touching = who, None
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
        self.friction = self._by_groups("friction", friction, friction_of)
        self.restitution = self._by_groups("restitution", restitution, restitution_of)
        rub, bounce = (list(v.values()) if isinstance(v, dict) else [v] for v in (self.friction, self.restitution))
        self.has_restitution = any(v.normal > 0 for v in bounce)
        self.turns = any(v.rolling > 0 or v.twisting > 0 for v in rub) or any(v.tangential > 0 for v in bounce)
        self.has_friction = any(v.static > 0 for v in rub) or self.turns

    def __getstate__(self) -> dict[str, Any]:
        """Return what pickle stores: all but the fields of bind()."""
        return {name: value for name, value in vars(self).items() if name not in ("rank", "entries")}

    def _by_groups(self, name: str, given: Any, parse: Callable[[str, str, Any], Any]) -> Any:
        """Return checked coefficients for all, or by pairs of groups. Raises ValueError for a pair with two values."""
        if not isinstance(given, Mapping):
            return parse(self.who, name, given)
        out = {self._pair(name, pair): parse(self.who, name, value) for pair, value in given.items()}
        for (a, b), value in out.items():
            if out.get((b, a), value) != value:
                raise ValueError(
                    f"{self.who}: {name} has {(a, b)} and {(b, a)}, the same groups, with two values; leave one out."
                )
        return out

    def pushing(self, group: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Return which pairs (m, 2) of particles of these groups push each other, (m,)."""
        if not self.senses and self.touching is None:
            return np.ones(len(pairs), dtype=bool)
        rank, table = self.rows(group)
        m = math.isqrt(len(table))
        return table.reshape(m, m, -1)[rank[pairs[:, 0]], rank[pairs[:, 1]], TOUCH] == TOUCHES

    @property
    def named(self) -> frozenset[int]:
        """The groups that the arguments name."""
        given = [v for v in (self.friction, self.restitution) if isinstance(v, dict)]
        return frozenset(k for pairs in (*given, self.touching or (), self.sensing) for pair in pairs for k in pair)

    def rows(self, group: np.ndarray, also: frozenset[int] = frozenset()) -> tuple[np.ndarray, np.ndarray]:
        """Return the rank of each particle's group, (n,), and the table, (ranks * ranks, columns).

        All other groups share the last rank. Groups without particles have ranks, too, so that their first particle compiles
        nothing. also: groups to distinguish in addition to those that are named.
        """
        named = sorted(self.named | also)
        if len(named) >= MAX_GROUPS:
            raise ValueError(f"{self.who}: {len(named)} groups of particles are named, but there can be {MAX_GROUPS - 1}.")
        names, which, _ = distinct(group)
        at, m = {name: k for k, name in enumerate(named)}, len(named) + 1
        rank = np.array([at.get(int(name), len(at)) for name in names], dtype=np.int64)[which]
        table = np.zeros((m, m, len(COLUMNS)))
        table[..., TOUCH] = self.touching is None
        for a, b in self.touching or []:
            table[at[a], at[b], TOUCH] = table[at[b], at[a], TOUCH] = TOUCHES
        for a, b in self.sensing:
            if table[at[a], at[b], TOUCH] != SENSES:
                table[at[a], at[b], TOUCH], table[at[b], at[a], TOUCH] = SENSED, SENSES
        columns = [STATIC, DYNAMIC, ROLLING, TWISTING], [RESTITUTION, TANGENTIAL]
        for some, values in zip(columns, (self.friction, self.restitution), strict=True):
            if not isinstance(values, dict):
                table[..., some] = values
                continue
            for (a, b), value in values.items():
                table[at[a], at[b], some] = table[at[b], at[a], some] = value
        return rank, table.reshape(m * m, len(COLUMNS))

    def set_columns(self, has_friction: bool, has_restitution: bool, turns: bool) -> None:
        """Set which columns exist, even where all values are 0."""
        self.has_friction, self.has_restitution, self.turns = has_friction, has_restitution, turns

    def bind(self, scene: "Scene", asked: bool = False) -> None:
        """Declare the table, and the groups where they differ. asked: whether of() is called even where all rows are 0."""
        rank, rows = self.rows(scene.particles.group)
        self.groups = math.isqrt(len(rows))
        if self.uniform:
            rows = rows[:1]
        else:
            self.rank = scene.memory.field("Contact.group", scene.count, kind=ti.i32, values=rank)
        if self.has_friction or self.has_restitution or not self.uniform or asked:
            self.width = len(COLUMNS) if self.turns else ROLLING  # columns on the device
            self.entries = scene.memory.field("Contact.table", len(rows), width=self.width, values=rows[:, : self.width])

    def regroup(self, scene: "Scene", group: np.ndarray) -> None:
        """Write the groups of the present particles."""
        if not self.uniform:
            scene.memory.write(self.rank, self.rows(group)[0])

    def upload(self, scene: "Scene", other: "Table") -> None:
        """Write the values of another table that names no other groups, for the same kernels."""
        if "entries" in vars(self):
            rows = other.rows(scene.particles.group, self.named)[1][: 1 if self.uniform else None]
            scene.memory.write(self.entries, rows[:, : self.width])

    @ti.func
    def of(self, i, j):
        """Return the row of particles i and j.

        It has static friction, dynamic friction and restitution, and TOUCHES, SENSES or SENSED, or 0. With `turns` also the
        resistance to rolling, to twisting, and the tangential restitution.
        """
        row = 0
        if ti.static(not self.uniform):
            row = self.rank[i] * self.groups + self.rank[j]
        return self.entries[row]

    @inline
    def cutoff(self, radius, i, j):
        """Return the distance up to which particles i and j touch [m]."""
        return radius.of(i) + radius.of(j)

    def _pairs(self, name: str, pairs: list) -> list[tuple[int, int]]:
        """Check pairs of groups. Thousands of plain pairs are checked at once, ten times as fast as one by one."""
        if {*map(type, pairs)} == {tuple} and {*map(len, pairs)} == {2} and {type(k) for pair in pairs for k in pair} == {int}:
            return pairs
        return [self._pair(name, pair, "") for pair in pairs]

    def _pair(self, name: str, pair: Any, what: str = "the key ") -> tuple[int, int]:
        return checks.group_pair(self.who, name, pair, what)
