"""Which constraints are worth solving together, and in which order: the symbolic half of a sparse elimination."""

import heapq
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from ..geometry.ordered import distinct


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


def components(n: int, owner: np.ndarray, item: np.ndarray) -> np.ndarray:
    """Labels of n owners: equal where a chain of shared items leads from one to the other. (owner, item): what has what."""
    label, items = np.arange(n), int(item.max(initial=-1)) + 1
    while True:
        least = np.full(items, n)
        np.minimum.at(least, item, label[owner])
        new = label.copy()
        np.minimum.at(new, owner, least[item])
        np.minimum.at(new, label, new.copy())  # what is known of one is known of all with its label
        while not np.array_equal(new, new[new]):
            new = new[new]
        if np.array_equal(new, label):
            return label
        label = new


def plan_of(links: list, inv_mass: np.ndarray, width: int) -> Plan:
    """The parts of these batches, see plan(); particles that cannot move couple nothing."""
    arity = np.repeat([b.arity for b in links], [b.count for b in links])
    item = np.concatenate([b.indices.ravel() for b in links])
    owner = np.repeat(np.arange(len(arity)), arity)
    free = inv_mass[item] > 0
    return plan(len(arity), owner[free], item[free], width)


def plan(count: int, owner: np.ndarray, item: np.ndarray, width: int) -> Plan:
    """The parts of `count` constraints whose elimination never couples more than `width` others, in order of least degree.

    (owner[k], item[k]): corner k belongs to constraint `owner` and is the particle `item`, which can move. Constraints that share
    a particle are coupled. A chain has width 1, a closed loop 2, a joint of k rods k - 1.
    """
    label = components(count, owner, item)
    crowd = np.bincount(item, minlength=1)
    refused = distinct(label[owner[crowd[item] > width + 1]])[0]
    touched = distinct(owner)[0]
    touched = touched[~np.isin(label[touched], refused)]
    corners: dict[int, list[int]] = defaultdict(list)
    sharing: dict[int, list[int]] = defaultdict(list)
    for k in np.flatnonzero(np.isin(owner, touched)).tolist():
        corners[int(owner[k])].append(k)
        sharing[int(item[k])].append(k)
    groups: dict[int, list[int]] = defaultdict(list)
    for c in touched.tolist():
        groups[int(label[c])].append(c)
    owners = owner.tolist()
    order: list[int] = []
    later: dict[int, list[int]] = {}
    begin, widths = [0], []
    for group in groups.values():
        near = {c: {owners[k] for b in corners[c] for k in sharing[int(item[b])]} - {c} for c in group}
        found = _eliminate(near, width)
        if found:
            order += [c for c, _ in found]
            later.update(found)
            begin.append(len(order))
            widths.append(max(len(n) for _, n in found))
    return _addresses(order, later, corners, sharing, owners, item.tolist(), begin, widths)


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


def _addresses(order, later, corners, sharing, owners, items, begin, widths) -> Plan:
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
        ints(order), ints(begin), ints(ends), ints([j for row in columns for j in row]), ints(product_begin),
        ints(products).reshape(-1, 3), ints(update_begin), ints(updates), widths,
    )  # fmt: skip
