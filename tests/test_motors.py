"""Motors and winches: the speed is met, torque and force are exact, and energy is accounted for."""

import numpy as np
import pytest

import tiverlet as tv

from .conftest import order

ARM, G = 0.5, 9.81


def wheel(world, speed, mass=2.0, gravity=0.0, **settings):
    """Return a world with a mass on an arm of 0.5 m about a fixed hub, I = m r^2, and its motor."""
    world_settings = {k: settings.pop(k) for k in ("substeps", "precision") if k in settings}
    motor = tv.Motor([[0, 1, 2]], speed, **settings)
    start = tv.Particles([[-1.0, 0.0], [0.0, 0.0], [ARM, 0.0]], mass=mass, pinned=[0, 1])
    features = [motor, tv.Distance([[1, 2]]), tv.Gravity(gravity)]
    return world(start, features, **{"substeps": 20, "precision": "f64", "solver": tv.Jacobi()} | world_settings), motor


def turned(w, since=0.0):
    """Return the angle of the arm relative to `since` [rad], in [-pi, pi)."""
    x = w.position[2] - w.position[1]
    return (np.arctan2(x[1], x[0]) - since + np.pi) % (2 * np.pi) - np.pi


@pytest.mark.slow
def test_a_limited_torque_accelerates_and_the_speed_is_then_met(world):
    # I w' = T until w = speed: the angle is T t^2 / 2 I, then speed (t - t1 / 2) with t1 = I speed / T. Second order.
    inertia, torque, speed = 2.0 * ARM**2, 1.0, 3.0
    t1, errors = inertia * speed / torque, []
    for substeps in (5, 10, 20, 40):
        w, motor = wheel(world, speed, torque=torque, substeps=substeps)
        w.run(0.5)
        errors.append(turned(w) - torque * 0.5**2 / 2 / inertia)
        assert motor.load[0] == pytest.approx(-torque, rel=1e-9) and motor.residual[0] == 0
        assert np.linalg.norm(w.velocity[2]) == pytest.approx(ARM * torque * 0.5 / inertia, rel=1e-4)
    assert order(np.abs(errors)) == pytest.approx(2, abs=0.1)
    w.run(3.0)
    assert turned(w, speed * (3.5 - t1 / 2)) == pytest.approx(0, abs=1e-3)
    begin = turned(w)
    w.run(1.0)
    assert turned(w, begin + speed) == pytest.approx(0, abs=1e-9) and abs(motor.load[0]) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("kind", [tv.Contact, lambda: tv.Polygons([])], ids=["Contact", "Polygons"])
