"""Contact events: against closed forms, NumPy's results from positions, and momentum."""

import numpy as np
import pytest

import tiverlet as tv

COLUMNS = ("pairs", "groups", "point", "normal", "impulse", "speed", "began", "ended")


def equal(one, two):
    """Assert that two sets of events are equal bit for bit; return their number."""
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(one.touches, name), getattr(two.touches, name))
    return len(one)


def rows(pairs):
    """Return pairs as a set."""
    return {tuple(map(int, pair)) for pair in pairs}


BOUNCE = 0.8


def flat(world, start, g=9.81, wide=99.0, **settings):
    """Build a 2D world in a box that records events, in which group 7 are sensors and all bounces: one structure."""
    contact = tv.Contact(restitution=BOUNCE, sensors=[(0, 7), (1, 7)], events=True)
    box = tv.Box([-wide] * 2, [wide] * 2, restitution=BOUNCE, events=True)
    return world(start, [tv.Gravity(g), contact, box], precision="f64", **settings)


@pytest.mark.slow
def test_a_bouncing_ball(world):
    # Dropped from H onto a static ball, and onto a floor: after k bounces v_k = e^k sqrt(2 g H), at
    # t_k = t_0 (1 + 2 (e + ... + e^k)). A bounce takes less than two substeps, so each begins and ends in the same frame. The
    # speed of approach is taken at the middle of a substep, off by g h / 2 at most. The speed of departure follows from the
    # previous bounce, which adds up to e g h per bounce.
    H, e, g, m, r, frame, substeps = 0.5, BOUNCE, 9.81, 2.0, 0.05, 1 / 60, 20
    h = frame / substeps
    start = tv.Particles([[0.0, 0], [0, 2 * r + H], [1, r + H - 99]], radius=[r + 1e-12, r, r], mass=[np.inf, m, m])
    w = flat(world, start, substeps=substeps)
    seen, t0, v0 = [[], []], np.sqrt(2 * H / g), np.sqrt(2 * g * H)
    for _ in range(120):
        w.step(frame)
        for k, events in enumerate((w.events(), w.wall_events())):
            assert rows(events.begun.pairs) == rows(events.ended.pairs) == rows(events.touches.pairs) and not len(events.lasting)
            seen[k] += [events.touches] if len(events) else []
    for k, (pair, normal, height) in enumerate((((0, 1), -1, r), ((2, 2), 1, -99.0))):
        assert len(seen[k]) == 5
        for n, touch in enumerate(seen[k]):
            v, t = e**n * v0, t0 * (1 + 2 * sum(e**i for i in range(1, n + 1)))
            assert rows(touch.pairs) == {pair} and abs(touch.normal[0, 1] - normal) < 1e-6
            assert abs(touch.speed[0] - v) < (1 + n) * g * h
            assert abs(touch.impulse[0] - m * (1 + e) * v) < (1 + n) * m * (1 + e) * g * h
            assert abs(touch.began[0] - t) < (1 + n) * 2 * h and abs(touch.ended[0] - touch.began[0] - h) < 0.6 * h
            assert abs(touch.point[0, 1] - height) < v * h


@pytest.mark.slow
def test_a_frame_sums_up_the_events_of_its_substeps(world):
    # 400 discs, of which the lowest are fixed, in frames of a substep beside frames of 6. Impulses are sums, speeds maxima. What
    # begins and what ends within a frame is told, with the times at the ends of the substeps.
    rng, h = np.random.default_rng(2), 1 / 400
    x, mass = 0.2 * np.stack(np.divmod(np.arange(400), 20), axis=1), 1.0 + rng.uniform(size=400)
    mass[x[:, 1] == 0] = np.inf
    start = tv.Particles(x, radius=rng.uniform(0.08, 0.1, 400), mass=mass, velocity=rng.uniform(-0.2, 0.2, (400, 2)))
    single, whole = (flat(world, start, substeps=k) for k in (1, 6))
    for feature in (*single.features[1:], *whole.features[1:]):
        feature.restitution = 0.0  # so that some contacts last
    before, counts = set(), np.zeros(4, dtype=int)
    for _ in range(5):
        known, impulses, speeds, first, last = before, {}, {}, {}, {}
        for s in range(6):
            single.step(h)
            events = single.events()
            got = events.touches[np.isnan(events.touches.ended)]
            now = rows(got.pairs)
            assert rows(events.begun.pairs) == now - before and rows(events.ended.pairs) == before - now
            for pair, impulse, speed in zip(map(tuple, got.pairs.tolist()), got.impulse, got.speed, strict=True):
                impulses[pair], speeds[pair] = impulses.get(pair, 0.0) + impulse, max(speeds.get(pair, 0.0), speed)
                last[pair] = s
                if pair not in known:
                    first.setdefault(pair, s)
            before = now
        whole.step(6 * h)
        events, begin = whole.events(), whole.time - 6 * h
        touches, pairs = events.touches, [*map(tuple, events.touches.pairs.tolist())]
        assert pairs == sorted({*impulses, *known}) and rows(events.begun.pairs) == {*first}
        assert rows(events.ended.pairs) == ({*first} | known) - before and rows(events.lasting.pairs) == known & before
        np.testing.assert_allclose(touches.impulse, [impulses.get(p, 0.0) for p in pairs], atol=1e-9)
        np.testing.assert_allclose(touches.speed, [speeds.get(p, 0.0) for p in pairs], atol=1e-9)
        np.testing.assert_allclose(touches.began, [begin + (first[p] + 1) * h if p in first else np.nan for p in pairs])
        ends = [np.nan if p in before else begin + (last.get(p, -1) + 2) * h for p in pairs]
        np.testing.assert_allclose(touches.ended, ends)
        counts += [
            *map(len, (events.begun, events.ended, events.lasting)),
            len(rows(events.begun.pairs) & rows(events.ended.pairs)),
        ]
    assert (counts > [60, 30, 10, 5]).all(), counts


