"""Objects of one kind with their fields side by side, member after member, so that the code of one serves all of them.

The members declare their fields one after the other, in the same order. A field that each of them declares becomes one field with
the elements of all. Only the objects of the first member are compiled. A kernel that loops over the members calls enter(k): from
there on, subscripts of these fields address member k, as those of Copies address a copy. On the host each member reads and writes
its own part of a field.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from .language import at, current, impl, inline
from .number import Number, OnDevice

if TYPE_CHECKING:
    from .memory import Memory


class Part:
    """The handle by which a member other than the first reads and writes its elements of a field on the host."""


class Shared:
    """A field that members declare together.

    whole: the field with the elements of all. field: the same for kernels that enter a member. handles: of each member on the
    host; that of the first is `field`.
    """

    def __init__(self, whole: Any, name: str, width: int, kind: Any, state: bool, single: bool):
        self.name, self.width, self.kind, self.state, self.single = name, width, kind, state, single
        self.whole, self.field = whole, object.__new__(type(whole))
        self.pitch: Any = None  # elements of each member, or the field with the first element of each
        self.handles: list[Any] = []
        self.lengths: list[int] = []
        self.values: list[Any] = []

    def add(self, length: int, values: Any) -> Any:
        """Add the elements of one more member, and return its handle."""
        self.handles.append(Part() if self.handles else self.field)
        self.lengths.append(length)
        self.values.append(values)
        return self.handles[-1]

    @property
    def first_values(self) -> np.ndarray | None:
        """The first values of all elements, one member after the other; None if they are 0."""
        if all(v is None or not np.size(v) for v in self.values):
            return None
        wide = (self.width,) if self.width else ()
        rows = [
            np.broadcast_to(0.0 if v is None else np.asarray(v, dtype=np.float64), (length, *wide))
            for v, length in zip(self.values, self.lengths, strict=True)
        ]
        return np.concatenate(rows)


class Members:
    """The members that share code.

    count: their number. Within memory.member(members), declarations are those of the next one; memory.place_members() then
    declares the fields.
    """

    count: Any = OnDevice()

    def __init__(self, memory: "Memory", count: int):
        self._memory = memory
        self.count = memory.number(count)
        self.shared: list[Shared] = []
        self._next = 0  # index of the field that the present member declares next
        self._pitches: list[Any] = []  # see Shared
        self._now: tuple[Any, dict[Any, Any]] = (None, {})  # a kernel, and the first element of its member by pitch

    kernels_read = ("count_number",)

    def begin_member(self) -> None:
        """Begin the declarations of the next member."""
        self._next = 0

    def field(
        self, make: Callable[[Any, int], Any], name: str, length: Any, width: int, kind: Any, values: Any, state: bool = False
    ) -> Any:
        """Return the present member's handle of the field that it declares next. make: makes a field of a kind and a width."""
        if isinstance(length, Number):
            raise TypeError(f"{name} has a row per particle, so its owner cannot share code with others.")
        if self._next == len(self.shared):
            self.shared.append(Shared(make(kind, width), name, width, kind, state, length is None))
        one = self.shared[self._next]
        self._next += 1
        if (one.name, one.width, one.kind, one.single) != (name, width, kind, length is None):
            raise TypeError(f"{name} is declared where another member declares {one.name}.")
        return one.add(1 if length is None else max(1, int(length)), values)

    def number(self, make: Callable[[Any, int], Any], value: float, kind: Any) -> Number:
        """Return the present member's number that it declares next, in a field of its own."""
        return Number(self._memory, self.field(make, "number", None, 0, kind, value), None, value)

    def place(self) -> None:
        """Let kernels use the fields, once these are placed. Pitches are part of the names by which shared kernels are keyed."""
        self._pitches = [*dict.fromkeys(one.pitch for one in self.shared)]
        for one in self.shared:
            own = vars(one.field)
            own.update(vars(one.whole), members=self, pitch=one.pitch)
            if "place_name" in own:
                own["place_name"] += ("members", one.pitch if isinstance(one.pitch, int) else vars(one.pitch)["place_name"])

    @inline
    def enter(self, member):
        """In a kernel: from here on, subscripts address this member."""
        begins = {p: impl.expr_init(member * p if isinstance(p, int) else at(p, member)) for p in self._pitches}
        self._now = current().compiling_callable, begins

    def begin(self, pitch: Any) -> Any:
        """Return the first element of the current member in fields of this pitch, while a kernel is translated."""
        kernel, begins = self._now
        if kernel is not current().compiling_callable:
            raise RuntimeError("A kernel reads a field of members before it enters one.")
        return begins[pitch]