@pytest.mark.parametrize("solver", [None, tv.Jacobi()], ids=["default", "Jacobi"])
def test_largest_loads_hold_beside_contacts_that_nothing_touches(world, kind, solver):
    # Arms and weights as above: I w' = T up to the speed, m a = F. A soft motor of torque T bears T, too, once it is wound
    # up by alpha T; a torque of 0 lets go.
    T, t, speed = np.array([1.0, 1.0, 0.0, 100.0]), 0.5, 3.0
    arms = np.concatenate([np.array([(-1, 0), (0, 0), (ARM, 0)]) + (0, 3.0 * k) for k in range(4)])
    x = np.r_[arms, [(20.0, 0.0), (20.0, -2.0), (30.0, 0.0), (30.0, -2.0)]]
    pinned = np.r_[np.arange(4) * 3, np.arange(4) * 3 + 1, 12, 14]
    hinges = np.arange(12).reshape(4, 3)
    motor, winch = (
        tv.Motor(hinges, speed, torque=T, compliance=[0, 0.02, 0, 0]),
        tv.Winch([(12, 13), (14, 15)], -50.0, force=[10, 0]),
    )
    w = world(
        tv.Particles(x, mass=2.0, radius=0.02, pinned=pinned), [motor, winch, tv.Distance(hinges[:, 1:]), kind()],
        substeps=20, precision="f64", solver=solver,
    )  # fmt: skip
    for _ in range(round(60 * t)):
        w.step(1 / 60)
        assert (np.abs(motor.load) <= T * (1 + 1e-12)).all() and (winch.load <= winch.force * (1 + 1e-12)).all()
    turning = np.linalg.norm(w.velocity[hinges[:, 2]], axis=1) / ARM
    inertia = 2.0 * ARM**2
    assert turning[[0, 2, 3]] == pytest.approx(np.minimum(T * t / inertia, speed)[[0, 2, 3]], rel=1e-3, abs=1e-9)
    assert turning[1] == pytest.approx(T[1] * t / inertia, rel=0.05)
    assert w.position[[13, 15], 1] + 2 == pytest.approx([10.0 / 2.0 * t**2 / 2, 0.0], rel=1e-6, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_a_wheel_turns_for_ever_however_slowly(world, precision):
    # The angle passes +-pi again and again; and 2^-24 of a turn per substep, which would be lost in a rest angle in f32.
    for speed, seconds in ((50.0, 4.0), (1e-3, 4.0)):
        w, _ = wheel(world, speed, precision=precision)
        w.run(1.0)
        begin = turned(w)
        w.run(seconds)
        assert turned(w, begin + speed * seconds) == pytest.approx(0, abs=1e-9 if precision == "f64" else 2e-6)


def test_a_brake_is_dry_friction(world):
    # m (r w)' = -T / r until the wheel rests; then the brake holds it, and no frame adds energy.
    w, motor = wheel(world, 0.0, torque=0.5)
    w.velocity = [[0, 0], [0, 0], [0, 1.0]]
    energies = np.array([w.step(1 / 60).energy for _ in range(90)])
    t = np.arange(1, 91) / 60
    speed = np.maximum(1.0 - 0.5 * t / ARM / 2.0, 0)
    np.testing.assert_allclose(energies[:55], speed[:55] ** 2, atol=2e-3)
    assert (np.diff(energies) <= 1e-12).all()
    motor.torque = 0.0  # the wheel runs free
    w.velocity, w.position = [[0, 0], [0, 0], [0, 1.0]], w.particles.position
    assert w.run(0.5).energy == pytest.approx(1.0, abs=1e-5)  # (h v / r)^2 = 3e-6: the error of the link


@pytest.mark.slow
def test_hinges_in_space_turn_for_ever(world):
    # A door of two links turns about a fixed axis: its angle passes pi like any other.
    x = [[0, 0, 0], [0, 0, 1.0], [1, 0, 0.5], [-1, 0, 0.5]]
    motor = tv.Motor([[0, 1, 2, 3]], 5.0, torque=1.0)
    w = world(tv.Particles(x, pinned=[0, 1, 2]), [motor, tv.Distance([[0, 3], [1, 3]])], precision="f64", substeps=10)
    w.run(0.5)
    assert np.pi - abs(np.arctan2(*w.position[3, [1, 0]])) == pytest.approx(0.5**2 / 2, rel=1e-4)  # I = m r^2 = 1
    w.run(6.0)
    a = w.position[3]
    w.run(1.0)
    turn = np.arctan2(*w.position[3, [1, 0]]) - np.arctan2(a[1], a[0])
    assert (turn + 5.0 + np.pi) % (2 * np.pi) == pytest.approx(np.pi, abs=1e-6) and abs(motor.load[0]) < 1e-3


@pytest.mark.slow
def test_a_servo_goes_to_its_angle_and_stays(world):
    # A servo takes the shorter way, through pi. Under a load, one pass lags by at most the violation that bears it,
    # 2 w m g r h^2.
    for torque in (1e9, 20.0):
        w, motor = wheel(world, 3.0, angle=2.5, torque=torque, gravity=G, mass=1.0)
        w.run(0.5)
        assert turned(w) == pytest.approx(1.5, abs=0.02 if torque == 1e9 else 0.2)
        w.run(2.0)
        assert turned(w, 2.5) == pytest.approx(0, abs=1e-4) and motor.rest[0] == pytest.approx(2.5, abs=1e-6)
        motor.angle = -2.5
        w.run(1.0)
        assert abs(turned(w)) > 2.4 and motor.load[0] == pytest.approx(-G * ARM * np.cos(2.5), rel=0.05)
        w.run(1.0)
        assert turned(w, -2.5) == pytest.approx(0, abs=1e-4)


@pytest.mark.slow
def test_a_soft_servo_is_a_spring_and_slips_beyond_its_torque(world):
    # With compliance and a dashpot, a servo rests at the angle a where alpha m g r cos(a) = -a, deflected by far more than a
    # rigid hinge may be off. Where the spring would bear more than the largest torque, the servo slips.
    w, motor = wheel(world, 1.0, gravity=G, angle=0.0, torque=14.0, compliance=0.1, damping=4.0)
    w.iterations = 8
    w.run(3.0)
    assert turned(w) == pytest.approx(-0.1 * G * 2.0 * ARM * np.cos(turned(w)), rel=1e-4)
    w, motor = wheel(world, 1.0, gravity=G, angle=0.0, torque=8.0, compliance=0.1, damping=4.0)
    w.run(3.0)
    assert motor.load[0] == pytest.approx(-8.0, rel=1e-3) or G * 2.0 * ARM * np.cos(turned(w)) < 8.0
    assert turned(w) < -0.5 and abs(motor.violation(w.position)[0]) < 1.01 * 0.1 * 8.0


@pytest.mark.slow
def test_a_stalled_motor_winds_nothing_up(world):
    # A stop holds the wheel for a second and then gives way: the wheel goes on at its speed, without catching up the lost angle.
    stop = tv.HalfSpace((0, -1), -ARM / 2, active=True)  # at 30 degrees
    motor = tv.Motor([[0, 1, 2]], 2.0, torque=1.0)
    start = tv.Particles([[-1.0, 0.0], [0.0, 0.0], [ARM, 0.0]], mass=2.0, pinned=[0, 1])
    w = world(start, [motor, tv.Distance([[1, 2]]), stop], precision="f64")
    w.run(1.0)
    assert turned(w) == pytest.approx(np.pi / 6, abs=1e-6) and motor.load[0] == pytest.approx(-1.0, rel=1e-6)
    assert motor.rest[0] - turned(w) < 2e-3
    stop.active = False
    speeds = []
    for _ in range(120):
        w.step(1 / 60)
        speeds.append(np.linalg.norm(w.velocity[2]) / ARM)
    assert max(speeds) < 2.0 + 1e-2 and speeds[-1] == pytest.approx(2.0, abs=1e-5)
    w.velocity, w.position = np.zeros((3, 2)), [[-1, 0], [0, 0], [0, -ARM]]  # the wheel goes on from where it is placed
    report = w.step(1 / 60)
    assert abs(turned(w, -np.pi / 2)) < 2.0 / 60 + 1e-6 and "moved" not in report.flags


def hoist(world, speed, substeps=20, **options):
    """Return a world with a weight of 2 kg on 2 m of rope, and its winch."""
    winch = tv.Winch([[0, 1]], speed, **options)
    start = tv.Particles([[0.0, 0.0], [0.0, -2.0]], mass=2.0, pinned=[0])
    return world(start, [tv.Gravity(G), winch], substeps=substeps, precision="f64"), winch


@pytest.mark.slow
def test_a_winch_lifts_what_its_force_can(world):
    # m a = F - m g up to the speed v, which is reached at t1 = v / a, then v (t - t1 / 2). Below m g the weight goes down.
    # Without a limit it goes at its speed at once.
    for substeps in (1, 20):
        w, winch = hoist(world, -0.5, substeps)
        for frame in range(60):
            w.step(1 / 60)
            assert w.position[1, 1] == pytest.approx(-2.0 + 0.5 * (frame + 1) / 60, abs=1e-9)
        assert winch.load[0] == pytest.approx(2.0 * G, rel=1e-9) and winch.rest[0] == pytest.approx(1.5)
        winch.speed = 0.5
        w.run(1.0)
        assert w.position[1, 1] == pytest.approx(-2.0, abs=1e-9)
    errors, force, v = [], 40.0, 0.5
    t1 = v / (force / 2.0 - G)
    for substeps in (5, 10, 20, 40):
        w, winch = hoist(world, -v, substeps, force=force)
        w.run(0.5)
        errors.append(w.position[1, 1] + 2.0 - v * (0.5 - t1 / 2))
    assert np.abs(errors).max() < 4e-4 * 5 and abs(errors[-1]) < abs(errors[0]) / 4
    for force, sign in ((2 * G + 0.1, 1), (2 * G - 0.1, -1)):
        w, winch = hoist(world, -v, force=force)
        w.run(1.0)
        assert w.position[1, 1] + 2.0 == pytest.approx(sign * 0.05 / 2, rel=1e-6) and winch.load[0] == pytest.approx(force)
    winch.force = 100.0  # the winch holds the fallen weight where it is, and lifts it
    w.run(1.0)
    begin = w.position[1, 1]
    w.run(0.5)
    assert w.position[1, 1] - begin == pytest.approx(0.25, abs=1e-6) and winch.load[0] == pytest.approx(2 * G, rel=1e-6)


def test_a_winch_stops_at_its_ends(world):
    w, winch = hoist(world, -1.0, shortest=1.5, longest=2.25)
    w.run(2.0)
    assert w.position[1, 1] == pytest.approx(-1.5, abs=1e-9) and winch.load[0] == pytest.approx(2 * G, rel=1e-6)
    winch.speed = 2.0
    w.run(2.0)
    assert w.position[1, 1] == pytest.approx(-2.25, abs=1e-9) and winch.rest[0] == 2.25
    short, winch = hoist(world, -1.0, length=1.0, force=9.0)  # a rope that is too short can run out, and nothing is moved
    report = short.step(1 / 60)
    assert "moved" not in report.flags and short.position[1, 1] == pytest.approx(-2.0 - (G - 4.5) / 2 / 60**2, abs=1e-9)
    slack, winch = hoist(world, -1.0, length=3.0)  # a slack rope pulls once the slack is in
    slack.run(0.1)
    assert slack.position[1, 1] == pytest.approx(-2.0 - G * 0.1**2 / 2, abs=1e-9) and winch.load[0] == 0
    slack.run(1.9)
    assert slack.position[1, 1] == pytest.approx(-1.0, abs=1e-6)


SPACE = tv.Particles(np.eye(3))


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: tv.Motor([[0, 1]], 1.0), r"Motor: hinges has shape \(1, 2\), but \(m, 3\)"),
        (lambda: tv.Motor([[0, 1, 2]], np.inf), r"Motor: speed\[0\] = inf"),
        (lambda: tv.Motor([[0, 1, 2]], 1.0, torque=-1.0), r"Motor: torque\[0\] = -1"),
        (lambda: setattr(tv.Motor([[0, 1, 2]], 1.0), "angle", 1.0), "Motor: angle cannot be set: it turns at a speed"),
        (lambda: tv.World(SPACE, [tv.Motor([[0, 1, 2]], 1.0, angle=-1.0)]), r"angle \(of triples in 3D\)"),
        (lambda: tv.World(tv.Particles(np.zeros((4, 2))), [tv.Motor([[0, 1, 2, 3]], 1.0)]), "no hinge of four particles in 2D"),
        (lambda: tv.Winch([[0, 1]], length=0.0), r"Winch: length\[0\] = 0"),
        (lambda: tv.World(tv.Particles(np.zeros((2, 2))), [tv.Winch([[0, 1]])]), "are in the same place"),
    ],
)
def test_bad_arguments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_winch_of_limited_force_hoists_by_a_chain(world):
    # 75 kg on links of 0.1 kg. With more force than that weighs, the rope is as long as the winch has wound it, to rounding. With
    # 0.6 of the weight m g it runs out under that pull: y = (1 - 0.6) g t^2 / 2, which a substep of constant forces has exactly.
    x, mass = np.array([[0, 5], [0, 2], [0, 1.5], [0, 1], [0, 0.7]]), np.array([1, 0.1, 0.1, 50, 25])
    winch, links = tv.Winch([(0, 1)], 0.0, force=1e4), tv.Distance([(1, 2), (2, 3), (3, 4)])
    weight = 9.81 * mass[1:].sum()
    w = world(tv.Particles(x, mass=mass, pinned=[0]), [tv.Gravity(9.81), winch, links], precision="f64")
    for _ in range(30):
        assert w.step(1 / 60).residual < 1e-6
    assert winch.load[0] == pytest.approx(weight, rel=1e-6) and w.position[1] == pytest.approx([0, 2], abs=1e-9)
    winch.speed = -0.5
    w.run(0.5)
    assert winch.rest[0] == pytest.approx(2.75, abs=1e-6) and w.position[1, 1] == pytest.approx(2.25, abs=1e-6)
    w.velocity, winch.speed, winch.force = 0 * x, 0.0, 0.6 * weight
    before = w.position
    w.run(0.5)
    assert w.position[3, 1] - before[3, 1] == pytest.approx(-0.4 * 9.81 * 0.5**2 / 2, rel=1e-4)
    assert winch.load[0] == pytest.approx(0.6 * weight, rel=1e-6)