@pytest.mark.slow
def test_sensors_note_what_overlaps_and_touch_nothing(world):
    # Sensors report the pairs that overlap at the current positions. They are larger, and some are fixed. A clone goes on alike.
    x = (np.stack(np.meshgrid(*[np.arange(9)] * 2, indexing="ij"), axis=-1).reshape(-1, 2) + 0.5) / 9 * 1.9 - 0.95
    k = np.arange(len(x))
    group = np.where(k % 10 == 9, 7, 0)
    start = tv.Particles(x, radius=np.where(group == 7, 0.1, 0.05), group=group, pinned=np.flatnonzero(k % 20 == 19))
    w = flat(world, start, 5.0, 1.0, substeps=5)
    radius, free = w.particles.radius, ~w.particles.pinned
    i, j = np.triu_indices(len(w.particles), 1)
    some = (group[i] != group[j]) & (free[i] | free[j])
    i, j, count = i[some], j[some], 0
    for _ in range(40):
        w.step(1 / 60)
        seen, x = w.events(groups=[(7, 0)]).touches, w.position
        inside = np.linalg.norm(x[i] - x[j], axis=1) < radius[i] + radius[j]
        np.testing.assert_array_equal(seen.pairs[np.isnan(seen.ended)], np.stack([i, j], axis=1)[inside])
        assert (seen.impulse == 0).all() and np.ptp(group[w.contacts.pairs], axis=1).max(initial=0) == 0
        count += len(seen)
    assert count > 20 and len(w.events()) > len(w.events([(0, 0), (7, 7)])) > 0
    with w.clone() as copy:
        assert not len(copy.events()) and not len(copy.wall_events())
        for one in (w, copy):
            one.step(1 / 60)
        assert equal(copy.events(), w.events()) + equal(copy.wall_events(), w.wall_events()) > 20


@pytest.mark.slow
def test_each_pair_that_begins_ends(world):
    # Whatever is removed: sum of begun - ended = pairs that touch now, by groups, too; in a clone made after the edit as well.
    start = tv.Particles(
        [(0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -98.9)], radius=[1.0, *[0.1] * 4], group=[7, 0, 1, 0, 0], pinned=[0]
    )
    w = flat(world, start, 1e-3)
    inside, told = np.zeros(3, dtype=int), lambda: (w.events(), w.events([(0, 7)]), w.wall_events())
    for gone, left in (((), (3, 2, 1)), ((1, 1), (1, 1, 1)), ((2,), (1, 1, 0)), ((0,), (0, 0, 0))):
        for i in gone:  # one by one
            w.remove([i])
        assert len(gone) < 2 or not len(w.events().ended)  # they end in the next frame
        with w.clone() as twin:
            w.step(1 / 60)
            twin.step(1 / 60)
            equal(twin.events(), w.events())
        inside += [len(e.begun) - len(e.ended) for e in told()]
        np.testing.assert_array_equal(inside, left)
        if len(gone) == 2:
            ended = w.events().ended
            assert rows(ended.pairs) == {(0, -1)} and ended.groups.tolist() == [[7, 0], [7, 1]] and (ended.impulse == 0).all()
            np.testing.assert_allclose(ended.point, [[0.7, 0.0], [-0.7, 0.0]], atol=1e-6)


@pytest.mark.slow
def test_a_corner_presses_from_both_sides(world):
    # The sum of impulses along normals is the change of momentum: m a dt for a particle that leans into a corner of one wall,
    # -(1 + e) m v for one that flies into it within a frame.
    a, v, m = np.array((-6.0, -8.0)), np.array((-24.0, -21.0)), 2.0
    beside = dict(radius=[0.1, 0.2], mass=[m, 1.0], pinned=[1])  # a disc in the middle, as others have: they share kernels
    lean = flat(world, tv.Particles([(-8.9, -8.9), (0, 0)], **beside), g=a, wide=9.0)
    lean.run(0.5)
    fly = flat(world, tv.Particles([(-8.7, -8.75), (0, 0)], velocity=[v, 0 * v], **beside), g=0 * a, wide=9.0)
    fly.step(1 / 60)
    for w, want in (lean, -m * a / 60), (fly, -(1 + BOUNCE) * m * v):
        touches = w.wall_events().touches
        assert rows(touches.pairs) == {(0, 2)}
        np.testing.assert_allclose(touches.impulse[0] * touches.normal[0], want, rtol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(touches.normal, axis=1), 1, rtol=1e-12)


def test_wrong_arguments_of_events_are_refused(world):
    w = world(tv.Particles([(0.0, 0.0)], radius=0.1), [tv.Contact()])
    for make, error, says in (
        (lambda: tv.Contact(groups=[(1, 0)], sensors=[(0, 1)]), ValueError, r"groups has \(0, 1\).* sensors"),
        (lambda: tv.Contact(sensors=[3]), TypeError, "sensors has 3, but a pair of groups"),  # type: ignore[list-item]
        (lambda: tv.Contact(friction={0: 0.5}), TypeError, "friction has the key 0, but"),  # type: ignore[arg-type]
        (lambda: tv.Contact(events=1), TypeError, "events = 1 is a int, but True or False"),  # type: ignore[arg-type]
        (lambda: tv.HalfSpace((0, 1), events="yes"), TypeError, "HalfSpace: events = 'yes'"),  # type: ignore[arg-type]
        (lambda: w.events(), RuntimeError, r"World.events: .*tv.Contact\(events=True\)"),
        (lambda: w.wall_events(), RuntimeError, "World.wall_events: no wall"),
    ):
        with pytest.raises(error, match=says):
            make()
