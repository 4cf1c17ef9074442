"""Rigid and compliant links against ODE references: second order, no loss of energy, errors far below XPBD's."""

from itertools import product

import numpy as np
import pytest

import tiverlet as tv

from .conftest import case, figures, order, pendulums, rerun, rms

FRAME = 1 / 60


def hang(world, name, **settings):
    """Return a world with the chain of a D case, hung up at its anchor."""
    x, mass, pairs = pendulums(name)
    start = tv.Particles(x, mass=mass, pinned=[0])
    settings = {"precision": "f64", "solver": tv.Jacobi(), **settings}
    return world(start, [tv.Gravity(case(name)["params"]["g"]), tv.Distance(pairs)], **settings)


def test_pendulum_state(world):
    # Three pendulums in one world, released from 10, 90 and 150 degrees.
    degrees = (10, 90, 150)
    a = np.radians(degrees)
    x = np.concatenate([np.zeros((3, 2)), np.stack([np.sin(a), -np.cos(a)], axis=1)])
    features = [tv.Gravity(9.81), tv.Distance([[0, 3], [1, 4], [2, 5]])]
    w = world(tv.Particles(x, pinned=[0, 1, 2]), features, precision="f64")
    values = case("R06b_pendulum_state")["values"]
    want = np.array([[values[f"{k}deg_t5"][c] for c in "xy"] for k in degrees])
    errors = np.array([np.linalg.norm(rerun(w, 5.0, substeps=n).position[3:] - want, axis=1) for n in (10, 20, 40)])
    for k in range(3):
        assert 1.9 <= order(errors[:, k]) <= 2.1
    # XPBD for the same pendulums at 20 substeps, with the single link solved exactly.
    p, speed, h = x[3:], 0 * x[3:], FRAME / 20
    for _ in range(round(5.0 / h)):
        q = p + h * speed + [0, -9.81 * h * h]
        q /= np.linalg.norm(q, axis=1)[:, None]
        p, speed = q, (q - p) / h
    assert (errors[1] * 100 <= np.linalg.norm(p - want, axis=1)).all()
    rerun(w, 10.0, substeps=10)
    v = values["90deg_t10"]
    assert rms(w.position[4], [v["x"], v["y"]]) <= 1.75e-4  # numerics 4.6: 1.7e-4 at h = 1/600
    # Energy is never lost. At half steps it swings by at most m v^2 (omega h)^2, with (omega h)^2 = 2 g h^2 (1 - cos) for each.
    energy = -9.81 * np.cos(a).sum()
    assert abs(w.last.energy - energy) <= (2 * 9.81 * 9.81 * (1 - np.cos(a)) / 600**2).sum() and w.last.residual <= 1e-12
    assert w.features[1].load[1] == pytest.approx(9.81 * v["tension_over_mg"], rel=1e-2)  # half a step late


def test_compensated_pendulum_far_from_the_origin(world):
    # Row 27: at 1e4 m an ulp of f32 is 1 mm, at 1e6 m 6 cm, and (position, previous position) would lose the motion altogether.
    # With the low word the error, including that of the method, is at most 2e-4 m for h = 1/600 to 1e-4.
    v = case("R06b_pendulum_state")["values"]["90deg_t10"]
    far = np.array([[1e4, -1e4], [-1e6, 1e6]])
    start = tv.Particles(np.concatenate([far, far + [1, 0]]), pinned=[0, 1])
    w = world(start, [tv.Gravity(9.81), tv.Distance([[0, 2], [1, 3]])], precision="f32-compensated")
    for substeps in (10, 40, 167):
        off = rerun(w, 10.0, substeps=substeps).position[2:] - far - [v["x"], v["y"]]
        assert np.linalg.norm(off, axis=1).max() <= 2e-4


def test_double_pendulum(world):
    name = "D01_double_pendulum"
    ref, late = (np.array(case(name)["values"][t]["xy"]) for t in ("t2.0", "t5.0"))
    w = hang(world, name)
    errors = [rms(rerun(w, 2.0, substeps=n, iterations=30).position[1:], ref) for n in (20, 40, 80)]
    assert 1.9 <= order(errors) <= 2.1
    known = figures(name, 2.0, 20)
    assert errors[0] <= known["SHAKE-direct"] and errors[0] * 100 <= known["XPBD-GS"]
    assert rms(rerun(w, 5.0, substeps=20, iterations=1).position[1:], late) <= 6.3e-4  # numerics 4.4, SHAKE-Jacobi


def test_spherical_pendulum(world):
    p, values = case("S01_spherical_pendulum")["params"], case("S01_spherical_pendulum")["values"]
    start = tv.Particles([[0, 0, 0], p["x0"]], velocity=[[0, 0, 0], p["v0"]], pinned=[0])
    w = world(start, [tv.Gravity(p["g"]), tv.Distance([[0, 1]])], precision="f64")
    errors = [rms(rerun(w, 10.0, substeps=n).position[1], values["t10.0"]["xyz"]) for n in (20, 40, 80)]
    assert 1.9 <= order(errors) <= 2.1
    known = figures("S01_spherical_pendulum", 10.0, 20)
    assert errors[0] <= known["SHAKE-direct"] and errors[0] * 100 <= known["XPBD-GS"]
    # L_y = z v_x - x v_z with the velocity that the user reads, second order in h.
    assert tv.measure.angular_momentum(w)[1] == pytest.approx(-values["Ly"], rel=1e-5)


