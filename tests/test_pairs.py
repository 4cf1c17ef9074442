"""The neighbour list: it holds all pairs that brute force finds, and no result depends on when and where it is built."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.exclusions import FOLDED, _inside
from tiverlet.step import checkpoint


def roomy(w: tv.World, entries: int) -> None:
    """Make room in the neighbour list before compilation; when a list grows, everything compiles again."""
    w._runner.search.list.allocate(entries)
    w._runner.renew()


RNG = np.random.default_rng(7)
CELL = 0.3 * 1.01  # about that of particles of radius 0.15
PLACES = np.stack(np.divmod(np.arange(600), 24), axis=1) - 12
# Clusters at multiples of 256 cells fold onto one bucket, whatever the shape of the table.
FAR = np.stack(np.divmod(RNG.permutation(81 * 81)[:75], 81), axis=1) - 40
# Row 25: radii from 1 to 1000 in one scene: large particles among crowds of small ones and points.
WIDE = np.concatenate([10.0 ** RNG.uniform(-3, 0, 750), RNG.choice([0.0, 0.02, 0.1, 1.0], 230)])
SPACE = [RNG.uniform(-1.5, 1.5, (980, 3)), RNG.uniform(-900, -890, (980, 3)), RNG.uniform(-1, 1, (980, 3))]
SPACE[2][-2:] = [4e4, -4e4, 1.2e5], [4e4, -4e4, 1.2e5 + 0.3]
CLOUDS = {  # path, radii, positions
    "plane": ("fused", np.full(600, 0.15), [
        RNG.uniform(-5, 5, (600, 2)),
        RNG.uniform(0, 0.1, (600, 2)),  # rows 32 to 34: all in one cell
        np.repeat(FAR, 8, axis=0) * 256 * CELL + RNG.uniform(0.1, 0.9, (600, 2)) * CELL,
        (PLACES + 0.5) * CELL / 2,  # row 30: cells are as wide at the origin as elsewhere
        PLACES * CELL / 2,  # on the borders of cells
    ]),
    "radii 1:1000 in space, launched": ("launched", WIDE, SPACE),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*near pairs per particle")
@pytest.mark.parametrize("name", CLOUDS)
def test_pairs_equal_brute_force(world, name, briefly):
    # Starts with room for one entry where launched. Static particles, and groups that do not touch, have no pair.
    path, radius, clouds = CLOUDS[name]
    n, dim = clouds[0].shape
    static, group = np.arange(0, n, 5), np.arange(n) % 3
    start = tv.Particles(clouds[0], radius=radius, pinned=static, group=group)
    w = world(start, [tv.Contact(groups=[(0, 0), (0, 1), (1, 1), (2, 2)])], precision="f64", path=path)
    roomy(w, 1 if path == "launched" else 200_000)
    for x in clouds:
        w.position = x
        pairs, depth = tv.measure.overlapping(x, radius)
        held, apart = np.isin(pairs, static).all(axis=1), (group[pairs] == 2).sum(axis=1) == 1
        pairs, depth = pairs[~held & ~apart], depth[~held & ~apart]
        found = w.contacts
        np.testing.assert_array_equal(found.pairs, pairs)
        np.testing.assert_allclose(found.overlap, depth, rtol=1e-12, atol=1e-10 * np.abs(x).max())
        d = x[pairs[:, 0]] - x[pairs[:, 1]]
        np.testing.assert_allclose(found.normal, d / np.linalg.norm(d, axis=1)[:, None], rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_neither_room_nor_skin_changes_a_bit(world):
    # Row 35: the smallest skin rebuilds lists in nearly all substeps, and a list with room for one entry grows. A pair that
    # begins to overlap at the end of a substep is listed only if the skin is wide: its slip begins in the next substep. With
    # friction and restitution, and without.
    rng, k = np.random.default_rng(3), np.arange(120)
    x = np.stack([k % 12 * 0.215, 0.2 + k // 12 * 0.215], axis=1) + rng.uniform(0, 0.005, (120, 2))
    start = tv.Particles(x, velocity=0.5 * rng.normal(size=(120, 2)), radius=0.08 + 0.02 * tv.golden(k))
    contact, box = tv.Contact(friction=(0.6, 0.4), restitution=0.8), tv.Box((-0.2, 0), (2.8, 9), friction=0.5)
    w = world(start, [tv.Gravity(9.81), contact, box], substeps=5)
    begin = checkpoint.keep(w)
    for contact.friction, contact.restitution in (((0.6, 0.4), 0.8), (0.0, 0.0)):
        hashes = set()
        for contact.skin, entries in ((0.5, 100_000), (0.002, 1)):
            checkpoint.put_back(w, begin)
            roomy(w, entries)
            assert sum(w.step(1 / 60).contacts for _ in range(20)) > 20
            hashes.add(w.hash())
        assert len(hashes) == 1


@pytest.mark.slow
@pytest.mark.parametrize("flying", [8, 40])
def test_a_few_that_fly_far_meet_what_they_would_with_new_lists(world, flying):
    # 1056 discs lie still without touching. Others fly over them, towards each other and into them, by 0.3 m a substep, while a
    # list with a skin of 0.375 m covers 0.18 m. Of 1064 particles 16 may stray without a new list; 40 may not.
    k, j = np.arange(1056), np.arange(flying)
    still = np.stack([k % 44, k // 44], axis=1) * 1.05
    above = np.stack([j % 8 * 5.6, 26.3 + 1.9 * (j // 8) + 0.7 * (j % 2)], axis=1)
    v = np.stack([np.where(j % 8 < 4, 0.3, -0.3), np.where(j % 8 == 3, -0.25, 0.0)], axis=1)
    start, made = tv.Particles(np.vstack([still, above]), velocity=np.vstack([0 * still, v]), radius=0.5), []
    for always in (False, True):
        w = world(start, [tv.Contact()], path="fused", substeps=1)
        for _ in range(50):
            if always:
                w._runner.invalidate()
            w.step(1.0)
        made.append(w.hash())
        assert (w.velocity[:1056] != 0).any(axis=1).sum() > 20
    assert made[0] == made[1]


# Pairs without contact, because links hold them together.


def nearest(links: np.ndarray, lengths: np.ndarray, radius: np.ndarray) -> set[tuple[int, int]]:
    """Return the pairs whose shortest path along links is at most r_i + r_j, by the Floyd-Warshall algorithm."""
    n = len(radius)
    way = np.full((n, n), np.inf)
    for (i, j), length in zip(links, lengths, strict=True):
        if length > FOLDED * min(radius[i], radius[j]):
            way[i, j] = way[j, i] = min(way[i, j], length)
    for k in range(n):
        way = np.minimum(way, way[:, [k]] + way[[k], :])
    return {(i, j) for i in range(n) for j in range(i + 1, n) if way[i, j] <= radius[i] + radius[j]}


def test_chains_of_links_are_found_as_by_brute_force():
    rng = np.random.default_rng(0)
    for _ in range(300):
        n, m = rng.integers(2, 14), rng.integers(0, 20)
        links = rng.integers(0, n, (m, 2), dtype=np.int32)
        links = links[links[:, 0] != links[:, 1]]
        lengths, radius = rng.uniform(0, 1, len(links)), rng.uniform(0, 1, n) * rng.choice([0.1, 1, 3])
        found, direct = (set(map(tuple, pairs.tolist())) for pairs in (_inside(links, lengths, radius), np.sort(links, axis=1)))
        right = nearest(links, lengths, radius)
        assert found - direct == right - direct and found <= right


@pytest.mark.slow
def test_what_links_hold_inside_has_no_contact_unless_they_can_give_way(world):
    # The ball covers the end of its rope, and beads of radius above 1/7 m overlap the next but one. No contact could part them.
    rope = tv.shapes.rope((0, 3), (2, 3), points=15)
    start = tv.Particles(rope.position, radius=[0.15] * 14 + [0.3], mass=[0.2] * 14 + [200.0], pinned=[0])
    assert len(tv.measure.overlapping(start.position, start.radius)[0]) > 20
    assert len(world(start, [tv.Distance(rope.links), tv.Contact()]).contacts) == 0
    # Two links of 1 m join three particles of radius 1.5 m. The ends overlap for good, so they have no contact. They have one
    # if the links are springs or may break.
    x = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    for more in ({}, {"compliance": 1e-3}, {"break_at": 5.0}):
        w = world(tv.Particles(x, radius=1.5), [tv.Distance([[0, 1], [1, 2]], **more), tv.Contact()])
        assert ([0, 2] in w._runner.search._excluded_pairs.tolist()) is (not more)  # these are not listed
