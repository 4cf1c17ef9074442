"""The symbolic half of a sparse elimination: which constraints are solved together, and in which order."""

import heapq
from collections import defaultdict
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from ..geometry.ordered import distinct
from .corners import components

MOST_CACHED = 4096  # corners of a part up to which its plan is cached
BEGINS = (("entry", "column"), ("product", "product"), ("update", "update"))  # X of each X_begin, and the array it indexes


@dataclass
class Plan:
    """The plan of an elimination: rows in elimination order, part by part, and the address of every number.

    All values are in one array: the diagonals of all rows, then for each coupling of two rows the entry above the diagonal, then
    for each coupling the entry below.
    """

    rows: np.ndarray  # (m,) the constraint of each row
    part_begin: np.ndarray  # (parts + 1,) the first row of each part
    entry_begin: np.ndarray  # (m + 1,) the first coupling of each row to later rows
    column: np.ndarray  # (e,) the later row of each coupling
    product_begin: np.ndarray  # (m + 1,) the first product of each row
    product: np.ndarray  # (q, 3) address of a value, corner that gives the gradient, corner that gives the move
    update_begin: np.ndarray  # (m + 1,) the first update of each row
    update: np.ndarray  # (u,) addresses of the values that eliminating a row changes: all pairs of its couplings, in order
    widths: list[int] = field(default_factory=list)  # (parts,) the most rows that one elimination couples

    @property
    def parts(self) -> int:
        """Number of independent systems."""
        return len(self.part_begin) - 1


def plan(count: int, owner: np.ndarray, item: np.ndarray, width: int) -> Plan:
    """Return the plan of those parts of `count` constraints whose elimination never couples more than `width` others.

    owner, item: corner k belongs to constraint owner[k] and is the movable particle item[k]. Constraints that share a particle
    are coupled. Elimination is in order of least degree. A chain has width 1, a closed loop 2, a joint of k rods k - 1.
    """
    label = components(count, owner, item)
    crowd = np.bincount(item, minlength=1)
    refused = distinct(label[owner[crowd[item] > width + 1]])[0]
    corners = np.flatnonzero(~np.isin(label[owner], refused))
    corners = corners[np.argsort(label[owner[corners]], kind="stable")]  # part by part
    _, part, sizes = distinct(label[owner[corners]])
    owners, own = _number_within_parts(part, owner[corners], len(sizes))
    _, its = _number_within_parts(part, item[corners], len(sizes))
    firsts, ends = np.searchsorted(owners[:, 0], np.arange(len(sizes))).tolist(), np.cumsum(sizes).tolist()
    found = []
    for first, size, end in zip(firsts, sizes.tolist(), ends, strict=True):
        mine = slice(end - size, end)
        plan = (_plan_part_cached if size <= MOST_CACHED else _plan_part)(width, own[mine].tobytes(), its[mine].tobytes())
        if plan:
            found.append((plan, first, end - size))
    return _join_plans(found, owners[:, 1], corners)


