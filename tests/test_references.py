"""Ropes, nets and beams against statics and modes from cases.json.

One Jacobi pass cannot hold a long rigid rope. There its law is tested: a pass is a spring of compliance W h^2.
"""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import case, figures, pendulums, rerun, rms

DT = 1 / 60


def line(n: int) -> np.ndarray:
    """Return the pairs of a chain of n links."""
    return np.stack([np.arange(n), np.arange(n) + 1], axis=1)


def discrete(n: int, values: dict) -> np.ndarray:
    """Return the steps of a catenary of n links, 10 m in all, (n, 2): link i has the slope (i - (n + 1) / 2) / H."""
    slope = (np.arange(1, n + 1) - (n + 1) / 2) / values["H_over_mg"]
    return 10.0 / n * np.stack([np.ones(n), slope], axis=1) / np.sqrt(1 + slope**2)[:, None]


@pytest.mark.slow
def test_ropes_hang_as_catenaries(world):
    # R10b, rigid: 1e-4 with 16 passes. S07, elastic: 1e-4 with 4 passes or more. All five ropes are in one world. Then the rigid
    # ropes and one of a hundred links with the default solver, which is direct: 1e-8 with one pass.
    rigid = [(n, 10.0, 6.0, 0.0, case(f"R10b_discrete_catenary_N{n}")["values"]) for n in (10, 20)]
    keys = {"N10_alpha1e-3": (10, 1e-3), "N20_alpha1e-4": (20, 1e-4), "N50_alpha1e-3": (50, 1e-3)}
    soft = [(n, 1.0, 0.8, a, case("S07_elastic_catenary")["values"][key]) for key, (n, a) in keys.items()]
    x, pairs, rest, alpha, ends, first = [], [], [], [], [], 0
    for n, length, span, a, _ in rigid + soft:
        t, depth = np.linspace(0, 1, n + 1), np.sqrt(length**2 - span**2) / 2
        x.append(np.stack([span * t, -depth * (1 - np.abs(2 * t - 1))], axis=1))
        pairs.append(line(n) + first)
        rest, alpha = rest + [length / n] * n, alpha + [a] * n
        ends += [first, first + n]
        first += n + 1
    link = tv.Distance(np.concatenate(pairs), rest, compliance=alpha)
    start = tv.Particles(np.concatenate(x), mass=0.1, pinned=ends)
    w = world(start, [tv.Gravity(9.81), link, tv.Drag(4.0)], precision="f64", solver=tv.Jacobi())
    for substeps, iterations in ((20, 16), (24, 20)):
        rerun(w, 8.0, substeps=substeps, iterations=iterations)
        at, k = ends[::2], 0
        for i, (n, *_, v) in zip(at, rigid + soft, strict=True):
            assert -w.position[i : i + n + 1, 1].min() == pytest.approx(v["sag"], rel=1e-4)
            top = v["end_tension"] if "end_tension" in v else v["end_link_tension_over_mg"] * 0.1 * 9.81
            assert link.load[k] == pytest.approx(top, rel=1e-4)
            k += n
        for i, (n, *_, v) in zip(at[:2], rigid, strict=True):
            np.testing.assert_allclose(np.diff(w.position[i : i + n + 1], axis=0), discrete(n, v), atol=5e-4 / n)
    at, x, k = {10: 0, 20: 11, 100: 32}, [], 0
    for n in at:
        t = np.linspace(0, 1, n + 1)
        x.append(np.stack([6 * t, -4 * (1 - np.abs(2 * t - 1))], axis=1))
    link = tv.Distance(np.concatenate([line(n) + i for n, i in at.items()]), np.concatenate([np.full(n, 10 / n) for n in at]))
    start = tv.Particles(np.concatenate(x), mass=0.1, pinned=[end for n, i in at.items() for end in (i, i + n)])
    w = world(start, [tv.Gravity(9.81), link, tv.Drag(4.0)], precision="f64")
    w.run(12.0)
    for n, i in at.items():
        v = case(f"R10b_discrete_catenary_N{n}")["values"]
        assert -w.position[i : i + n + 1, 1].min() == pytest.approx(v["sag"], rel=1e-8)
        assert link.load[k] == pytest.approx(v["end_link_tension_over_mg"] * 0.1 * 9.81, rel=1e-8)
        np.testing.assert_allclose(np.diff(w.position[i : i + n + 1], axis=0), discrete(n, v), atol=1e-8 / n)
        k += n