def test_spherical_pendulum_for_a_million_steps(world):
    # Row 42: the energy stays where the step puts it; XPBD would lose all of it much earlier.
    p = case("S01_spherical_pendulum")["params"]
    start = tv.Particles([[0, 0, 0], p["x0"]], velocity=[[0, 0, 0], p["v0"]], pinned=[0])
    w = world(start, [tv.Gravity(p["g"]), tv.Distance([[0, 1]])], substeps=1000, precision="f64")
    spin = []
    for _ in range(1000):
        w.step(1.0)  # h = 1e-3
        x, d = w._runner.memory.state()["position"][1], w._runner.memory.state()["displacement"][1]
        spin.append(np.cross(x, d)[1] / 1e-3)  # x_n x x_(n-1) is conserved exactly by the discrete motion
        assert abs(w.last.energy - case("S01_spherical_pendulum")["values"]["energy_per_m"]) < 3e-5
    assert np.ptp(spin) < 1e-10


def test_elastic_pendulum(world):
    c = case("S04_spring_pendulum")
    p, errors, speeds = c["params"], [], []
    link = tv.Distance([[0, 1]], rest=p["L"], compliance=p["alpha"])
    w = world(tv.Particles([[0, 0], p["x0"]], pinned=[0]), [tv.Gravity(p["g"]), link], precision="f64")
    for n in (20, 40, 80):
        rerun(w, 5.0, substeps=n)
        errors.append(rms(w.position[1], c["values"]["t5.0"]["xy"]))
        speeds.append(rms(w.velocity[1], c["values"]["t5.0"]["v"]))
    assert 1.9 <= order(errors) <= 2.1 and 1.9 <= order(speeds) <= 2.1
    assert errors[0] <= 1.1e-6 * 1.05  # numerics 4.4: XPBD 1.2e-2, averaged constraint 1.1e-6
    assert errors[0] * 100 <= 1.2e-2


def test_a_free_rod_spins_for_ever(world):
    # Row 44 and S09: with PBD's direction, 60 to 76 % of the spin would be lost in these times.
    x, across = np.array([[0.25, 0, 0], [-0.75, 0, 0]]), np.array([[0, 0.25, 0], [0, -0.75, 0]])
    start = tv.Particles(x, mass=[3.0, 1.0])
    w = world(start, [tv.Distance([[0, 1]])], substeps=10, precision="f64", solver=tv.Jacobi())
    for (omega, h, t), iterations in product([(50.0, 1e-3, 1.0), (10.0, 1 / 600, 10.0), (100.0, 1 / 1200, 1.0)], (1, 3)):
        w.iterations = iterations
        w.velocity, w.position = omega * across, x
        w.step(10 * h)
        turn = []
        for _ in range(2):
            # The angle of one substep from the last displacement: arg of x_n relative to x_(n-1).
            s = w._runner.memory.state()
            r1, d = s["position"][0] - s["position"][1], s["displacement"][0] - s["displacement"][1]
            r0 = r1 - d
            turn.append(np.arctan2(r0[0] * r1[1] - r0[1] * r1[0], r0[:2] @ r1[:2]))
            w.run(t - 10 * h, dt=10 * h)
        assert abs(turn[1] / turn[0] - 1) <= 1e-12
        if iterations > 1:
            assert turn[0] == pytest.approx(np.arcsin(omega * h), rel=1e-12)  # the known angle of a tangential start
        # One pass leaves a constant (omega h)^6 / 2 of the length.
        assert abs(tv.measure.strain(w, [[0, 1]], [1.0])[0]) <= (1e-14 if iterations > 1 else 0.51 * (omega * h) ** 6)
        assert not w.last.flags
    # Velocities that users read have the same angular momentum and are across the rod, from the first substep on and after a
    # change of h. With the force along the direction at the start of the substep, the momentum would be off by
    # (omega h)^2 / 2 = 3e-4.
    omega, h, w.iterations = 37.0, 7e-4, 3
    w.velocity, w.position = omega * across, x
    for substeps in (1, 1, 1, 2, 2, 1, 3):
        w.substeps = substeps
        w.step(h)
        assert tv.measure.angular_momentum(w)[-1] == pytest.approx(omega * (3 * 0.25**2 + 0.75**2), rel=1e-13)
        r, v = w.position[0] - w.position[1], w.velocity[0] - w.velocity[1]
        assert abs(r @ v) <= 1e-6 * omega  # second order: (omega h)^2 omega h / 2 is 9e-6 of it


def test_a_thousand_radians_per_second(world):
    # Row 44: omega h = 0.83 turns the rod by more than 41 degrees a step. The length is kept, nothing is infinite, and a flag is
    # set.
    x, v = [[0.5, 0.0], [-0.5, 0.0]], [[0, 500.0], [0, -500.0]]
    w = world(tv.Particles(x, velocity=v), [tv.Distance([[0, 1]])], substeps=20, iterations=20, precision="f64")
    report = w.run(1.0)
    assert "turned" in report.flags and np.isfinite(w.position).all()
    assert abs(tv.measure.strain(w, [[0, 1]], [1.0])[0]) <= 1e-6
    assert w.last.energy <= 250000.0 * 1.0001


def test_changing_substeps_in_a_swing_costs_no_order(world):
    # Row 14: the start after each change of h is second order, too.
    ref = case("D01_double_pendulum")["values"]["t2.0"]["xy"]
    errors = []
    w = hang(world, "D01_double_pendulum", iterations=30)
    for n in (20, 40, 80):
        w.velocity, w.position = w.particles.velocity, w.particles.position
        for k in range(120):
            w.substeps = n + (k % 2) * n // 4
            w.step(FRAME)
        errors.append(rms(w.position[1:], ref))
    assert 1.85 <= order(errors) <= 2.15 and errors[0] <= 4e-5
