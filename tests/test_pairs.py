"""The neighbour list: no result depends on when and where it is built. tiverlet stress compares its pairs with brute force."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import room
from tiverlet.step import checkpoint


def roomy(w: tv.World, entries: int) -> None:
    """Make room in the neighbour list before compilation; when a list grows, everything compiles again."""
    w._runner.search.list.allocate(entries)
    w._runner.renew()


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


@pytest.mark.filterwarnings("ignore:.*near pairs per particle")
def test_a_list_for_which_there_is_no_memory_is_refused_and_never_used(world, monkeypatch):
    # All of n discs in a cell are near each other, n (n - 1) entries: with 20,000 discs 22 GB, and the system ended the process.
    n = 1500
    w = world(tv.Particles(1e-6 * tv.golden(np.arange(n), dim=2), radius=0.1), [tv.Contact()], substeps=2)
    monkeypatch.setattr(room, "free_memory", lambda: 1e8)
    for _ in range(2):  # nor is the list, which is too short, used by the next step
        with pytest.raises(
            MemoryError, match=r"of 28\d{5} near neighbours, 18\d\d for each .* 0.1 GB are free.*place them apart"
        ):
            w.step(1 / 60)
    w.position = 100 * tv.golden(np.arange(n), dim=2)
    w.step(1 / 60)
    r = np.linalg.norm(w.position[:, None] - w.position, axis=2)
    near = np.argwhere((r < 0.2 + w.contacts.overlap.max(initial=0.0)) & (r > 0))
    assert len(w.contacts.pairs) == len(near) // 2
    with pytest.raises(MemoryError, match=f"longer than {2**30 - 1}"):
        w._runner.step.searches[0].list.allocate(2**30)
    monkeypatch.setattr(room, "SMALL", 0)
    monkeypatch.setattr(room, "free_memory", lambda: 1e4)
    with pytest.raises(MemoryError, match="World: its fields take .* Take fewer particles"):
        world(w.particles, [])