def test_one_pass_sags_by_the_law(world):
    # A rigid chain of N links with masses m, one pass: link k carries k m g, and gives way by W h^2 times that, 4 k g h^2 inside.
    # All masses but the anchor fall by g h^2 before the pass, so the anchor's link gives way by that much less. With drag h^2 is
    # phi h^2.
    n, h = 100, DT / 20
    hh = h * -np.expm1(-20 * h) / 20
    weight = np.where(np.arange(n) == 0, 2.0, 4.0)  # W = 2 w + 2 w, but 2 w at the anchor, and 2 w + w at the free end
    weight[-1] = 3.0
    stretch = weight * (n - np.arange(n)) * 9.81 * hh
    stretch[0] -= 9.81 * hh
    y = -np.concatenate([[0.0], np.cumsum(0.01 + stretch * 0.9)])
    start = tv.Particles(np.stack([np.zeros(n + 1), y], axis=1), mass=0.01, pinned=[0])
    link = tv.Distance(line(n), 0.01)
    w = world(start, [tv.Gravity(9.81), link, tv.Drag(20.0)], precision="f64")
    w.run(4.0)
    np.testing.assert_allclose(-np.diff(w.position[:, 1]) - 0.01, stretch, rtol=1e-5)
    np.testing.assert_allclose(link.residual, stretch / 0.01, rtol=1e-5)
    np.testing.assert_allclose(link.load, 0.01 * 9.81 * (n - np.arange(n)), rtol=1e-5)


def test_modes_of_a_chain_of_springs(world):
    # R12: u_i = A sin(j pi i / (N + 1)) cos(omega t), omega = 2 sqrt(k / m) sin(j pi / (2 (N + 1))); the amplitude is kept.
    p, modes = case("R12_chain_modes")["params"], case("R12_chain_modes")["values"]["modes"]["dt0.001"]
    n = p["N"]
    x = np.stack([np.arange(n + 2.0), np.zeros(n + 2)], axis=1)
    link = tv.Distance(line(n + 1), p["rest"], compliance=p["alpha"])
    w = world(tv.Particles(x, mass=p["m"], pinned=[0, n + 1]), [link], substeps=20, precision="f64")
    for j, iterations, limit in ((1, 4, 1e-5), (1, 1, 1e-3), (5, 4, 1e-4)):
        u = np.sin(j * np.pi * np.arange(n + 2) / (n + 1))
        u[-1] = 0
        w.velocity, w.position, w.iterations = 0 * x, x + 0.01 * np.outer(u, [1, 0]), iterations
        times, q = [], []
        for _ in range(500):  # 10 s, h = 1e-3
            w.step(0.02)
            times.append(0.02 * (len(times) + 1))
            q.append((w.position - x)[:, 0] @ u / (u @ u) / 0.01)
        omega, t = modes[f"mode{j}"]["omega"], np.array(times)
        assert np.abs(q[-60:]).max() >= 0.999
        assert (np.abs(q - np.cos(omega * t)) <= limit * omega * t + 1e-3).all()


def test_modes_of_a_hanging_chain(world):
    # R13: omega^2 = (g / l) x with x the least root of the Laguerre polynomial L_N.
    n, omega = 5, case("R13_hanging_chain_modes")["values"]["N5"]["omega1"]
    roots = np.polynomial.laguerre.lagroots([0] * n + [1])
    assert np.sqrt(9.81 * n * roots.min()) == pytest.approx(omega, rel=1e-12)
    tension = np.arange(n, 0, -1) * 9.81 * n  # over the link length, with mass 1
    K = np.diag(tension + np.append(tension[1:], 0)) - np.diag(tension[1:], 1) - np.diag(tension[1:], -1)
    u = np.concatenate([[0.0], np.linalg.eigh(K)[1][:, 0]])
    x = np.stack([1e-3 * u / np.abs(u).max(), np.zeros(n + 1)], axis=1)
    x[1:, 1] = -np.cumsum(np.sqrt(1 / n**2 - np.diff(x[:, 0]) ** 2))
    w = world(tv.Particles(x, pinned=[0]), [tv.Gravity(9.81), tv.Distance(line(n), 1 / n)], precision="f64")
    for iterations, limit in ((8, 1e-4), (1, 2e-4)):
        w.velocity, w.position, w.iterations = 0 * x, x, iterations
        q = []
        for _ in range(600):
            w.step(DT)
            q.append(w.position[:, 0] @ u / (x[:, 0] @ u))
        t = DT * np.arange(1, 601)
        assert (np.abs(q - np.cos(omega * t)) <= limit * omega * t + 1e-3).all()


