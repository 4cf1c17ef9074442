"""Pairs without contact, because links hold them together."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.exclusions import FOLDED, _inside


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


def test_chains_are_found_as_by_brute_force():
    rng = np.random.default_rng(0)
    for _ in range(300):
        n, m = rng.integers(2, 14), rng.integers(0, 20)
        links = rng.integers(0, n, (m, 2), dtype=np.int32)
        links = links[links[:, 0] != links[:, 1]]
        lengths, radius = rng.uniform(0, 1, len(links)), rng.uniform(0, 1, n) * rng.choice([0.1, 1, 3])
        found, direct = (
            set(map(tuple, _inside(links, lengths, radius).tolist())),
            set(map(tuple, np.sort(links, axis=1).tolist())),
        )
        right = nearest(links, lengths, radius)
        assert found - direct == right - direct and found <= right


def swing(world, contact: bool, ball: float, bead: float, **settings):
    """Build a world with a ball on a level rope of 14 links of 1/7 m."""
    rope = tv.shapes.rope((0, 3), (2, 3), points=15)
    radius, mass = np.full(15, bead), np.full(15, 0.2)
    radius[-1], mass[-1] = ball, 200.0
    features = [tv.Gravity(9.81), tv.Distance(rope.links), *([tv.Contact()] if contact else [])]
    return world(tv.Particles(rope.position, radius=radius, mass=mass, pinned=[0]), features, **settings)


@pytest.mark.slow
def test_a_ball_on_a_rope_swings_as_without_contacts(world):
    # The ball covers the end of the rope, and beads of radius above 1/7 m overlap the next but one. No contact could part them.
    for substeps in (20, "auto"):
        there, without = (swing(world, contact, 0.3, 0.15, substeps=substeps) for contact in (True, False))
        for _ in range(90):
            report = there.step(1 / 60)
            without.step(1 / 60)
            assert not report.flags and not report.contacts
        assert np.array_equal(there.position, without.position)


@pytest.mark.slow
def test_other_contacts_stay(world):
    # Beads that start in one place have no lengths yet, and spacers get longer: contacts of these pairs act and part them.
    x = np.array([[0.0, 0.0], [0.02, 0.0], [0.0, 0.02]])
    links = [tv.Distance([[0, 1], [1, 2]], rest=1.0), tv.Spacer([[3, 4], [4, 5]], 0.02)]
    w = world(tv.Particles(np.concatenate([x, x + 20]), radius=0.5), [*links, tv.Contact()])
    w.run(1.0)
    for first in (0, 3):
        assert np.linalg.norm(w.position[first + 2] - w.position[first]) >= 0.99, links[first // 3]


def test_what_can_give_way_holds_nothing_inside(world):
    # Two links of 1 m join three particles of radius 1.5 m. The ends overlap for good, so they have no contact. They have one
    # if the links are springs or may break.
    x = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    for more in ({}, {"compliance": 1e-3}, {"break_at": 5.0}):
        w = world(tv.Particles(x, radius=1.5), [tv.Distance([[0, 1], [1, 2]], **more), tv.Contact()])
        assert ([0, 2] in w._runner.search._excluded_pairs.tolist()) is (not more)  # pairs not listed; swing() shows the effect


@pytest.mark.slow
def test_edits_and_copies_leave_out_the_same(world):
    # A rope gets longer, and a thick one is added and cut in place. A clone, which is rebuilt, continues bit for bit.
    w = swing(world, True, 0.3, 0.04)
    links = w.features[1]
    w.run(0.2)
    links.rest = 1.5 * links.rest
    w.run(0.2)
    rope = tv.shapes.rope((0, 5), (1, 5), points=5)
    w.add(tv.Particles(rope.position, radius=0.3), extend={links: tv.Distance(rope.links + 15)})
    assert not w.step(1 / 60).contacts
    w.remove([17])  # no link holds its ends together, so they part
    w.run(0.5)
    assert np.linalg.norm(w.position[17] - w.position[16]) >= 0.59
    other = w.clone()
    for _ in range(20):
        w.step(1 / 60)
        other.step(1 / 60)
    assert w.hash() == other.hash()


@pytest.mark.slow
def test_boxes_in_a_row_do_not_fold_into_each_other(world):
    # Two boxes on two rods, as cars of a train, fall into a heap. Each rod kept its corners from touching the other box, whose
    # sides then passed these corners: boxes got into each other, and the heap had six times its energy.
    box, rng = np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.4], [0.0, 0.4]]), np.random.default_rng(0)
    places = np.stack([0.3 + 1.5 * (np.arange(9) % 3), 0.4 + 1.2 * (np.arange(9) // 3)], axis=1)
    x = (places[:, None, None] + np.array([[0.0, 0.0], [0.6, 0.0]])[:, None] + box).reshape(-1, 2)
    boxes, rods = (
        np.arange(72).reshape(18, 4),
        np.concatenate([[(8 * k + 1, 8 * k + 4), (8 * k + 2, 8 * k + 7)] for k in range(9)]),
    )
    v = np.repeat(rng.normal(0, 2, (9, 2)), 8, axis=0)
    features = [tv.ShapeMatch(boxes), tv.Distance(rods), tv.Polygons(boxes, 0.5), tv.Box((0, 0), (4.6, 20), friction=0.5)]
    w = world(tv.Particles(x, velocity=v), [tv.Gravity(9.81), *features], substeps=32)
    energy, flags = [], set()
    for _ in range(120):
        energy.append(w.step(1 / 60).energy)
        flags |= w.last.flags
    assert max(energy) < 1.001 * energy[0] and not flags
