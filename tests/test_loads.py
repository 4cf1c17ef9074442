"""Every pair and wall knows the load that it bears, as statics says; links may know theirs, and hold it without stretch."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.impulses import MET

G, R = 10.0, 0.5
LOADS = 2 * MET  # of a load: what passes of contacts without friction leave of it


def smooth(world, x, mass, pinned=(), high=(99.0, 99.0), **settings):
    """Return a world with smooth discs of these masses in a box."""
    particles = tv.Particles(x, radius=R, mass=mass, pinned=pinned)
    features = [tv.Gravity(G), tv.Contact(), tv.Box((0, 0), high, events=True)]
    return world(particles, features, precision="f64", **settings)


@pytest.mark.slow
def test_each_contact_of_a_pyramid_bears_what_statics_says(world):
    # 55 discs in rows of 10 to 1, with gaps in a row and the lowest row pinned: 90 contacts. The 45 free discs give as many
    # equations, sum f n = m g. The normals are taken from the pile at rest.
    rows, apart = 10, 1.02
    up = np.sqrt(1 - (apart / 2) ** 2)
    x = np.concatenate([np.stack([apart * (np.arange(rows - r) + r / 2), np.full(rows - r, r * up)], 1) for r in range(rows)])
    mass = np.random.default_rng(0).uniform(1, 2, len(x))
    w = smooth(world, (1 + 1e-9) * x + 2.0, mass, range(rows), substeps=8)  # scaled so that none overlap at the start
    w.run(20.0)
    found, free = w.contacts, np.arange(len(x)) >= rows
    forces, c = np.zeros((len(x), 2, len(found))), np.arange(len(found))
    forces[found.pairs[:, 0], :, c] = found.normal
    forces[found.pairs[:, 1], :, c] = -found.normal
    weight = np.stack([0 * mass, G * mass], axis=1)[free]
    borne = np.linalg.solve(forces[free].reshape(weight.size, -1), weight.ravel())
    np.testing.assert_allclose(found.impulse * 480, borne, atol=LOADS * borne.max())


def hung(n=10):
    """Return a chain of n links of 0.1 m that hangs from a pin, and the pairs of its links."""
    x = np.stack([np.zeros(n + 1), -0.1 * np.arange(n + 1)], axis=1)
    return tv.Particles(x, mass=0.2, pinned=[0]), np.stack([np.arange(n), np.arange(1, n + 1)], axis=1)


def hanging(world, particles, links, g=G, rate=1.0, known=True, precision="f64", **settings):
    """Return a world of links that may break, with drag: one structure for all tests of links."""
    features = [tv.Gravity(g), links, tv.Drag(rate)]
    return world(particles, features, solver=tv.Jacobi(loads=known), precision=precision, **settings)


@pytest.mark.parametrize("kind, precision, substeps", [(tv.Distance, "f64", 4), (tv.Rope, "f32", 16)])
def test_what_hangs_is_not_stretched(world, kind, precision, substeps):
    # The k-th link from below bears k m g. One pass bears it by a violation W h^2 k m g = 4 k g h^2; a known load needs none.
    particles, pairs = hung()
    links = kind(pairs, 0.1, break_at=1e3)
    w = hanging(world, particles, links, precision=precision, substeps=substeps)
    highest = max(w.step(1 / 60).energy for _ in range(900))
    rounding = 0.2 * 2.0**-24 * (60 * substeps) ** 2 if precision == "f32" else 0.0  # of positions of 1 m: m ulp / h^2
    np.testing.assert_allclose(links.load, 0.2 * G * np.arange(10, 0, -1), rtol=1e-3, atol=rounding)
    sag = 4 * 10 * G / (60 * substeps) ** 2
    stretch = np.linalg.norm(np.diff(w.position, axis=0), axis=1) - 0.1
    assert np.abs(stretch).max() < 1e-3 * sag
    # Energy never rises above the start, and known loads break links, too.
    assert highest <= -0.2 * G * 0.1 * 55 + 1e-5
    for most in (10.5, 9.5):
        links.break_at = most * 0.2 * G
        w.step(1 / 60)
        assert links.broken.tolist() == [most < 10] + 9 * [False]


def test_links_that_contradict_each_other_learn_nothing(world):
    # Ten links of 0.095 m between pins 1 m apart contradict each other: no load removes their violations C, 0.05 m in all. Their
    # pulls C / (W h^2) are equal. W = 4 w, but 2 w for links at a pin, whose violation is half of the others', 0.05 / 9.
    x = np.stack([np.linspace(0, 1, 11), np.zeros(11)], axis=1)
    links = tv.Distance(hung()[1], 0.095, break_at=1e3)
    w = hanging(world, tv.Particles(x, mass=0.2, pinned=[0, 10]), links, g=0.0)
    w.run(8.0)
    lengths = 0.095 + 0.05 / 9 * np.r_[0.5, np.ones(8), 0.5]
    np.testing.assert_allclose(w.position[1:, 0], np.cumsum(lengths), atol=1e-9)


def test_a_start_finds_the_loads_that_links_know(world):
    # Assigned velocities make a start: in the next substep forces act for half a kick, and so do loads. If all particles are
    # moved by the same vector, links keep their known loads. If one particle is moved, its own links drop theirs.
    particles, pairs = hung()
    links = tv.Distance(pairs, 0.1, break_at=1e3)
    w = hanging(world, particles, links, substeps=8)
    w.run(15.0)
    height = w.position[10, 1]
    for change in (lambda: setattr(w, "velocity", 0 * w.position), lambda: setattr(w, "position", w.position + [3.0, 0.0])):
        change()
        for _ in range(30):
            w.step(1 / 60)
        assert w.position[10, 1] == pytest.approx(height, abs=1e-6)
        np.testing.assert_allclose(links.load, 0.2 * G * np.arange(10, 0, -1), rtol=1e-3)
    known = w._runner.memory.read(links.dev.known.load)[:10]
    moved = w.position.copy()
    moved[10, 0] += 0.05
    w.position = moved
    forgotten = w._runner.memory.read(links.dev.known.load)[:10]
    assert forgotten[9] == 0.0 and (forgotten[:9] == known[:9]).all() and (known > 0).all()