def test_a_whip_of_ten_links(world):
    # D05: with one pass, the error of the prototype; with passes that converge, that of a direct solver, at second order.
    name = "D05_chain10"
    x, mass, pairs = pendulums(name)
    start = tv.Particles(x, mass=mass, pinned=[0])
    w = world(start, [tv.Gravity(9.81), tv.Distance(pairs)], precision="f64", solver=tv.Jacobi())
    want, known = case(name)["values"]["t0.5"]["xy"], figures(name, 0.5, 20)
    assert rms(rerun(w, 0.5, substeps=20).position[1:], want) == pytest.approx(known["SHAKE-Jac split"], rel=1e-3)
    best = rms(rerun(w, 0.5, substeps=20, iterations=500).position[1:], want)
    assert best <= known["SHAKE-direct"] and best * 500 <= known["XPBD-GS"]
    assert rms(rerun(w, 0.5, substeps=40, iterations=300).position[1:], want) <= best / 3.8


def test_a_net_sags_under_its_weight(world):
    # S08: the minimum of sum C^2 / (2 alpha) + m g y, in a frame of pinned edges.
    n, values = 10, case("S08_net_sag")["values"]
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    k = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    pairs = np.concatenate(
        [np.stack([k[:-1].ravel(), k[1:].ravel()], axis=1), np.stack([k[:, :-1].ravel(), k[:, 1:].ravel()], axis=1)]
    )
    edge = (i % n == 0) | (j % n == 0)
    two = len(k.ravel())
    flat = np.stack([i.ravel() / n, 0.0 * i.ravel(), j.ravel() / n], axis=1)
    start = tv.Particles(np.concatenate([flat, flat + [2, 0, 0]]), mass=1 / n**2, pinned=np.flatnonzero(np.tile(edge.ravel(), 2)))
    alpha = np.repeat([0.01, 0.001], len(pairs))
    link = tv.Distance(np.concatenate([pairs, pairs + two]), 1 / n, compliance=alpha)
    w = world(start, [tv.Gravity(9.81), link, tv.Drag(4.0)], precision="f64")
    for substeps, iterations in ((20, 4), (24, 5)):
        rerun(w, 4.0, substeps=substeps, iterations=iterations)
        for part, key in enumerate(("n10_alpha0.01", "n10_alpha0.001")):
            x = w.position[part * two : (part + 1) * two] - [2 * part, 0, 0]
            assert x[k[5, 5], 1] == pytest.approx(values[key]["center_y"], rel=1e-3)
            np.testing.assert_allclose(x[k[2, 2]], values[key]["quarter_xyz"], atol=1e-5)


@pytest.mark.slow
def test_a_beam_bends_under_its_load(world):
    # S06: k_b theta_i = F (x_N - x_i), k_b = EI / l: a clamped strip of ten rigid links with a force at its tip.
    n = 10
    k, values = np.arange(n), case("S06_cantilever_elastica")["values"]
    x = np.stack([(np.arange(n + 2) - 1) / n, np.zeros(n + 2)], axis=1)
    force = ti.field(ti.f64, ())

    @ti.func
    def pull(x, v, t, i):
        out = 0 * x
        if i == 11:
            out[1] = -force[None]
        return out

    bend = tv.Bend(np.stack([k, k + 1, k + 2], axis=1), 0.0, compliance=1 / n)
    links = tv.Distance(np.stack([k + 1, k + 2], axis=1))
    w = world(tv.Particles(x, mass=0.3, pinned=[0, 1]), [tv.Force(pull), links, bend, tv.Drag(3.0)], precision="f64")
    for F, name, efforts in ((1.0, "1.0", ((20, 4), (30, 8))), (5.0, "5.0", ((20, 8),))):
        v = values[f"N10_FL2_EI_{name}"]
        force[None] = F
        for substeps, iterations in efforts:
            rerun(w, 10.0, substeps=substeps, iterations=iterations)
            np.testing.assert_allclose(w.position[-1], [v["tip_x"], v["tip_y"]], atol=3e-4)
            arm = w.position[-1, 0] - w.position[1:-1, 0]
            np.testing.assert_allclose(-bend.load, F * arm, atol=1e-3 * F)