def _number_within_parts(part: np.ndarray, what: np.ndarray, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct pairs (part, what), (k, 2); and for each element of `what` its index among those of its part."""
    each, which, _ = distinct(np.stack([part, what], axis=1))
    return each, (which - np.searchsorted(each[:, 0], np.arange(parts))[part]).astype(np.int32)


def _plan_part(width: int, owner: bytes, item: bytes) -> Plan | None:
    """Return the plan of one part; None where it is wider than `width`. owner, item: numbered from 0, as bytes of i32."""
    owners, items = (np.frombuffer(one, dtype=np.int32).tolist() for one in (owner, item))
    corners: dict[int, list[int]] = defaultdict(list)
    sharing: dict[int, list[int]] = defaultdict(list)
    for k, (c, i) in enumerate(zip(owners, items, strict=True)):
        corners[c].append(k)
        sharing[i].append(k)
    near = {c: {owners[k] for b in corners[c] for k in sharing[items[b]]} - {c} for c in range(len(corners))}
    found = _eliminate(near, width)
    return _assign_addresses(found, corners, sharing, owners, items) if found else None


# Many parts are alike, as ropes of one length are, and an edited world has mostly the parts that it had.
_plan_part_cached = lru_cache(maxsize=64)(_plan_part)


def _join_plans(found: list[tuple[Plan, int, int]], owners: np.ndarray, corners: np.ndarray) -> Plan:
    """Return the plan of all parts. found: for each part its plan, and the first of its owners and of its corners."""
    plans = [one for one, _, _ in found]

    def sizes(name: str) -> np.ndarray:
        """Return the length of a named array of each part."""
        return np.array([len(getattr(one, name)) for one in plans], dtype=np.int64)

    def ends(name: str) -> np.ndarray:
        """Return where the elements of each part begin in a joined array, and where all end."""
        return np.concatenate([[0], np.cumsum(sizes(name))])

    def joined(name: str, shift: np.ndarray | list[int], skip: int = 0) -> np.ndarray:
        """Join a named array of all parts, without its first `skip` elements, with `shift` added to the values of each part."""
        each = [getattr(one, name)[skip:] for one in plans]
        by = np.repeat(np.asarray(shift[: len(plans)], dtype=np.int64), [len(some) for some in each])
        return np.concatenate([*each, np.zeros(0, dtype=np.int64)]) + by

    def shifted(address: np.ndarray, name: str) -> np.ndarray:
        """Return addresses in the arrays of the parts as addresses in the joined array."""
        part = np.repeat(np.arange(len(plans)), sizes(name))
        m, entries = sizes("rows")[part], sizes("column")[part]
        row, entry = address + rows[part], address - m + rows[-1] + columns[part]
        return np.where(address < m, row, np.where(address < m + entries, entry, entry - entries + columns[-1]))

    rows, columns = ends("rows"), ends("column")
    product = np.concatenate([*(one.product for one in plans), np.zeros((0, 3), dtype=np.int64)])
    begin = np.repeat(np.array([k for _, _, k in found], dtype=np.int64), sizes("product"))[:, None]
    product = np.column_stack([shifted(product[:, 0], "product"), corners[product[:, 1:] + begin]])
    starts = [np.concatenate([[0], joined(f"{name}_begin", ends(of), 1)]) for name, of in BEGINS]
    return Plan(
        owners[joined("rows", [k for _, k, _ in found])], rows, starts[0], joined("column", rows), starts[1], product,
        starts[2], shifted(joined("update", [0] * len(plans)), "update"), [w for one in plans for w in one.widths],
    )  # fmt: skip


def _eliminate(near: dict[int, set[int]], width: int) -> list[tuple[int, list[int]]] | None:
    """Return rows in order of least degree, each with the rows it is then coupled to; None if these exceed `width`."""
    queue = [(len(others), c) for c, others in near.items()]
    heapq.heapify(queue)
    out = []
    while queue:
        degree, c = heapq.heappop(queue)
        if c not in near or degree != len(near[c]):
            continue
        if degree > width:
            return None
        others = near.pop(c)
        out.append((c, sorted(others)))
        for o in others:
            mine = near[o]
            mine |= others
            mine -= {o, c}
            heapq.heappush(queue, (len(mine), o))
    return out


def _assign_addresses(found: list[tuple[int, list[int]]], corners, sharing, owners, items) -> Plan:
    """Return the plan of one part. found: the result of _eliminate()."""
    order, later = [c for c, _ in found], dict(found)
    at = {c: r for r, c in enumerate(order)}
    m = len(order)
    columns = [sorted(at[o] for o in later[c]) for c in order]
    ends = np.cumsum([0] + [len(c) for c in columns])
    total = int(ends[-1])
    entry = {(r, j): e for r, row in enumerate(columns) for e, j in enumerate(row, int(ends[r]))}

    def address(row: int, column: int) -> int:
        """Return the address of an entry of the matrix: diagonals first, then the upper triangle, then the lower."""
        if row == column:
            return row
        return m + entry[row, column] if row < column else m + total + entry[column, row]

    products, updates, product_begin, update_begin = [], [], [0], [0]
    for r, c in enumerate(order):
        for a in corners[c]:
            for b in sharing[items[a]]:
                products.append((address(r, at[owners[b]]), a, b))
        updates += [address(j, k) for j in columns[r] for k in columns[r]]
        product_begin.append(len(products))
        update_begin.append(len(updates))

    def ints(values) -> np.ndarray:
        """Return values as an array of integers."""
        return np.asarray(values, dtype=np.int64)

    return Plan(
        ints(order), ints([0, m]), ints(ends), ints([j for row in columns for j in row]), ints(product_begin),
        ints(products).reshape(-1, 3), ints(update_begin), ints(updates), [max(len(row) for row in columns)],
    )  # fmt: skip
