"""Data of listed pairs, and columns of the table of rows that stands at the entries of a neighbour list."""

from typing import Any

from ..device import ti


class PairData:
    """Data of each listed pair: a number, or a vector of `width`.

    persistent: it belongs to the state, beyond a substep. for_reports: it is for reports only. is_transferred: it is copied to
    the next list; other data is recomputed. has_owner: the first particle of a pair stores it, if it can move; another one only
    in another piece of the team, and with the opposite sign if it is a vector. kind: type of the numbers; None for that of the
    world. field, old: the data of the present list, and of the old list while a new one is built.
    """

    field: Any
    old: Any

    def __init__(
        self, name: str, width: int, persistent: bool, is_transferred: bool = True, kind: Any = None, for_reports: bool = False,
        has_owner: bool = False,
    ):  # fmt: skip
        self.name, self.width, self.kind, self.has_owner = name, width, kind, has_owner
        self.persistent, self.is_transferred, self.for_reports = persistent, is_transferred, for_reports

    @ti.func
    def is_set(self, value):
        """Return 1 if a value of these data is not 0."""
        some = 0
        if ti.static(self.width == 0):
            some = ti.cast(value != 0, ti.i32)
        else:
            for k in ti.static(range(self.width)):
                some |= ti.cast(value[k] != 0, ti.i32)
        return some


class Column:
    """A column of a table with as many rows as the list has room for entries: a number in each row, or a vector of `width`.

    Rows keep their values and places when the list is rebuilt or grows.
    """

    field: Any

    def __init__(self, name: str, width: int = 0, kind: Any = None):
        self.name, self.width, self.kind = name, width, kind
