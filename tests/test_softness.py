"""Frames of uneven length, as where a loop measures dt: links keep the stiffness that they have in the longest ones."""

import numpy as np
import pytest

import tiverlet as tv

G, SUBSTEPS = 9.81, 8


def net(world, solver=None, iterations=1, drag=1.0, **settings):
    """Return a net of 11 x 11 in 2D that hangs by its upper corners."""
    shape = tv.shapes.net((0, 0), (1, 0), (0, 1), points=(11, 11))
    corners = np.flatnonzero((shape.position[:, 1] == 1) & np.isin(shape.position[:, 0], (0, 1)))
    particles = tv.Particles(shape.position, mass=0.01, pinned=corners)
    features = [tv.Gravity(G), tv.Distance(shape.links), tv.Drag(drag)]
    return world(particles, features, solver=solver, iterations=iterations, substeps=SUBSTEPS, **settings)


def cloth(world):
    """Return a cloth in 3D that hangs by two corners."""
    shape = tv.shapes.cloth((0, 0, 1), (1, 0, 0), (0, 1, 0), points=(9, 9))
    features = [tv.Gravity((0, 0, -G)), tv.Distance(shape.links), tv.Drag(1.0)]
    return world(tv.Particles(shape.position, mass=0.01, pinned=[0, 8]), features, substeps=SUBSTEPS)


def rope(world):
    """Return a rope that Jacobi solves, with its first particle held by a spring."""
    shape = tv.shapes.rope((0, 0), (2, 0), points=20)
    features = [tv.Gravity(G), tv.Rope(shape.links), tv.Drag(1.0), tv.Pin([0], (0.0, 0.0), compliance=1e-6)]
    return world(tv.Particles(shape.position, mass=0.01), features, solver=tv.Jacobi(), substeps=SUBSTEPS)


