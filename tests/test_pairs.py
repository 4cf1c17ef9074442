"""The neighbour list: it holds all pairs that brute force finds, and no result depends on when and where it is built."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import AHEAD
from tiverlet.geometry.ordered import median
from tiverlet.step import build, checkpoint
from tiverlet.step.diagnostics import EXTENT, REACH

from .conftest import CROSSOVER


def roomy(w: tv.World, entries: int) -> None:
    """Make room in the neighbour list before compilation; when a list grows, everything compiles again."""
    w._runner.search.list.allocate(entries)
    w._runner.renew()


SKIN = 0.03


CELL = (2 * 0.15 + SKIN) * (1 + 2.0**-12)  # of particles of radius 0.15


def clouds():
    """Yield names, radii, and a list of clouds (positions, filled) of as many particles.

    `filled`, where it matters: the number of buckets that they fill, and the most particles in one.
    """
    rng = np.random.default_rng(7)
    n = 600
    k = np.stack(np.divmod(np.arange(n), 24), axis=1) - 12
    far = rng.permutation(81 * 81)[
        :75
    ]  # clusters at multiples of 256 cells fold onto one bucket, whatever the shape of the table
    far = np.repeat(np.stack(np.divmod(far, 81), axis=1) - 40, 8, axis=0) * 256 * CELL
    yield (
        "plane", np.full(n, 0.15),
        [
            (rng.uniform(-5, 5, (n, 2)), None),
            (rng.uniform(0, 0.1, (n, 2)), (1, n)),  # rows 32 to 34: all in one cell
            (far + rng.uniform(0.1, 0.9, (n, 2)) * CELL, (1, n)),  # all in one bucket
            ((k + 0.5) * CELL / 2, (13 * 12, 4)),  # row 30: cells are as wide at the origin as elsewhere
            (k * CELL / 2, None),  # on the borders of cells
        ],
    )  # fmt: skip
    # Row 25: radii from 1 to 1000 in one scene: large particles among crowds of small ones and points.
    wide = np.concatenate([10.0 ** rng.uniform(-3, 0, 750), rng.choice([0.0, 0.02, 0.1, 1.0], 230)])
    yield "radii 1:1000", wide, [(rng.uniform(-3, 3, (980, 2)), None)]
    space = [rng.uniform(-1.5, 1.5, (980, 3)), rng.uniform(-900, -890, (980, 3)), rng.uniform(-1, 1, (980, 3))]
    space[2][-2:] = [1e5, -1e5, 3e5], [1e5, -1e5, 3e5 + 0.3]
    yield "radii 1:1000 in space", wide, [(x, None) for x in space]
    yield "two", np.full(2, 0.3), [([[0.0, 0], [0.5, 0]], None), ([[-7.0, 0], [-7, 0.5]], None)]


# A team takes one level in the plane and many in space; for many in the plane see test_many_particles. For launches see also
# test_grid.py.
CLOUDS = {
    "fused": ("plane", "radii 1:1000", "radii 1:1000 in space", "two"), "parallel": ("radii 1:1000 in space",),
    "launched": ("plane",),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*near pairs per particle")
@pytest.mark.parametrize(
    "path, name, radius, several", [(path, *c) for path, some in CLOUDS.items() for c in clouds() if c[0] in some]
)
def test_pairs_equal_brute_force(world, path, name, radius, several):
    # The list has pairs a little farther apart than the skin, for rows.
    ahead = AHEAD * median(np.asarray(radius)[np.asarray(radius) > 0])
    skin = max(SKIN - ahead, 1e-3)
    contact = tv.Contact(skin=skin)
    w = world(tv.Particles(several[0][0], radius=radius), [contact], precision="f64", path=path)
    wanted = [tv.measure.overlapping(position, radius, skin + ahead)[0] for position, _ in several]
    roomy(w, 4 * max(map(len, wanted)))
    for (position, filled), want in zip(several, wanted, strict=True):
        position = np.asarray(position)
        w._runner.memory.write(w._runner.scene.state.x, position)
        w._runner.search.fit(np.ptp(position, axis=0))
        w._runner.search.list.stale[None] = 1
        w._runner.list_neighbours()
        pairs, _ = w._runner.search.list.entries()
        pairs = pairs[pairs[:, 0] < pairs[:, 1]]
        np.testing.assert_array_equal(pairs, want)
        found = w._runner.memory.read(w._runner.search.list.number)
        # both particles count each pair
        np.testing.assert_array_equal(found, np.bincount(pairs.ravel(), minlength=len(position)))
        if filled:
            in_bucket = np.diff(w._runner.search.cells.edge.to_numpy()[: w._runner.search.cells.buckets + 2])
            assert ((in_bucket > 0).sum(), in_bucket.max()) == filled
        if path == "parallel" and name != "plane":
            continue  # a team's frames are compiled for one cloud; diagnostics sum all clouds in one way
        w._runner.diagnose_state()
        touching = w._runner.report()
        reach, *extent = w._runner.diagnostics.report.figures[[REACH, *range(EXTENT, EXTENT + w.particles.dim)]]
        assert reach == np.abs(position).max() and extent == np.ptp(position, axis=0).tolist()
        brute, depth = tv.measure.overlapping(position, radius)
        assert touching.contacts == len(brute)
        both = np.asarray(radius)[brute]
        small = np.where(both.min(axis=1) > 0, both.min(axis=1), both.max(axis=1))
        assert touching.overlap == pytest.approx((depth / small).max(initial=0.0), rel=1e-12)


@pytest.mark.slow
def test_many_particles(world, monkeypatch, briefly):
    monkeypatch.setattr(build, "CROSSOVER", CROSSOVER)
    rng = np.random.default_rng(8)
    position = rng.uniform(-63, 63, (40_000, 2))
    radius = rng.uniform(0.1, 0.5, 40_000)
    w = world(tv.Particles(position, radius=radius), [tv.Contact(skin=0.05 - AHEAD * median(radius))], precision="f64")
    assert w.path == ("parallel" if tv.runtime.cores() > 1 else "fused")
    w._runner.list_neighbours()
    first, number = (w._runner.memory.read(field) for field in (w._runner.search.list.first, w._runner.search.list.number))
    near = w._runner.search.list.store.read(w._runner.search.list.neighbour)
    i = np.repeat(np.arange(len(position)), number)
    j = near[np.repeat(first, number) + np.arange(len(i)) - np.repeat(np.cumsum(number) - number, number)]
    assert (np.diff(j)[np.diff(i) == 0] > 0).all()  # sorted, no pair twice
    got = np.stack([i, j], axis=1)[i < j]
    np.testing.assert_array_equal(got, tv.measure.overlapping(position, radius, 0.05)[0])


@pytest.mark.slow
def test_neither_room_nor_skin_nor_path_changes_a_bit(world):
    # Row 35: the hash with room for one entry of the list equals the hash with room for all, and no contact is missing. Nor does
    # it matter when lists are built: the smallest skin rebuilds them in nearly all substeps. For the launched path see
    # test_grid.py.
    position = np.random.default_rng(9).uniform(-1, 1, (200, 2))
    hashes = set()
    for path, ways in (
        ("fused", ((100_000, "auto"), (1, 0.001))),
        ("parallel", ((1, 0.3), (1, 0.05))),
    ):
        contact = tv.Contact(skin=ways[0][1])
        features = [tv.Gravity(9.81), contact, tv.Box((-1.2, -1.2), (1.2, 3))]
        w = world(tv.Particles(position, radius=0.1), features, path=path)
        begin = checkpoint.keep(w)
        for capacity, contact.skin in ways:
            checkpoint.put_back(w, begin)
            roomy(w, capacity)
            w.run(0.2)
            hashes.add(w.hash())
            assert w._runner.search.list.capacity * w._runner.search.list.blocks >= len(w._runner.search.list.entries()[0]) > 0
    assert len(hashes) == 1


@pytest.mark.slow
def test_the_skin_changes_no_bit_of_what_rubs_and_bounces(world):
    # A pair that begins to overlap at the end of a substep is listed only if the skin is wide: its slip begins in the next
    # substep. Without friction and restitution the skin changes no bit either: a world rebuilt for another skin keeps kernels
    # with friction 0.
    rng, k = np.random.default_rng(3), np.arange(200)
    x = np.stack([k % 14 * 0.215, 0.2 + k // 14 * 0.215], axis=1) + rng.uniform(0, 0.005, (200, 2))
    start = tv.Particles(x, velocity=2 * rng.normal(size=(200, 2)), radius=0.08 + 0.02 * tv.golden(k))
    contact, box = tv.Contact(friction=(0.6, 0.4), restitution=0.8), tv.Box((-0.2, 0), (3.2, 9), friction=0.5, restitution=0.3)
    w = world(start, [tv.Gravity(9.81), contact, box], substeps=5)
    begin = checkpoint.keep(w)
    for contact.friction, contact.restitution in (((0.6, 0.4), 0.8), (0.0, 0.0)):
        hashes = set()
        for contact.skin in (0.5, 0.002):
            checkpoint.put_back(w, begin)
            w.run(0.5)
            hashes.add(w.hash())
        assert len(hashes) == 1 and w.last.contacts > 20
