"""Which constraints are worth solving together, and in which order: the symbolic half of a sparse elimination."""

import heapq
from collections import defaultdict
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from ..geometry.ordered import distinct
from .corners import components, corners_of

SHORT = 4096  # corners of a part up to which its plan is kept
COUNTED = (("entry", "column"), ("product", "product"), ("update", "update"))  # what X_begin counts, row by row, and its array


@dataclass
class Plan:
    """Rows in elimination order, one part after the other, and where every number of the elimination goes.

    All values stand in one array: a diagonal for each row, then for each coupling of two rows the entry above the diagonal, then
    the one below.
    """

    rows: np.ndarray  # (m,) constraints, by the numbers they were given
    part_begin: np.ndarray  # (parts + 1,) rows of each part
    entry_begin: np.ndarray  # (m + 1,) couplings of each row to later ones
    column: np.ndarray  # (e,) the later row
    product_begin: np.ndarray  # (m + 1,) products of each row
    product: np.ndarray  # (q, 3) address of a value, corner that gives the gradient, corner that gives the move
    update_begin: np.ndarray  # (m + 1,)
    update: np.ndarray  # (u,) addresses of what the elimination of a row changes, all pairs of its couplings in order
    widths: list[int] = field(default_factory=list)  # of each part: the most rows that one elimination couples

    @property
    def parts(self) -> int:
        """The number of systems that have nothing to do with each other."""
        return len(self.part_begin) - 1


def plan_of(links: list, inv_mass: np.ndarray, width: int) -> Plan:
    """The parts of these batches, see plan(); particles that cannot move couple nothing."""
    owner, item = corners_of(links)
    free = inv_mass[item] > 0
    return plan(sum(b.count for b in links), owner[free], item[free], width)


def plan(count: int, owner: np.ndarray, item: np.ndarray, width: int) -> Plan:
    """The parts of `count` constraints whose elimination never couples more than `width` others, in order of least degree.

    (owner[k], item[k]): corner k belongs to constraint `owner` and is the particle `item`, which can move. Constraints that share
    a particle are coupled. A chain has width 1, a closed loop 2, a joint of k rods k - 1.
    """
    label = components(count, owner, item)
    crowd = np.bincount(item, minlength=1)
    refused = distinct(label[owner[crowd[item] > width + 1]])[0]
    corners = np.flatnonzero(~np.isin(label[owner], refused))
    corners = corners[np.argsort(label[owner[corners]], kind="stable")]  # part by part
    _, part, sizes = distinct(label[owner[corners]])
    owners, own = _numbered(part, owner[corners], len(sizes))
    _, its = _numbered(part, item[corners], len(sizes))
    firsts, ends = np.searchsorted(owners[:, 0], np.arange(len(sizes))).tolist(), np.cumsum(sizes).tolist()
    found = []
    for first, size, end in zip(firsts, sizes.tolist(), ends, strict=True):
        mine = slice(end - size, end)
        plan = (_known if size <= SHORT else _planned)(width, own[mine].tobytes(), its[mine].tobytes())
        if plan:
            found.append((plan, first, end - size))
    return _joined(found, owners[:, 1], corners)


