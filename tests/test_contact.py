"""Contacts: overlap of touching particles goes away gently, and piles come to rest."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import BEYOND, SLOP
from tiverlet.step import checkpoint

from .conftest import compiled
from .test_pairs import roomy


def smooth(world, start, wide=(99.0, 99.0), g=9.81, rate=0.0, low=(0.0, 0.0), precision="f64", **settings):
    """Build a world of discs without friction in a box; all such worlds share one structure per precision."""
    features = [tv.Gravity(g), tv.Drag(rate), tv.Contact(push_out=settings.pop("push_out", 1.0)), tv.Box(low, wide)]
    return world(start, features, precision=precision, **settings)


def rough(world, start, wide, friction, restitution, **settings):
    """Build a world of discs with friction and restitution in a box with friction; all such worlds share one structure."""
    contact, box = tv.Contact(friction=0.4, restitution=0.5), tv.Box((0, 0), wide, friction=0.4)
    w = world(start, [tv.Gravity(9.81), contact, box], precision="f64", **settings)
    contact.friction, contact.restitution, box.friction = friction, restitution, friction
    return w


@pytest.mark.slow
def test_a_heap_comes_to_rest_without_overlap(world):
    n = 150
    spots, radius = tv.golden(np.arange(n), dim=2) * [3.0, 12.0] + [0.2, 0.2], 0.06 + 0.1 * tv.golden(np.arange(n))
    w = smooth(world, tv.Particles(spots, radius=radius, mass=radius**2), (3.4, 14), substeps=40)
    w.run(4.0)
    assert w.last.overlap < 0.02 and w.last.contacts > n
    x, r, slop = w.position, radius[:, None], SLOP * BEYOND * radius[:, None]  # in which contacts rest
    assert (x - r >= -slop - 1e-6).all() and (x + r <= np.array([3.4, 14]) + slop + 1e-6).all()
    assert x[:, 1].max() < 4.0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*near pairs per particle")
@pytest.mark.parametrize("dim", [2, 3])
def test_coincident_particles_part_gently(world, dim):
    # Row 16: the direction is made from the indices, equal and opposite. Row 48: particles part at push_out, whatever the
    # depth. Clusters of 2, 100 and 300 particles, far from each other.
    speed, counts = 0.25, (2, 100, 300)
    x = np.repeat(np.arange(3), counts)[:, None] * (50 * np.eye(dim)[0])
    w = world(tv.Particles(x, radius=0.01), [tv.Contact(push_out=speed)], precision="f64", substeps=8)
    roomy(w, 2 * sum(n * n for n in counts))
    made = []
    for _ in range(2):
        w.position, w.velocity = x, 0 * x
        w.run(0.25)
        made.append(w.position)
    np.testing.assert_array_equal(*made)
    w.run(0.75)
    assert w.last.overlap < 0.05
    for count, end in zip(counts, np.cumsum(counts), strict=True):
        at, v = w.position[end - count : end], w.velocity[end - count : end]
        assert np.abs(v.sum(axis=0)).max() <= 1e-12 * count
        if count <= 100:
            across = np.linalg.norm(at[:, None] - at[None], axis=-1)
            assert across[np.triu_indices(count, 1)].min() >= 0.02 * 0.99
        # Neighbours part at `speed`. Across a cluster of N particles, speeds add up to `speed` times its width in particles.
        width = 2 * np.ceil(count ** (1 / dim)) if count > 2 else 1
        assert np.linalg.norm(v, axis=1).max() <= speed * width


def test_deep_overlap_leaves_at_push_out_without_velocity(world):
    # Positions part at push_out, by push_out h in each substep, until what is left is the overlap in which contacts rest.
    speed, slop = 0.25, SLOP * BEYOND * 0.1
    w = world(tv.Particles([[0.0, 0], [0.05, 0]], radius=0.1), [tv.Contact(push_out=speed)], substeps=10, precision="f64")
    for x in ([[0.0, 0], [0.05, 0]], [[0.0, 0], [0.0, 0.05]]):  # at the start, and after the user has placed them so
        w.position, w.velocity = x, np.zeros((2, 2))
        w.run(0.2)
        assert 0.8 * speed < (np.linalg.norm(w.position[1] - w.position[0]) - 0.05) / 0.2 < 1.3 * speed  # as passes overshoot
        w.run(1.0)
        assert 0.2 - slop <= np.linalg.norm(w.position[1] - w.position[0]) <= 0.2 + 1e-12
        np.testing.assert_array_equal(w.velocity, 0)


@pytest.mark.slow
def test_settled_piles_are_quiet(world):
    # No jitter: the kinetic energy of a settled pile falls below 1e-9 m g r per particle, also with friction and restitution. The
    # contacts across a height carry the weight above it, apart from the sound that is left: a velocity of sqrt(2e-6 g r) = 3 mm/s
    # at 30 rad/s is 1 % of g.
    k = np.arange(150)
    x = np.stack([k % 15 * 1.02 + 0.5 + 0.01 * tv.golden(k), k // 15 * 1.02 + 0.5], axis=1)
    start = tv.Particles(x, radius=0.5)
    for w in (smooth(world, start, (15.5, 60), substeps=8), rough(world, start, (15.5, 60), 0.4, 0.5, substeps=8)):
        w.run(36.0)
        assert tv.measure.kinetic_energy(w) / len(k) <= 1e-9 * 9.81 * 0.5
        if w.features[-1].friction == 0:
            height = w.position[:, 1]
            level = np.quantile(height, 0.5) + 1e-9
            i, j = w.contacts.pairs.T
            across = (height[i] > level) != (height[j] > level)
            up = np.where(height[i] > level, 1, -1) * w.contacts.normal[:, 1] * w.contacts.impulse * 480
            assert up[across].sum() == pytest.approx(9.81 * (height > level).sum(), rel=1e-2)


@pytest.mark.slow
def test_what_falls_on_something_lighter_stays_there(world):
    # Without restitution nothing is thrown back, whatever lies between a disc and the floor: one pass per substep would hold a
    # mass M on m like a spring, and return its energy (0.36 of the height at 10 : 1, 0.7 at 100 : 1). What is left is less than
    # a fifth of the height. Masses from the floor up; the last disc of a column falls by 0.35 to 0.65 m.
    r = 0.1
    columns = [[1.0, 2.5], [1.0, 10.0], [1.0, 100.0], [1.0] * 10 + [10.0], [1.0] * 3 + [30.0]]
    for mass in columns:
        for height in np.linspace(0.35, 0.65, 3):
            y = r + 2 * r * (1 + 1e-6) * np.arange(len(mass))  # no overlap by rounding, which would compile other kernels
            y[-1] += height
            start = tv.Particles(np.stack([np.full(len(y), 5.0), y], axis=1), radius=r, mass=mass)
            w = smooth(world, start, substeps=8)
            tops = np.array([w.position[-1, 1] for _ in range(75) if w.step(1 / 60)]) - (y[-1] - height)
            assert tops[tops.argmin() :].max() <= 0.2 * height, (mass, height)
    # What is sent off is not held back: it rises by v^2 / 2 g.
    w.velocity = np.array([[0, 0]] * 3 + [[0, 2.0]])
    low, tops = w.position[-1, 1], [w.position[-1, 1] for _ in range(30) if w.step(1 / 60)]
    assert max(tops) - low == pytest.approx(2.0**2 / (2 * 9.81), rel=0.02)


@pytest.mark.slow
def test_a_pile_that_lands_is_soon_quiet(world):
    # Inelastic discs lose the energy of their fall as they meet. 900 of them fall by 1 m and more: 0.7 s after the first land,
    # less than 0.005 of m g 1 m is left. With a projection of velocities in every 32nd substep only it was 0.024.
    k = np.arange(900)
    x = np.stack([k % 30 * 0.115 + k // 30 % 2 * 0.02 + 0.1, k // 30 * 0.115 + 1.1], axis=1)
    w = smooth(world, tv.Particles(x, radius=0.05), (3.65, 50), precision="f32", substeps=8)
    w.run(1.25)
    assert tv.measure.kinetic_energy(w) <= 5e-3 * 900 * 9.81 * 1.0
    assert w.last.clean


@pytest.mark.slow
def test_small_and_heavy_discs_together_gain_no_energy(world):
    # Small discs are pressed deep into heavy ones, and turn around them within a substep. By the normals of its start, their mass
    # is split too few times: the projection of velocities had eigenvalues above 1, and made up to 2e15 J.
    for seed, substeps in ((1, 2), (5, 2), (1, 8)):
        rng, k = np.random.default_rng(seed), np.arange(400)
        x = np.stack([k % 20 * 0.25 + k // 20 % 2 * 0.03 + 0.2, k // 20 * 0.25 + 0.15], axis=1)
        start = tv.Particles(x, radius=np.where(rng.random(400) < 0.1, 0.12, 0.03), mass=rng.choice([1.0, 30.0], 400))
        w = smooth(world, start, (5.2, 50), precision="f32", substeps=substeps)
        first = w.step(1 / 60).energy
        assert max(w.step(1 / 60).energy for _ in range(149)) <= first * (1 + 1e-6) and w.position[:, 1].max() < 5.0


def test_idle_columns_do_not_creep(world):
    # Row 43: 1e5 substeps at rest on the floor, in f32.
    w = smooth(world, tv.Particles([[0.5, 0.5], [0.5, 1.501]], radius=0.5), (1, 9), rate=1.0, precision="f32", substeps=20)
    w.run(20.0)
    before = w.position
    w.substeps = 200
    w.run(5.0)
    w.substeps = 1000
    w.run(20 / 1.2, dt=1 / 1.2)  # h = 1 / 1200, as before
    rest = w.position
    w.run(100 / 1.2, dt=1 / 1.2)
    assert np.abs(w.position - rest).max() <= 0.5e-6
    assert np.abs(w.position - before).max() <= 1e-4
    assert tv.measure.kinetic_energy(w) <= 1e-6 * 9.81 * 0.5


def test_outrunning_the_contacts_is_flagged(world):
    # Row 47: at v h / r = 0.5 the pair is caught; above 1 it may pass through, which is flagged.
    r, h = 0.1, 1 / 600
    start = tv.Particles([[-0.55, 0.0], [0.55, 0.0]], radius=r)
    w = smooth(world, start, g=0.0, low=(-99.0, -99.0), push_out=0.25, substeps=10)
    for ratio, flagged in ((0.5, False), (0.9, False), (1.0, False), (2.0, True), (5.0, True)):
        v = ratio * r / h
        w.position, w.velocity = w.particles.position, [[v, 0], [-v, 0]]
        report = w.run(0.1)
        assert ("tunnelling-risk" in report.flags) == flagged
        if not flagged:
            assert w.position[0, 0] < w.position[1, 0]


@pytest.mark.slow
def test_the_skin_changes_no_bits_of_what_links_move(world):
    # Row 83: skins of 0.01 ... 2 contact distances; test_pairs.py tests the paths. Soft links move discs together and apart.
    n, rng = 60, np.random.default_rng(3)
    x, v = rng.uniform(-2, 2, (n, 2)), rng.normal(size=(n, 2))
    rest = np.linalg.norm(x[1::2] - x[::2], axis=1) * rng.uniform(0.9, 1.1, n // 2)
    springs = tv.Distance(np.arange(n).reshape(-1, 2), rest, compliance=1e-4)
    features = [tv.Gravity(9.81), springs, tv.Contact(friction=0.2), tv.Box((-2.2, -2.2), (2.2, 2.2))]
    start, hashes = tv.Particles(x, velocity=v, radius=0.1), set()
    w = world(start, features, substeps=4, iterations=2, solver=tv.Jacobi())
    contact, begin = w.features[2], checkpoint.keep(w)
    for contact.skin in (0.002, 0.4, 0.05):
        checkpoint.put_back(w, begin)
        for _ in range(25):
            w.step(1 / 60)
        hashes.add(w.hash())
    assert len(hashes) == 1


@pytest.mark.slow
def test_what_a_link_draws_through_another_disc_is_flagged(world):
    # Row 82: in one substep a link draws a particle from 0 to 1.15, through one at 0.7. A link of nearly its length draws it
    # through none.
    start, link = tv.Particles([[0.0, 0], [3.0, 0], [0.7, 0.0]], radius=0.3), tv.Distance([(0, 1)], 3.0)
    w = world(start, [link, tv.Contact(push_out=1.0)], substeps=1)
    for link.rest, flagged in ((2.99, False), (0.7, True)):
        assert ("tunnelling-risk" in w.step(1 / 60).flags) == flagged


@pytest.mark.parametrize("dim", [2, 3])
def test_discs_in_the_same_place_have_the_normal_along_which_they_part(world, dim):
    x = np.array([[0.0] * dim, [0.0] * dim, [5.0] * dim])
    w = world(tv.Particles(x, radius=0.1), [tv.Contact(push_out=0.25)], precision="f64")
    found = w.contacts
    np.testing.assert_array_equal(found.pairs, [[0, 1]])
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, rtol=1e-12)
    w.step(1 / 60)
    apart = w.position[0] - w.position[1]
    np.testing.assert_allclose(apart / np.linalg.norm(apart), found.normal[0], atol=1e-9)


def test_a_column_of_60_stands(world):
    x = np.stack([np.full(60, 0.1), 0.1 + 0.2001 * np.arange(60)], axis=1)
    w = smooth(world, tv.Particles(x, radius=0.1), (0.2, 20), precision="f32", substeps=2)
    for substeps in (2, 8):
        w.position, w.velocity, w.substeps = x, 0 * x, substeps
        report = w.run(2.0)  # a load needs as many passes as there are discs to reach the floor
        assert report.clean and report.overlap < (0.05 if substeps == 2 else SLOP * BEYOND)


def test_overlap_that_rounding_makes_is_flagged(world):
    # At 1e5 m f32 tells places 8 mm apart, which no substep makes less.
    near = tv.Particles([[1e5 + 0.1, 0.1], [1e5 + 0.126, 0.1]], radius=0.02)
    report = smooth(world, near, (1e5 + 1, 20), precision="f32", push_out=0.0).step(1 / 60)
    assert report.flags == {"compressed"} and "are rounded to 0.0078 m in f32" in report.notes[0]


def test_a_point_in_the_middle_of_a_disc_that_is_to_stay_there(world):
    # At push_out = 0 nothing that overlaps parts.
    w = smooth(world, tv.Particles([(0.5, 1)] * 2, radius=[0.1, 0], mass=[1, 2]), g=0.0, push_out=0.0)
    w.run(0.1)
    np.testing.assert_array_equal(w.position, [(0.5, 1)] * 2)


@pytest.mark.filterwarnings("ignore:Box. particle 0 starts")
def test_a_wall_pushes_at_its_own_speed_and_what_starts_outside_comes_in_at_push_out(world):
    # A piston: within a frame the wall moves to its new place, and carries the particle that it meets.
    box = tv.Box((0, 0), (10, 10), push_out=2.0)
    w = world(tv.Particles([[0.5, 5.0], [7.0, 5.0]], radius=0.5), [box], precision="f64", substeps=10)
    for k in range(30):
        box.lower = (0.1 * (k + 1), 0)
        w.step(1 / 60)
        assert w.position[0, 0] == pytest.approx(0.1 * (k + 1) + 0.5, abs=1e-12)
    assert w.velocity[0, 0] == pytest.approx(6.0, rel=1e-9)
    w = world(tv.Particles([[-3.0, 0.0], [0.0, 0.0]], radius=0.1), [tv.Box((-1, -1), (1, 1), push_out=2.0)], precision="f64")
    w.run(1.2)
    assert abs(w.velocity[0, 0]) <= 2.0 + 1e-12 and w.position[0, 0] >= -0.9


@pytest.mark.slow
@pytest.mark.parametrize("pinned", [(), (0, 1)], ids=["linked", "pinned"])
def test_what_starts_between_others_is_not_shot_out(pinned, world):
    # A disc y away from the middle between two others, d away from each: d^2 = y^2 + (L / 2)^2, so y' = d' d / y, which has no
    # limit where d grows at push_out. Places move it, and give no velocity. A link that is moved far turns, and what one tangent
    # leaves of it is pulled back.
    for y, substeps in ((-0.01, 20), (-0.01, 200), (-0.001, 200)):
        x = np.array([[0.0, 0.0], [0.3, 0.0], [0.15, y]])
        features = [tv.Distance([(0, 1)]), tv.Contact(push_out=1.0)]
        w = world(tv.Particles(x, radius=0.1, pinned=pinned), features, substeps=substeps)
        fastest = max(np.linalg.norm(w.velocity, axis=1).max() for _ in range(30) if w.step(1 / 60))
        assert fastest < (1e-6 if pinned else 4.0)
        r = w.position[2] - w.position[:2]
        assert np.linalg.norm(r, axis=1).min() > 0.2 - 0.1 * SLOP * BEYOND - 1e-6  # it is out, but for what places leave


def test_what_overlaps_in_a_row_parts_at_push_out(world):
    # Ten in a row, each in the next one by a fifth. What overlaps parts by moves, without velocity, each pair at push_out: the
    # ends part at 9 push_out at most.
    push_out, x = 0.5, np.stack([np.zeros(10), np.arange(10) * 0.16], axis=1)
    w = world(tv.Particles(x, radius=0.1), [tv.Contact(push_out=push_out)], precision="f64", substeps=8)
    middle, fastest = x.mean(axis=0), 0.0
    for _ in range(90):
        before, report = w.position[:, 1], w.step(1 / 60)
        fastest = max(fastest, np.ptp(60 * (w.position[:, 1] - before)))
    assert push_out / 2 < fastest < 9 * push_out
    assert report.overlap < 3 * SLOP and abs(w.position.mean(axis=0) - middle).max() < 1e-9


@pytest.mark.slow
def test_what_goes_to_another_place_compiles_nothing(world):
    # Six discs rest on each other. One is carried off, twice before it is seen. The first disc of a group that is named, but had
    # no particles, is not another structure either, nor is a disc that is put into another one. They part.
    x = np.vstack([np.stack([np.zeros(6), 0.1 + 0.201 * np.arange(6)], axis=1), [[50.0, 0.1], [51.0, 0.1]]])
    contact, link = tv.Contact(groups=[(0, 0), (0, 1)], friction={(0, 1): 0.5}), tv.Distance([[6, 7]])
    w = world(tv.Particles(x, radius=0.1), [tv.Gravity(), contact, link, tv.HalfSpace((0, 1), 0.0)], substeps=8)
    w.run(1.0)
    w.position, w.velocity = w.position, w.velocity  # the kernels of a start
    w.step(1 / 60)
    with compiled() as names:
        for place in ((1.0, 2.0), (2.0, 2.0)):
            x = w.position.copy()
            x[5] = place
            w.position = x
        with w.clone() as twin:
            w.run(0.3)
            twin.run(0.3)
            assert twin.hash() == w.hash()
        w.add(tv.Particles([[1.0, 3.0]], radius=0.1, group=1))
        w.run(0.5)
        x = w.position.copy()
        x[5] = x[8] + [0.05, 0.05]
        w.position = x
        w.run(0.5)
    assert names == [] and np.linalg.norm(w.position[5] - w.position[8]) > 0.2 - 0.1 * SLOP * BEYOND - 1e-6


def test_a_lasting_overlap_is_flagged_and_the_advice_ends_it(world):
    # Masses of 1, 1000 and 1e5 kg on each other: at 4 substeps they would rest a third of a radius in each other, without a word.
    x, radius, mass = [(0, 0.1), (0, 0.45), (0.05, 0.8)], [0.1, 0.25, 0.1], [1.0, 1e3, 1e5]
    start = tv.Particles(np.add(x, (0.3, 0)), radius=radius, mass=mass)
    w = smooth(world, start, (0.6, 9), push_out=None, substeps=4)
    for _ in range(6):
        w.run(1.0)
        report = w.step(1 / 60)
        if report.clean:
            break
        assert report.flags == {"compressed"} and report.overlap > 0.05
        w.substeps = int(report.notes[0].partition("Use up to ")[2].partition(" substeps")[0])
    assert w.substeps > 20 and report.overlap < 0.05


@pytest.mark.parametrize(("part", "flags"), [(0.045, set()), (0.055, {"compressed"})])
def test_the_border_of_what_counts_as_compressed_is_a_twentieth_of_a_radius(world, part, flags):
    x = [(0.0, 0.0), (0.2 - 0.1 * part, 0.0)]
    w = smooth(world, tv.Particles(x, radius=0.1), g=0.0, low=(-99.0, -99.0), push_out=1e-3, substeps=4)
    assert w.step(1 / 60).flags == flags
