"""Contact events: against closed forms, against NumPy's results from positions, and against momentum."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import SLOP
from tiverlet.step import edit_in_place

COLUMNS = ("pairs", "groups", "point", "normal", "impulse", "speed", "began", "ended")


def equal(one, two):
    """Assert that two sets of events are equal bit for bit; return their number."""
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(one.touches, name), getattr(two.touches, name))
    return len(one)


def rows(pairs):
    """Return pairs as a set."""
    return {tuple(map(int, pair)) for pair in pairs}


def flat(world, start, g=9.81, wide=99.0, more=(), **settings):
    """Build a 2D world in a box that records events; all such worlds share one structure."""
    features = [tv.Gravity(g), tv.Contact(events=True), tv.Box([-wide] * 2, [wide] * 2, events=True), *more]
    return world(start, features, precision="f64", **settings)


def bouncing(world, start, e=1.0, g=0.0, floor=0.0, **settings):
    """Build a 3D world above a floor."""
    walls = [tv.HalfSpace((0, 1, 0), floor, restitution=1.0, events=True)]
    w = world(start, [tv.Gravity(g), tv.Contact(restitution=1.0, events=True), *walls], precision="f64", **settings)
    w.features[1].restitution = w.features[2].restitution = e
    return w


def balls(x, v=0.0, m=1.0):
    """Return balls, the first of which cannot move."""
    return tv.Particles(
        x, velocity=v, radius=np.r_[0.05 + 1e-12, np.full(len(x) - 1, 0.05)], mass=np.r_[np.inf, np.full(len(x) - 1, m)]
    )


@pytest.mark.slow
def test_a_bouncing_ball(world):
    # Dropped from H onto a static ball, and onto a floor: after k bounces v_k = e^k sqrt(2 g H), at
    # t_k = t_0 (1 + 2 (e + ... + e^k)). A bounce takes less than two substeps, so each begins and ends in the same frame. The
    # speed of approach is taken at the middle of a substep, off by g h / 2 at most. The speed of departure follows from the
    # previous bounce, which adds up to e g h per bounce.
    H, e, g, m, r, frame, substeps = 0.5, 0.8, 9.81, 2.0, 0.05, 1 / 60, 20
    h = frame / substeps
    w = bouncing(world, balls([[0.0, 0, 0], [0, 2 * r + H, 0], [1, r + H, 0]], m=m), e, g, substeps=substeps)
    seen, t0, v0 = [[], []], np.sqrt(2 * H / g), np.sqrt(2 * g * H)
    for _ in range(120):
        w.step(frame)
        for k, events in enumerate((w.events(), w.wall_events())):
            assert rows(events.begun.pairs) == rows(events.ended.pairs) == rows(events.touches.pairs) and not len(events.lasting)
            seen[k] += [events.touches] if len(events) else []
    for k, (pair, normal, height) in enumerate((((0, 1), -1, r), ((2, 2), 1, 0.0))):
        assert len(seen[k]) == 5
        for n, touch in enumerate(seen[k]):
            v, t = e**n * v0, t0 * (1 + 2 * sum(e**i for i in range(1, n + 1)))
            assert rows(touch.pairs) == {pair} and abs(touch.normal[0, 1] - normal) < 1e-6
            assert abs(touch.speed[0] - v) < (1 + n) * g * h
            assert abs(touch.impulse[0] - m * (1 + e) * v) < (1 + n) * m * (1 + e) * g * h
            assert abs(touch.began[0] - t) < (1 + n) * 2 * h and abs(touch.ended[0] - touch.began[0] - h) < 0.6 * h
            assert abs(touch.point[0, 1] - height) < v * h


def cloud(dim, n, seed):
    """Return discs or spheres of different sizes and masses above static ones, too slow for impacts to be projected."""
    rng = np.random.default_rng(seed)
    m = int(np.ceil(n ** (1 / dim)))
    x = np.stack(np.meshgrid(*[np.arange(m)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)[:n] * 0.2
    mass = 1.0 + rng.uniform(size=n)
    mass[x[:, 1] == 0] = np.inf
    return tv.Particles(x, radius=rng.uniform(0.08, 0.1, n), mass=mass, velocity=rng.uniform(-0.2, 0.2, (n, dim)))


def brute(x, old, v, gravity, h, particles, before):
    """Return where free flight leads in a substep, which pairs touch there, their normals and speeds, and which are certain.

    Whether a pair has just met is uncertain where it had separated only by the last digit. before: pairs that touched in the last
    substep.
    """
    free = np.isfinite(particles.mass)[:, None]
    ahead = np.where(free, x + v * h + gravity * h**2 / 2 if old is None else 2 * x - old + gravity * h**2, x)
    i, j = np.triu_indices(len(x), 1)
    R = particles.radius[i] + particles.radius[j]
    some = (np.linalg.norm(ahead[i] - ahead[j], axis=1) < R) & (free[i] | free[j])[:, 0]
    i, j, R = i[some], j[some], R[some]
    least = np.minimum(particles.radius[i], particles.radius[j])
    r, d = x[i] - x[j], (ahead - x)[i] - (ahead - x)[j]
    # |r + s d| = R gives the time of impact of a pair that was apart, and its normal then. Pairs that touch have that of before,
    # and those that nearly do.
    a, b, c = (d**2).sum(1), (r * d).sum(1), (r**2).sum(1) - R**2
    with np.errstate(all="ignore"):
        s = np.where(np.linalg.norm(r, axis=1) > R + SLOP * least, (-b - np.sqrt(b**2 - a * c)) / a, 0.0)
    s[[pair in before for pair in zip(i.tolist(), j.tolist(), strict=True)]] = 0.0
    n = r + s[:, None] * d
    n /= np.linalg.norm(n, axis=1)[:, None]
    return ahead, np.stack([i, j], axis=1), n, -(d * n).sum(1) / h, np.abs(c) > 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_what_brute_force_finds(world, dim):
    # With one substep per frame, x_(n+1) = 2 x_n - x_(n-1) + g h^2 (Verlet) gives free flight; the pairs that overlap there
    # touch. Their impulses along the normals are the whole deviation of particles from it: m (x_(n+1) - ahead) / h = sum J n.
    # Then the same in frames of 6 substeps, before velocities are first projected (after 32). Impulses are sums, speeds maxima.
    particles, h, gravity = cloud(dim, 400, dim), 1 / 400, np.zeros(dim)
    gravity[1] = -9.81
    build = flat if dim == 2 else lambda *given, **more: bouncing(*given, 0.0, 9.81, -99.0, **more)
    single, whole = (build(world, particles, substeps=k) for k in (1, 6))
    old, before, counts = None, set(), np.zeros(4, dtype=int)
    for _ in range(5):
        start, impulses, speeds, first, last, met = before, {}, {}, {}, {}, {}
        for s in range(6):
            x = single.position
            ahead, pairs, n, speed, clear = brute(x, old, particles.velocity, gravity, h, particles, before)
            single.step(h)
            events = single.events()
            got = events.touches[np.isnan(events.touches.ended)]
            now = rows(got.pairs)
            assert rows(events.begun.pairs) == now - before and rows(events.ended.pairs) == before - now
            assert rows(events.lasting.pairs) == now & before
            # What is struck may press on others that it would not reach by itself, and need not press on all that it would.
            place = {pair: k for k, pair in enumerate(rows_in(pairs))}
            known = [(k, place[pair]) for k, pair in enumerate(rows_in(got.pairs)) if pair in place and clear[place[pair]]]
            ours, theirs = np.array(known, dtype=int).reshape(-1, 2).T
            np.testing.assert_allclose(got.normal[ours], n[theirs], atol=1e-3)  # at the start, or where they meet
            pairs = got.pairs
            momentum = np.zeros_like(x)
            for k, sign in ((0, 1), (1, -1)):
                np.add.at(momentum, pairs[:, k], sign * got.impulse[:, None] * got.normal)
            free = np.isfinite(particles.mass)
            want = (single.position - ahead)[free] * particles.mass[free, None] / h
            np.testing.assert_allclose(momentum[free], want, atol=1e-9)
            for k, pair in enumerate(map(tuple, pairs.tolist())):
                impulses[pair] = impulses.get(pair, 0.0) + got.impulse[k]
                speeds[pair] = max(speeds.get(pair, 0.0), got.speed[k])
                met.setdefault(pair, got.normal[k])
                last[pair] = s
                if pair not in start:
                    first.setdefault(pair, s)
            meets = np.array([pair not in before for pair in rows_in(pairs)], dtype=bool)[ours]
            np.testing.assert_allclose(got.speed[ours], np.where(meets, np.maximum(speed[theirs], 0), 0), atol=1e-9)
            old, before = x, now
        whole.step(6 * h)
        np.testing.assert_allclose(whole.position, single.position, atol=1e-12)
        events = whole.events()
        assert rows_in(events.touches.pairs) == sorted({*impulses, *start})
        assert rows(events.begun.pairs) == {*first} and rows(events.ended.pairs) == ({*first} | start) - before
        assert rows(events.lasting.pairs) == start & before
        begin = whole.time - 6 * h
        for k, pair in enumerate(rows_in(events.touches.pairs)):
            row = events.touches[k : k + 1]
            np.testing.assert_allclose(row.impulse, impulses.get(pair, 0.0), atol=1e-9)
            np.testing.assert_allclose(row.speed, speeds.get(pair, 0.0), atol=1e-9)
            np.testing.assert_allclose(row.began, begin + (first[pair] + 1) * h if pair in first else np.nan)
            np.testing.assert_allclose(row.ended, np.nan if pair in before else begin + (last.get(pair, -1) + 2) * h)
            if pair in first:
                np.testing.assert_allclose(row.normal[0], met[pair], atol=1e-9)
        both = rows(events.begun.pairs) & rows(events.ended.pairs)
        counts += [len(events.begun), len(events.ended), len(events.lasting), len(both)]
    assert (counts > [60, 30, 10, 5]).all(), counts


def rows_in(pairs):
    """Return pairs as a list."""
    return [tuple(pair) for pair in pairs.tolist()]


def stage(world, sensing=True, events=True, **settings):
    """Build a world of discs with friction and restitution in a box, some of them sensors.

    Sensors have twice the size, and some of them are fixed.
    """
    x = (np.stack(np.meshgrid(*[np.arange(9)] * 2, indexing="ij"), axis=-1).reshape(-1, 2) + 0.5) / 9 * 1.9 - 0.95
    k = np.arange(len(x))
    group = np.where(k % 10 == 9, 3, 0)
    more = {"events": events, **({"sensors": [(0, 3)]} if sensing else {"groups": [(0, 0), (3, 3)]})}
    start = tv.Particles(x, radius=np.where(group == 3, 0.1, 0.05), group=group, pinned=np.flatnonzero(k % 20 == 19))
    return staged(world, start, events, **more, **settings)


def staged(world, start, walls, g=5.0, wide=1.0, events=False, sensors=(), groups=None, **settings):
    """Build a world of discs with friction and restitution in a box."""
    features = [tv.Gravity(g), tv.Box([-wide] * 2, [wide] * 2, restitution=0.3, events=walls)]
    features.append(tv.Contact(0.3, 0.4, events=events, sensors=sensors, groups=groups))
    return world(start, features, **({"substeps": 5, "precision": "f32-compensated"} | settings))


@pytest.mark.slow
def test_sensors_note_what_overlaps_and_touch_nothing(world):
    # The same bits as with groups that do not touch and without events. Sensors report the pairs that overlap at the current
    # positions, also without events of contacts: see where lists grow.
    w, plain = stage(world), stage(world, sensing=False, events=False)
    assert not any("event" in name or "touched" in name for name in plain.fields) and not len(w.events())
    with pytest.raises(RuntimeError, match=r"World.events: .*tv.Contact\(events=True\)"):
        plain.events()
    with pytest.raises(RuntimeError, match="World.wall_events: no wall"):
        plain.wall_events()
    group, radius, free = w.particles.group, w.particles.radius, ~w.particles.pinned
    i, j = np.triu_indices(len(w.particles), 1)
    some = (group[i] != group[j]) & (free[i] | free[j])
    i, j, count = i[some], j[some], 0
    for _ in range(40):
        assert w.step(1 / 60).contacts == plain.step(1 / 60).contacts
        seen, x = w.events(groups=[(3, 0)]).touches, w.position
        inside = np.linalg.norm(x[i] - x[j], axis=1) < radius[i] + radius[j]
        np.testing.assert_array_equal(seen.pairs[np.isnan(seen.ended)], np.stack([i, j], axis=1)[inside])
        assert (seen.impulse == 0).all()
        count += len(seen)
    assert count > 20 and w.hash() == plain.hash() and rows(w.contacts.pairs) == rows(plain.contacts.pairs)
    assert len(w.events()) > len(w.events([(0, 0), (3, 3)])) > 0


def test_a_heap_leans_on_what_is_below(world):
    # At rest, the weight above a place goes through the contacts and walls below it. During t, a disc of mass m transfers m g t
    # to a disc of 2 m below it, and the floor receives 3 m g t.
    m, g = 3.0, 9.81
    x = [[0.0, -98.9], [0.0, -98.6999], [9.0, 9.0]]
    w = flat(world, tv.Particles(x, radius=[0.1, 0.1, 0.11], mass=[2 * m, m, np.inf]))
    w.run(0.5)
    total = np.zeros(2)
    for _ in range(30):
        w.step(1 / 60)
        assert len(w.events().lasting) == len(w.events()) == 1 and w.events().touches.speed[0] == 0
        walls = w.wall_events().lasting
        assert rows(walls.pairs) == {(0, 2)} and len(w.wall_events()) == 1
        np.testing.assert_allclose(walls.point, [[0, -99]], atol=1e-4)
        total += w.events().touches.impulse[0], walls.impulse[0]
    np.testing.assert_allclose(total, [m * g / 2, 3 * m * g / 2], rtol=1e-3)


@pytest.mark.slow
def test_recorded_cloned_edited(world, tmp_path, monkeypatch):
    path = tmp_path / "events.rrd"
    w, count = stage(world), 0
    w.run(0.2)
    with tv.Recorder(path, w) as recorder:
        for _ in range(3):
            w.step(1 / 60)
            recorder.log()
    again, copy, many = tv.replay(path).world(3), w.clone(), tv.Worlds(w, 2)
    assert not len(copy.events()) and not len(copy.wall_events())
    for other in (again, copy, w, many):
        other.step(1 / 60)
    for other in (again, copy):
        count += equal(other.events(), w.events()) + equal(other.wall_events(), w.wall_events())
    for of_one in many.each(lambda world: (world.events(), world.wall_events())):
        count += equal(of_one[0], w.events()) + equal(of_one[1], w.wall_events())
    assert count > 20 and len(w.events().lasting)
    many.reset()
    assert not any(map(len, many.each(lambda world: world.events())))
    again.close()
    many.close()
    # Removed particles take their events along, and the others are renumbered. Touching pairs keep touching. The world is
    # rebuilt here; test_edit_in_place.py tests removal in place.
    monkeypatch.setattr(edit_in_place, "planned", lambda *_: None)
    before, walls = w.events(), w.wall_events()
    gone = [0, 7, int(before.touches.pairs[1, 0])]
    w.add(tv.Particles([[0.0, 3.0]], radius=0.05))
    number = np.delete(np.arange(len(w.particles)), gone)
    w.remove(gone)
    now, then = rows(number[w.events().touches.pairs]), rows(before.touches.pairs)
    assert now == {pair for pair in then if not {*pair} & {*gone}} < then
    assert rows(w.wall_events().touches.pairs) == {
        (int(np.searchsorted(number, i)), 1) for i, _ in rows(walls.touches.pairs) if i not in gone
    }
    touched = [rows(events.touches[np.isnan(events.touches.ended)].pairs) for events in (w.events(), w.wall_events())]
    w.step(1 / 60)
    for events, known in zip((w.events(), w.wall_events()), touched, strict=True):
        before = events.touches[np.isnan(events.touches.began)].pairs
        assert rows(before[(before >= 0).all(axis=1)]) == known != set()


@pytest.mark.slow
def test_each_pair_that_begins_ends(world):
    # Whatever is removed: sum of begun - ended = pairs that touch now, by groups, too; in a clone made after the edit as well.
    start = tv.Particles(
        [(0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -98.9)], radius=[1.0, *[0.1] * 4], group=[7, 0, 1, 0, 0], pinned=[0]
    )
    box = tv.Box([-99] * 2, [99] * 2, events=True)
    w = world(start, [tv.Gravity(1e-3), tv.Contact(sensors=[(0, 7), (1, 7)], events=True), box], precision="f64")
    inside = np.zeros(3, dtype=int)

    def count(of, *walls):
        pairs = [of.events(groups) for groups in (None, [(0, 7)])]
        inside[:] += [len(e.begun) - len(e.ended) for e in (*pairs, *(walls or (of.wall_events(),)))]
        return inside.tolist()

    w.step(1 / 60)
    assert count(w) == [3, 2, 1]
    w.remove([1])
    w.remove([1])  # the second disc of both removed, one by one
    twin = w.clone()
    assert not len(w.events().ended)  # they end in the next frame
    w.step(1 / 60)
    assert count(w) == [1, 1, 1]
    ended = w.events().ended
    assert rows(ended.pairs) == {(0, -1)} and ended.groups.tolist() == [[7, 0], [7, 1]] and (ended.impulse == 0).all()
    np.testing.assert_allclose(ended.point, [[0.7, 0.0], [-0.7, 0.0]], atol=1e-6)
    twin.step(1 / 60)
    equal(twin.events(), w.events())
    w.remove([2], [box])
    w.step(1 / 60)
    assert count(w, w._all_events()[1]) == [1, 1, 0]
    w.remove([0])
    w.step(1 / 60)
    assert count(w, w._all_events()[1]) == [0, 0, 0] and not len(w.events().lasting)
    w.step(1 / 60)
    assert count(w, w._all_events()[1]) == [0, 0, 0]


@pytest.mark.slow
def test_what_is_held_and_let_go(world):
    # Only the particle of a pair that can move writes it. When the other one is released, the pair continues as one contact.
    pin = tv.Pin([0], (0.0, -98.9))
    start = tv.Particles([[0.0, -98.9], [0.0, -98.6999], [9.0, 9.0]], radius=[0.1, 0.1, 0.11], mass=[2.0, 1.0, np.inf])
    w = flat(world, start, more=[pin])
    w.run(0.1)
    assert rows(w.events().lasting.pairs) == {(0, 1)}
    np.testing.assert_allclose(w.events().touches.normal, [[0, -1]], atol=1e-6)
    w.remove(features=[pin])
    for _ in range(2):
        w.step(1 / 60)
        assert rows(w.events().lasting.pairs) == {(0, 1)} and len(w.events()) == 1
        np.testing.assert_allclose(w.events().touches.impulse, 9.81 / 60, rtol=0.3)


@pytest.mark.slow
def test_a_corner_presses_from_both_sides(world):
    # The sum of impulses along normals is the change of momentum: m a dt for a particle that leans into a corner of one wall,
    # -m v for one that flies into it within a frame. If the first normal served for all of the impulse, a floor would bear 153
    # of 177 N in the corners of a box.
    a, v, m = np.array((-6.0, -8.0)), np.array((-24.0, -21.0)), 2.0
    beside = dict(radius=[0.1, 0.2], mass=[m, 1.0], pinned=[1])  # a disc in the middle, as others have: they share kernels
    lean = flat(world, tv.Particles([(-8.9, -8.9), (0, 0)], **beside), g=a, wide=9.0)
    lean.run(0.5)
    fly = flat(world, tv.Particles([(-8.7, -8.75), (0, 0)], velocity=[v, 0 * v], **beside), g=0 * a, wide=9.0)
    fly.step(1 / 60)
    for w, want in (lean, -m * a / 60), (fly, -m * v):
        touches = w.wall_events().touches
        assert rows(touches.pairs) == {(0, 2)}
        np.testing.assert_allclose(touches.impulse[0] * touches.normal[0], want, rtol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(touches.normal, axis=1), 1, rtol=1e-12)


@pytest.mark.slow
def test_nothing_is_lost_where_lists_grow(world):
    # 60 sensors, all within each other, and discs that fly through them in one frame: more pairs than there is room for at first.
    k = np.arange(60)
    x = np.concatenate([0.01 * tv.golden(k, dim=2), [[-3.0, 0.0], [3.5, 0.25]]])
    v = np.concatenate([np.zeros((60, 2)), [[120.0, 0.0], [-120.0, 0.0]]])
    group = np.where(np.arange(62) < 60, 1, 0)
    start = tv.Particles(x, radius=np.where(group, 0.5, 0.1), velocity=v, group=group, pinned=[59])
    w = staged(world, start, False, 0.0, 99.0, sensors=[(0, 1), (1, 1)], substeps=100)
    room = w._runner.search.list.room
    w.step(1 / 20)
    assert w._runner.search.list.room > room
    assert len(w.events([(1, 1)]).begun) == 60 * 59 // 2 and not len(w.events([(1, 1)]).ended)
    through = w.events([(0, 1)])
    assert rows(through.begun.pairs) == rows(through.ended.pairs) == {(i, j) for i in range(60) for j in (60, 61)}
    # A disc passes along a chord of a disc of radius 0.6 at 120 m/s. Times are those of substeps, where speeds are along the
    # normal.
    (i, j), began, ended = through.touches.pairs.T, through.touches.began, through.touches.ended
    r, chord = x[i] - x[j] - began[:, None] * v[j], 2 * np.sqrt(0.6**2 - (x[i, 1] - x[j, 1]) ** 2)
    np.testing.assert_allclose(ended - began, chord / 120, atol=1.01 / 2000)
    np.testing.assert_allclose(through.touches.speed, (r * v[j]).sum(1) / np.linalg.norm(r, axis=1), rtol=1e-4)


def test_a_world_without_particles_has_no_events(world):
    none = world(tv.Particles(np.zeros((0, 2)), radius=0.1), [tv.Contact(events=True, sensors=[(0, 1)])])
    none.step(1 / 60)
    assert not len(none.events()) and not len(none.events([(0, 1)]).begun)


def test_refused(world):
    with pytest.raises(ValueError, match=r"groups has \(0, 1\).* sensors"):
        tv.Contact(groups=[(1, 0)], sensors=[(0, 1)])
    with pytest.raises(TypeError, match="sensors has 3, but a pair of groups"):
        tv.Contact(sensors=[3])
    with pytest.raises(TypeError, match="restitution has the key 0, but a pair of groups"):
        tv.Contact(restitution={0: 0.5})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"friction has \(0, 1\) and \(1, 0\), the same groups, with two values"):
        tv.Contact(friction={(0, 1): 0.5, (1, 0): 0.6})
    tv.Contact(friction={(0, 1): 0.5, (1, 0): 0.5})
    with pytest.raises(TypeError, match="events = 1 is a int, but True or False"):
        tv.Contact(events=1)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="HalfSpace: events = 'yes'"):
        tv.HalfSpace((0, 1), events="yes")  # type: ignore[arg-type]
    w = stage(world)
    with pytest.raises(TypeError, match=r"World.events: groups has 3"):
        w.events([3])