def _numbered(part: np.ndarray, what: np.ndarray, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """All of `what`, each once, by part, (k, 2); and for every one its number among those of its part, in order."""
    each, which, _ = distinct(np.stack([part, what], axis=1))
    return each, (which - np.searchsorted(each[:, 0], np.arange(parts))[part]).astype(np.int32)


def _planned(width: int, owner: bytes, item: bytes) -> Plan | None:
    """One part, whose owners and items are numbered from 0 on, as bytes of i32; None where it is wider than `width`."""
    owners, items = (np.frombuffer(one, dtype=np.int32).tolist() for one in (owner, item))
    corners: dict[int, list[int]] = defaultdict(list)
    sharing: dict[int, list[int]] = defaultdict(list)
    for k, (c, i) in enumerate(zip(owners, items, strict=True)):
        corners[c].append(k)
        sharing[i].append(k)
    near = {c: {owners[k] for b in corners[c] for k in sharing[items[b]]} - {c} for c in range(len(corners))}
    found = _eliminate(near, width)
    return _addresses(found, corners, sharing, owners, items) if found else None


# Many parts are alike, as ropes of one length are, and those of an edited world are known from before.
_known = lru_cache(maxsize=64)(_planned)


def _joined(found: list[tuple[Plan, int, int]], owners: np.ndarray, corners: np.ndarray) -> Plan:
    """The plan of all parts: of each its own, and from which number on the owners and the corners are its."""
    plans = [one for one, _, _ in found]

    def sizes(name: str) -> np.ndarray:
        """How many each part has of something."""
        return np.array([len(getattr(one, name)) for one in plans], dtype=np.int64)

    def ends(name: str) -> np.ndarray:
        """Where those of each part begin, and where all end."""
        return np.concatenate([[0], np.cumsum(sizes(name))])

    def joined(name: str, shift: np.ndarray | list[int], skip: int = 0) -> np.ndarray:
        """What each part has of something, shifted."""
        each = [getattr(one, name)[skip:] for one in plans]
        by = np.repeat(np.asarray(shift[: len(plans)], dtype=np.int64), [len(some) for some in each])
        return np.concatenate([*each, np.zeros(0, dtype=np.int64)]) + by

    def shifted(address: np.ndarray, name: str) -> np.ndarray:
        """Addresses in the arrays of the parts, in that of all."""
        part = np.repeat(np.arange(len(plans)), sizes(name))
        m, entries = sizes("rows")[part], sizes("column")[part]
        row, entry = address + rows[part], address - m + rows[-1] + columns[part]
        return np.where(address < m, row, np.where(address < m + entries, entry, entry - entries + columns[-1]))

    rows, columns = ends("rows"), ends("column")
    product = np.concatenate([*(one.product for one in plans), np.zeros((0, 3), dtype=np.int64)])
    begin = np.repeat(np.array([k for _, _, k in found], dtype=np.int64), sizes("product"))[:, None]
    product = np.column_stack([shifted(product[:, 0], "product"), corners[product[:, 1:] + begin]])
    starts = [np.concatenate([[0], joined(f"{name}_begin", ends(of), 1)]) for name, of in COUNTED]
    return Plan(
        owners[joined("rows", [k for _, k, _ in found])], rows, starts[0], joined("column", rows), starts[1], product,
        starts[2], shifted(joined("update", [0] * len(plans)), "update"), [w for one in plans for w in one.widths],
    )  # fmt: skip


def _eliminate(near: dict[int, set[int]], width: int) -> list[tuple[int, list[int]]] | None:
    """Rows in order of least degree, each with those that it is coupled to then; None where there would be more than `width`."""
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


def _addresses(found: list[tuple[int, list[int]]], corners, sharing, owners, items) -> Plan:
    """The plan of one part, from what _eliminate() found."""
    order, later = [c for c, _ in found], dict(found)
    at = {c: r for r, c in enumerate(order)}
    m = len(order)
    columns = [sorted(at[o] for o in later[c]) for c in order]
    ends = np.cumsum([0] + [len(c) for c in columns])
    total = int(ends[-1])
    entry = {(r, j): e for r, row in enumerate(columns) for e, j in enumerate(row, int(ends[r]))}

    def address(row: int, column: int) -> int:
        """Where an entry of the matrix lies: diagonals first, then one triangle, then the other."""
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
        """As an array."""
        return np.asarray(values, dtype=np.int64)

    return Plan(
        ints(order), ints([0, m]), ints(ends), ints([j for row in columns for j in row]), ints(product_begin),
        ints(products).reshape(-1, 3), ints(update_begin), ints(updates), [max(len(row) for row in columns)],
    )  # fmt: skip
