"""Every pair and wall knows the load that it bears, as statics says."""

import re

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


@pytest.mark.parametrize("weight", [0.02, 2.0])
@pytest.mark.parametrize("alpha, steps", [(5e-6, 13), (1e-5, 9), (3e-5, 5), (3e-4, 2), (3e-3, 2)])
def test_the_loads_of_a_prestressed_soft_net_are_those_of_its_lengths(world, alpha, steps, weight):
    # Each link bears (length - rest) / alpha at rest. Jacobi adds W h^2 / 4 to the compliance: its loads are a fifth too small at
    # 3e-4 and 2 % at 3e-3. Five steps of conjugate gradients are off by a fifth at 5e-6, where their floor is softer, and by 4 %
    # beside a heavy particle.
    net = tv.shapes.net((0, 0, 0), (1, 0, 0), (0, 1, 0), points=(13, 13))
    rim = (np.abs(net.position[:, :2] - 0.5) > 0.4999).any(axis=1)
    links = net.links[~rim[net.links].all(axis=1)]
    rest = 0.97 * np.linalg.norm(np.diff(net.position[links], axis=1)[:, 0], axis=1)
    mass = np.where(np.arange(169) == 84, weight, 0.02)
    start = tv.Particles(net.position, mass=mass, pinned=np.flatnonzero(rim))
    w = world(start, [tv.Gravity((0, 0, -9.81)), tv.Distance(links, rest, compliance=alpha), tv.Drag(8.0)])
    assert f"ConjugateGradient(steps={steps})" in w.explain()
    w.run(3.0)
    length = np.linalg.norm(np.diff(w.position[links], axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(w.features[1].load, (length - rest) / alpha, rtol=0.02)


def stretched(world, alpha, strain, **settings):
    """Return a net of 81 points that is stretched between pins."""
    net = tv.shapes.net((0, 0, 0), (1, 0, 0), (0, 1, 0), points=(9, 9))
    rim = (np.abs(net.position[:, :2] - 0.5) > 0.4999).any(axis=1)
    links = net.links[~rim[net.links].all(axis=1)]
    start = tv.Particles(net.position, mass=0.02, pinned=np.flatnonzero(rim))
    held = tv.Distance(links, 0.125 / (1 + strain), compliance=alpha)
    return world(start, [held, tv.Drag(8.0)], **settings)


def test_jacobi_is_chosen_for_springs_that_bear_their_loads_to_a_hundredth(world):
    # It is off by W h^2 / (4 alpha), a hundredth where alpha = 25 W h^2 = 6.9e-3.
    for alpha, least, most in ((6.5e-3, 0.0, 1e-5), (7.5e-3, 0.005, 0.01)):
        w = stretched(world, alpha, 0.03)
        w.run(0.1)
        links = w.features[0]
        off = 1 - links.load * alpha / (0.125 - links.rest)
        assert least <= abs(off).min() and abs(off).max() <= most, alpha


def test_springs_that_a_solver_softens_are_told(world):
    # A pass of Jacobi adds A W h^2 to the compliance, 23 % of 3e-4 at 20 substeps. The note tells how many substeps take that
    # to less than 5 %. What is off by less than 1e-4 of a length does not count.
    def told(substeps=20, strain=0.03, **settings):
        settings = {"solver": tv.Jacobi(), **settings}
        w = stretched(world, 3e-4, strain, substeps=substeps, **settings)
        report, copies = w.run(0.1), tv.Worlds(w, 2)
        assert ("softened" in report.flags) == ("softened" in copies.step(1 / 60).flags)
        copies.close()
        return report

    report = told()
    assert report.flags == {"softened"} and "by 23" in report.notes[0]
    need = int(re.findall(r"Use about (\d+) substeps", report.notes[0])[0])
    assert "softened" in told(need - 6).flags and told(need).clean and need == 44
    assert told(solver=None).clean and told(strain=3e-4).clean and "softened" in told(strain=8e-4).flags
