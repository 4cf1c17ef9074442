"""Sorting of short lists of integers in a field, each list by one thread."""

from .language import ti

LONG = 64  # length from which heapsort is faster than insertion sort


@ti.func
def sort(field: ti.template(), begin, count, runs: ti.template()):  # type: ignore[valid-type]
    """Sort `count` numbers from index `begin` on. runs: the numbers come in a few sorted runs, not in random order."""
    if ti.static(runs):
        insert(field, begin, count)
    elif count > LONG:
        heap(field, begin, count)
    else:
        insert(field, begin, count)


@ti.func
def insert(field: ti.template(), begin, count):  # type: ignore[valid-type]
    """Insertion sort: the fastest for lists that are short, or nearly sorted."""
    for a in range(1, count):
        j = field[begin + a]
        b = a
        while b > 0 and field[begin + b - 1] > j:
            field[begin + b] = field[begin + b - 1]
            b -= 1
        field[begin + b] = j


@ti.func
def heap(field: ti.template(), begin, count):  # type: ignore[valid-type]
    """Heapsort (Williams 1964, Floyd 1964): n log n steps in any order."""
    root, end = count // 2, count
    while end > 1:
        j = 0
        if root > 0:
            root -= 1
            j = field[begin + root]
        else:
            end -= 1
            j = field[begin + end]
            field[begin + end] = field[begin]
        at, child = root, 2 * root + 1
        while child < end:
            if child + 1 < end:
                if field[begin + child] < field[begin + child + 1]:
                    child += 1
            if field[begin + child] > j:
                field[begin + at] = field[begin + child]
                at = child
                child = 2 * at + 1
            else:
                child = end
        field[begin + at] = j


@ti.func
def exchange(field: ti.template(), begin, count, network: ti.template(), size: ti.template()):  # type: ignore[valid-type]
    """Sort at most `size` numbers by a sorting network, which has no branches, unless they are sorted already."""
    j = ti.Vector.zero(ti.i32, size)
    for k in ti.static(range(size)):
        j[k] = ti.select(k < count, field[begin + k], ti.static(2**31 - 1))
    mixed = 0
    for k in ti.static(range(size - 1)):
        mixed |= ti.cast(j[k] > j[k + 1], ti.i32)
    if mixed != 0:
        for layer in ti.static(network):
            for a, b in ti.static(layer):
                j[a], j[b] = ti.min(j[a], j[b]), ti.max(j[a], j[b])
        for k in ti.static(range(size)):
            if k < count:
                field[begin + k] = j[k]


def sorting_network(size: int) -> list[list[tuple[int, int]]]:
    """Return layers of index pairs to compare that sort `size` numbers, a power of two (Batcher's odd-even mergesort, 1968)."""
    out, p = [], 1
    while p < size:
        k = p
        while k >= 1:
            begins = range(k % p, size - k, 2 * k)
            pairs = [(i, i + k) for j in begins for i in range(j, j + min(k, size - j - k))]
            out.append([(a, b) for a, b in pairs if a // (2 * p) == b // (2 * p)])
            k //= 2
        p *= 2
    return out