def beam(world):
    """Return a beam of rigid squares that share their corners."""
    x = 0.1 * np.stack([np.arange(27) % 9, np.arange(27) // 9], axis=1)
    squares = [[9 * j + i + k for k in (0, 1, 9, 10)] for i in range(8) for j in range(2)]
    features = [tv.Gravity(G), tv.ShapeMatch(squares), tv.Drag(1.0)]
    return world(tv.Particles(x, mass=0.05, pinned=[0, 9, 18]), features, substeps=SUBSTEPS)


def truss(world):
    """Return a braced block on the ground, of discs."""
    at = np.arange(20).reshape(4, 5)
    steps = [(at[:, 1:], at[:, :-1]), (at[1:], at[:-1]), (at[1:, 1:], at[:-1, :-1]), (at[1:, :-1], at[:-1, 1:])]
    links = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in steps])
    x = 0.1 * np.stack([np.arange(20) % 5, np.arange(20) // 5 + 0.5], axis=1)
    features = [tv.Gravity(G), tv.Distance(links), tv.Contact(), tv.HalfSpace((0, 1), friction=0.5), tv.Drag(1.0)]
    return world(tv.Particles(x, mass=0.05, radius=0.02), features, substeps=SUBSTEPS)


SCENES = {
    "net, Chebyshev": lambda world: net(world, tv.Chebyshev(), 4),
    "cloth": cloth,
    "rope": rope,
    "beam": beam,
    "truss": truss,
}


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_what_hangs_or_stands_comes_to_rest(world, scene):
    # Frames differ by up to a fifth. At a start, velocities lack half a kick of the old substep, so what is at rest gets
    # g (h - h_old) / 2, and moves by less than g (h_max - h_min). If stiffness changed with h, it would be 50 times as fast.
    w = SCENES[scene](world)
    rng, fastest = np.random.default_rng(0), []
    for frame in range(900):
        report = w.step(rng.uniform(0.8, 1.2) / 60)
        assert "energy-gain" not in report.flags
        if frame >= 780:
            fastest.append(np.sqrt(2 * tv.measure.kinetic_energy(w) / w.particles.mass[w.particles.inv_mass > 0].sum()))
    assert np.mean(fastest) < G * 0.4 / 60 / SUBSTEPS


@pytest.mark.slow
@pytest.mark.parametrize("solver, iterations", [(None, 1), (tv.Jacobi(), 1)], ids=repr)
def test_a_net_rests_where_it_does_in_the_longest_frames(world, solver, iterations):
    # s W h^2 is that of the longer frames, and so is the sag s W h^2 F, but for less than a move g h^2 k of row k in a substep.
    long, short, turns = (net(world, solver, iterations, drag=3.0, precision="f64") for _ in range(3))
    for _ in range(240):
        long.step(1 / 40)
        turns.step(1 / 60)
        turns.step(1 / 40)
    short.run(6.0)
    off, sag = (np.abs(each.position - long.position).max() for each in (turns, short))
    assert off < 11 * G / (40 * SUBSTEPS) ** 2 + 0.02 * sag and sag > 5e-3
    # In even frames it is lifted to where it rests in these, without a jerk: no faster than in its sag within the time constant.
    speeds = []
    for _ in range(720):
        turns.step(1 / 60)
        speeds.append(np.abs(turns.velocity).max())
    assert np.abs(turns.position - short.position).max() < 0.02 * sag and turns._clock.softness == 1
    assert max(speeds[60:]) < 2 * sag + G / 60 / SUBSTEPS


@pytest.mark.slow
def test_uneven_frames_lend_no_energy_to_what_swings(world):
    # An undamped net that is let go level, in frames of which a slow machine makes some longer. Links stiffen after these.
    # They do so slowly, and only while the net, with what links store, has less energy than at the start.
    shape = tv.shapes.net((0, 0), (1, 0), (0, -1), points=(9, 9))
    x = np.stack([shape.position[:, 0], 0 * shape.position[:, 0], -shape.position[:, 1]], axis=1)
    start = tv.Particles(x, mass=0.01, pinned=np.flatnonzero((x[:, 2] == 0) & np.isin(x[:, 0], (0, 1))))
    for solver, substeps in ((tv.ConjugateGradient(5), SUBSTEPS), (tv.Jacobi(), 2)):
        w = world(start, [tv.Gravity((0, -G, 0)), tv.Distance(shape.links)], solver=solver, substeps=substeps)
        for frame in range(600):
            report = w.step(1 / 30 if frame % 240 == 0 else 1 / 60)
            assert report.energy < 1e-3 * 0.81 * G and "energy-gain" not in report.flags


def test_the_softness_is_part_of_the_state(world):
    # A clone, a world among many and one that was reset go on with the same bits.
    dts = np.random.default_rng(1).uniform(0.8, 1.2, 30) / 60
    w = net(world, tv.Jacobi())
    many = tv.Worlds(net(world, tv.Jacobi()), 2)
    for dt in dts:
        w.step(dt)
        many.step(dt)
    assert w._clock.softness > 1
    with w.clone() as twin:
        assert (twin.velocity == w.velocity).all() and twin.step(1 / 70) == w.step(1 / 70) and twin.hash() == w.hash()
    many.step(1 / 70)
    w.run(2.0)
    many.run(2.0)
    np.testing.assert_array_equal(many.position[1], w.position)
    many.reset([1])
    again = net(world, tv.Jacobi())
    for dt in dts[10:]:
        again.step(dt)
        many.step(dt)
    np.testing.assert_array_equal(many.position[1], again.position)


def braced(n, height):
    """Return the corners of a braced beam of n by 2, and its links."""
    at = np.arange(2 * n).reshape(n, 2)
    steps = [(at[1:], at[:-1]), (at[:, 1:], at[:, :-1]), (at[1:, 1:], at[:-1, :-1]), (at[1:, :-1], at[:-1, 1:])]
    x = 0.25 * np.stack([np.arange(2 * n) // 2, np.arange(2 * n) % 2], axis=1) + [0.0, height]
    return x, np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in steps])


def sheet(world, solver=None):
    """Return a taut net between four pins, and m g L."""
    shape = tv.shapes.net((0, 0, 0), (1, 0, 0), (0, 1, 0), points=(7, 7))
    corners = np.flatnonzero(np.isin(shape.position, (0, 1))[:, :2].all(axis=1))
    features = [tv.Gravity((0, 0, -G)), tv.Distance(shape.links), tv.Drag(0.0)]
    return world(tv.Particles(shape.position, mass=0.02, pinned=corners), features, solver=solver or tv.Jacobi()), 0.98 * G


def block(world):
    """Return braced beams that fall on the ground and on each other, and m g L."""
    (x, links), (y, more) = braced(8, 0.5), braced(8, 1.1)
    features = [tv.Gravity(G), tv.Distance(np.concatenate([links, more + 16])), tv.HalfSpace((0, 1)), tv.Contact(friction=0.3)]
    return world(tv.Particles(np.concatenate([x, y + [0.1, 0]]), mass=0.1, radius=0.05), features), 3.2 * G * 2


def jelly(world, *features):
    """Return clusters that share their corners and fall on the ground, and m g L."""
    x = 0.2 * np.stack([np.arange(25) // 5, np.arange(25) % 5 + 2.5], axis=1)
    squares = [[5 * i + j + k for k in (0, 1, 5, 6)] for i in range(4) for j in range(4)]
    features = [tv.Gravity(G), tv.ShapeMatch(squares), tv.HalfSpace((0, 1)), *features, tv.Drag(0.0)]
    return world(tv.Particles(x, mass=0.1, radius=0.05), features), 2.5 * G


def weight(world):
    """Return a chain that Jacobi solves, with a weight of 200 links, and m g L."""
    x = np.stack([0.05 * np.arange(25), np.zeros(25)], axis=1)
    features = [tv.Gravity(G), tv.Distance(np.stack([np.arange(24), np.arange(1, 25)], axis=1)), tv.Drag(0.0)]
    return world(tv.Particles(x, mass=[0.05] * 24 + [10.0], pinned=[0]), features, solver=tv.Jacobi()), 11.2 * G * 1.2


def taut(world):
    """Return straight ropes between two pins, and m g L."""
    ropes = [tv.shapes.rope((0, y), (1, y), points=n) for y, n in ((0, 5), (1, 40))]
    features = [tv.Gravity(G), tv.Distance(np.concatenate([ropes[0].links, ropes[1].links + 5])), tv.Drag(0.0)]
    x = np.concatenate([rope.position for rope in ropes])
    return world(tv.Particles(x, mass=0.1, pinned=[0, 4, 5, 44]), features, solver=tv.Jacobi()), 4.1 * G


def pinned(world):
    """Return a rope of springs on a stiff pin, and m g L."""
    shape = tv.shapes.rope((0, 0), (1, 0), points=11)
    features = [tv.Gravity(G), tv.Distance(shape.links, compliance=1e-5), tv.Pin([0], compliance=1e-6)]
    return world(tv.Particles(shape.position, mass=0.1), features, solver=tv.Jacobi()), 1.1 * G


PASSIVE = {
    "net": sheet, "net by gradients": lambda world: sheet(world, tv.ConjugateGradient(5)),
    "ropes": taut, "beams among contacts": block, "jelly": jelly, "weight": weight, "springs": pinned,
    "jelly among contacts": lambda world: jelly(world, tv.Contact(friction=0.3)),
}  # fmt: skip
DRAWN = np.random.default_rng(0).random(60)
SCHEDULES = {
    "random": lambda k: (int(64 ** DRAWN[k]), 1 / 60),
    "in turns": lambda k: ([2, 32, 5, 17, 1, 64][k // 10 % 6], 1 / 60),
    "once": lambda k: (2 if k < 30 else 64, 1 / 60),
    "auto": lambda k: ("auto", 1 / 60),
    "uneven": lambda k: (8, 4 ** (DRAWN[k] - 0.5) / 60),
    "a hitch": lambda k: (8, 0.1 if k == 30 else 1 / 60),
}


@pytest.mark.slow
@pytest.mark.parametrize("scene", PASSIVE)
def test_no_schedule_of_substeps_brings_in_energy(world, scene):
    # Passive scenes never have more energy than at the start, however many substeps frames have and however long they are, to
    # 1e-3 m g L. With the stiffness of each substep instead, the net gains up to 800 m g L, and jelly among contacts 5 m g L.
    # A clone made anywhere on the way goes on with the same bits: all that the future depends on is part of the state.
    w, size = PASSIVE[scene](world)
    x, v = w.position, w.velocity
    for name, schedule in SCHEDULES.items():
        w.position, w.velocity, start = x, v, None
        for k in range(60):
            w.substeps, dt = schedule(k)
            twin = w.clone() if k % (20 if name == "random" else 60) == 8 else None
            energy = w.step(dt).energy
            if twin:
                twin.step(dt)
                assert twin.hash() == w.hash(), (name, k)
                twin.close()
            start = w._clock.bound if start is None else start
            assert energy < start + 1e-3 * size, (name, k, (energy - start) / size)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["net", "jelly", "weight"])
def test_what_sags_rests_where_it_would_after_a_change(world, scene):
    # 1 / 32 of the substep makes the sag 1 / 1000; some seconds later nothing tells that it was larger.
    w, _ = PASSIVE[scene](world)
    w.features[-1].rate = 5.0
    x, ends = w.position, []
    for before in (2, 64):
        w.position, w.velocity = x, np.zeros_like(x)
        w.substeps = before
        w.run(3.0)
        w.substeps = 64
        w.run(9.0)
        ends.append(w.position)
    np.testing.assert_allclose(*ends, atol=2e-3)
