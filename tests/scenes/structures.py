"""Structures as people build them: weights on ropes, nets and cloth that are struck, beams, seams, what motors and wind drive."""

import numpy as np

import tiverlet as tv

from .scene import c, scene

G = 9.81


@scene()
def ropes_with_heavy_ends_swing():
    ratios = (10, 40, 200, 1000)
    ropes = tv.shapes.join(*(tv.shapes.rope((2.5 * k, 2), (1, 2), points=8) for k in range(len(ratios))))[0]
    mass = 0.05 * np.concatenate([np.append(np.ones(7), ratio) for ratio in ratios])
    start = c.Particles(ropes.position, mass=mass, pinned=[8 * k for k in range(len(ratios))])
    return start, [c.Gravity(G), c.Distance(ropes.links)]


@scene()
def soft_nets_sag_at_rest():
    net = tv.shapes.net((0, 0, 0), (1, 0, 0), (0, 0, 1), (7, 7))
    rim = np.flatnonzero((net.position[:, [0, 2]] % 1 == 0).any(axis=1))
    return c.Particles(net.position, mass=0.01, pinned=rim), [c.Gravity(G), c.Distance(net.links, compliance=1e-3), c.Drag(8.0)]


@scene(known="gains energy by the default solver")
def a_ball_falls_on_a_flat_net():
    net = tv.shapes.net((-1, 1, -1), (2, 0, 0), (0, 0, 2), (9, 9))
    rim = np.flatnonzero((np.abs(net.position[:, [0, 2]]) > 0.999).any(axis=1))
    start = c.Particles(
        [*net.position, (0.03, 1.2, 0.02)], mass=[0.02] * 81 + [0.5], radius=[0.012] * 81 + [0.17], pinned=rim,
        velocity=[(0, 0, 0)] * 81 + [(0, -2.4, 0)],
    )  # fmt: skip
    return start, [c.Gravity(G), c.Distance(net.links), c.Contact(friction=0.3)]


@scene(flags={"softened"})
def a_cloth_hangs_from_two_corners_beside_contacts():
    s = tv.shapes.cloth((0, 1.2, 0), (1, 0, 0), (0, 0, 1), points=(8, 8))
    start = c.Particles(s.position, mass=0.02, radius=0.02, pinned=[0, 7])
    return start, [c.Gravity(G), c.Distance(s.links), c.Contact()]


@scene()
def a_drawbridge_falls_into_slack_ropes():
    def line(a, b, n):
        return np.asarray(a, float) + np.linspace(0, 1, n)[:, None] * (np.asarray(b, float) - a)

    t, k, q = np.radians(75), np.arange(9), np.arange(9, 18)
    tip = np.array([4 * np.cos(t), 4 * np.sin(t)])
    deck = [line((0, 0), tip, 9), line((-0.2, 0.05), tip + (-0.2, 0.05), 9)]
    x = np.vstack([*deck, line((0, 4), tip, 24)[:-1]])
    sides = [np.c_[k[:-1], k[1:]], np.c_[q[:-1], q[1:]], np.c_[k, q], np.c_[k[:-1], q[1:]], np.c_[q[:-1], k[1:]]]
    r = np.append(np.arange(18, 41), 8)
    ropes = c.Rope(np.c_[r[:-1], r[1:]], np.full(23, np.hypot(4, 4) / 23))
    start = c.Particles(x, mass=np.repeat([10.0, 0.5], [18, 23]), pinned=[0, 18])
    return start, [c.Gravity(G), c.Distance(np.vstack(sides)), ropes]


def beam(n, length=2.0, stiff=200.0, mode=1):
    """Return points of a beam of n points that is bent by 2 mm, its links, and its bends of EI = stiff."""
    y, k = np.linspace(0, length, n), np.arange(n)
    x = np.stack([y, 0.002 * np.sin(mode * np.pi * y / length)], axis=1)
    bends = c.Bend(np.stack([k[:-2], k[1:-1], k[2:]], axis=1), 0.0, compliance=length / (n - 1) / stiff)
    return x, c.Distance(np.stack([k[:-1], k[1:]], axis=1), length / (n - 1)), bends


@scene(known="loses energy untold")
def a_beam_rings():
    x, links, bends = beam(11)
    return c.Particles(x, mass=0.1, pinned=[0]), [links, bends, c.Path([10], [(1.5, 0), (2.5, 0)])]


@scene()
def a_column_buckles_under_a_weight():
    x, links, bends = beam(21)
    load = 1.03 * np.pi**2 * 200 / 4 / G
    start = c.Particles(x[:, ::-1] * [0.5, 1], mass=np.append(np.full(20, 0.05), load), pinned=[0])
    return start, [c.Gravity(G), links, bends, c.Drag(3.0), c.Path([20], [(0, -1), (0, 3)])]


@scene(flags={"moved"})
def two_sheets_are_sewn_together():
    n = 6
    sheets = tv.shapes.join(*(tv.shapes.cloth((0, 0, z), (0.6, 0, 0), (0, 0.6, 0), points=(n, n)) for z in (0, 0.3)))[0]
    k = np.arange(n * n).reshape(n, n)
    edge = np.unique(np.concatenate([k[0], k[-1], k[:, 0]]))
    threads = c.Distance(np.stack([edge, edge + n * n], axis=1), rest=0.0)
    braces = c.Distance(sheets.braces, compliance=1e-3, damping=0.01)
    return c.Particles(sheets.position, mass=0.002), [c.Gravity(G), c.Distance(sheets.links), braces, threads, c.Drag(2.0)]


@scene()
def a_wheel_and_an_arm_are_driven():
    k = 1 + np.arange(6)
    a = 2 * np.pi * np.arange(6) / 6
    wheel = np.concatenate([[[0, 1.2]], 0.4 * np.stack([np.cos(a), np.sin(a)], axis=1) + [0, 1.2], [[-0.8, 1.2]]])
    spokes = np.concatenate([np.stack([0 * k, k], axis=1), np.stack([k, np.roll(k, -1)], axis=1)])
    x = np.concatenate([wheel, [[3, 0], [4, 0], [4.5, 0]]])
    motor = c.Motor([[7, 0, 1], [8, 9, 10]], [3.3, 4.0], torque=[5.0, 12.0])
    start = c.Particles(x, mass=0.5 * np.repeat([1, 2], [8, 3]), pinned=[0, 7, 8, 9])
    return start, [c.Gravity(G), c.Distance(np.concatenate([spokes, [[9, 10]]])), motor]


@scene()
def a_flag_flies_in_the_wind():
    s = tv.shapes.cloth((0, 1.2, 0), (1, 0, 0), (0, 0, 1), points=(7, 7))
    return c.Particles(s.position, mass=0.02, pinned=[0, 6]), [c.Gravity(G), c.Distance(s.links), c.Wind((6.0, 1.0, 0.0), 2.0)]
