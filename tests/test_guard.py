"""substeps="auto", tolerance and budget: frames are repeated until they are good."""

import contextlib

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.report import CASES
from tiverlet.step import checkpoint
from tiverlet.step.adaptive import StepController

from .conftest import case, rms
from .fuzz.trials import Trial
from .scenes import SCENES

G, DT = 9.81, 1 / 60


def chain(world, name):
    """Return a world with the chain of a case under "auto"."""
    particles, features = CASES[name].build()
    return world(particles, features, precision="f64", solver=tv.Direct(), substeps="auto")


def anew(w, x, v=0.0, substeps="auto"):
    """Put a world back to positions and velocities, with a new controller."""
    w.velocity, w.position, w._controller, w.substeps = v + 0 * x, x, StepController(), substeps


def test_mass_ratios(world):
    # Heavy ends of 1e4, 1e5 and 1e6 times the links, each with its own controller. Without a failure, the prototypes reach
    # 4.4e-5, 6.7e-6, 7.2e-7 m at t = 1 s. If the controller leaves the substeps alone, these are wrong by more than a link.
    for ratio, aim in ((10000, 4.4e-5), (100000, 6.7e-6), (1000000, 7.2e-7)):
        w = chain(world, f"D07_massratio_{ratio}")
        report = w.run(1.0)
        assert report.clean and report.turn == 0 and report.residual <= 1e-2 and report.tension <= 2.0
        want = np.atleast_2d(case(f"D07_massratio_{ratio}")["values"]["t1.0"]["heavy_xy"])
        assert rms(w.position[[2]], want) < aim
        assert w.last.tries == 1  # the controller has settled


def test_auto_takes_at_least_the_usual_substeps_where_no_tolerance_and_no_budget_is_given(world):
    # Late frames too, and once links come to what fell freely.
    rope = tv.shapes.rope((0, 0), (1, 0), points=5)
    scene = tv.Particles(rope.position, radius=0.01), [tv.Gravity(G), tv.Contact()]
    auto, usual = (world(scene[0], [f.copy() for f in scene[1]], substeps=s) for s in ("auto", None))
    assert auto.substeps == usual.substeps == 4
    for k, dt in enumerate([DT, DT, 3 * DT, 8 * DT, 9 * DT, DT, DT / 4, DT, DT]):
        if k == 7:
            for w in (auto, usual):
                w.add(features=[tv.Distance(rope.links)])
        least = usual.step(dt).substeps
        assert auto.step(dt).substeps >= least
    assert least == usual.substeps == 20 <= auto.substeps
    for fewer in ({"tolerance": 0.5}, {"budget": 1e-6}):
        assert min(auto.step(DT, **fewer).substeps for _ in range(8)) < 20
        assert auto.step(DT).substeps >= 20


def rattle():
    """Return three balls on stiff springs that fall on a floor, which makes them vibrate at 1700 rad/s."""
    x, links = [(0, 0.5), (0.3, 0.5), (0.15, 0.8)], tv.Distance([(0, 1), (1, 2), (0, 2)], compliance=1e-5)
    floor = tv.HalfSpace((0, 1), friction=0.3)
    return tv.Particles(x, radius=0.05, mass=0.1, velocity=(0.5, -3.0)), [tv.Gravity(G), links, floor, tv.Contact(0.3)]


def sling():
    """Return a bob on a rod on a spring that vibrates at 300 rad/s in air."""
    springs = [tv.Distance([(0, 1)], 1.0, compliance=1 / 300**2), tv.Distance([(1, 2)])]
    return tv.Particles([(0, 0), (1.1, 0), (1.1, 0.5)], pinned=[0]), [tv.Gravity(G), tv.Drag(1.0), *springs]


ACCURATE = {  # frames after which scenes do not depend on rounding yet, and how many times as accurate "auto" is
    "beads collide in free space": (40, 1), "a row of discs falls asleep and is hit": (30, 1), "a cart falls on a truss": (20, 1),
    "spheres spin roll and grip in a box": (15, 1), "a rope swings from one end": (40, 1), "rattle": (30, 4), "sling": (15, 5),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", ACCURATE)
def test_auto_is_at_least_as_accurate_as_the_usual_substeps(taichi, world, name):
    # Bodies that strike, billiards, a whip, and vibrations, which the usual substeps damp, next to 640 substeps.
    frames, times = ACCURATE[name]
    if name in SCENES:
        structure = SCENES[name].structure
        start, features = structure.particles.make(), [f.make() for f in structure.features]
    else:
        start, features = globals()[name]()
    w = world(start, features, precision="f64", path="fused")
    kept, ends = checkpoint.keep(w), {}
    for substeps in (640, None, "auto"):
        checkpoint.install(w, kept, checkpoint.flags(w))
        w.substeps = substeps
        ends[substeps] = np.array([(w.step(DT), w.position)[1] for _ in range(frames)])
    usual, auto = (np.abs(ends[s] - ends[640]).max() for s in (None, "auto"))
    assert auto * times <= usual


@pytest.mark.slow
def test_auto_leaves_no_overlap_that_is_flagged(taichi):
    # In 4 substeps grains are pressed together by 8 % of their radius once; 8 leave 1 %.
    with contextlib.closing(Trial(SCENES["grains of many sizes are poured"].structure)) as trial:
        for substeps, flags in ((None, {"compressed"}), ("auto", set())):
            trial.reset()
            trial.world.substeps = substeps
            reports = [trial.world.step(DT) for _ in range(40)]
            assert set().union(*(r.flags for r in reports)) == flags
        assert sum(r.substeps > 4 for r in reports) < 8


@pytest.mark.parametrize("brake", ["drag", "dashpot"])
def test_what_vibrates_is_resolved_as_far_as_its_brakes_leave_energy_to_it(world, brake):
    # A mass on a spring of s = omega h = 0.26 at the usual substeps, which take theta / alpha u^2 of its energy in each. A brake
    # takes c u^2 / h, and a tenth of that may be lost beside it: c = 10 theta h / alpha is enough for the usual substeps.
    alpha, h = 1e-5, DT / 20
    s4 = (h * h / alpha) ** 2
    enough = 10 * s4 / (1 + s4) * h / alpha
    for share, doubled in ((1.4, False), (1 / 1.4, True)):
        air = [tv.Drag(share * enough)] * (brake == "drag")
        pin = tv.Pin([0], (0.0, 0.0), compliance=alpha, damping=share * enough * (brake == "dashpot"))
        w = world(tv.Particles([(0.1, 0.0)]), [pin, *air], substeps="auto", precision="f64")
        assert (max(w.step(DT).substeps for _ in range(10)) > 20) == doubled


def test_a_tolerance_is_met_with_less_where_less_is_needed(world):
    # Residuals of Jacobi fall with h^2. A swing needs more substeps when it is fast, and fewer when it hangs.
    rope = tv.shapes.rope((0, 0), (1, 0), points=11)
    features = [tv.Gravity(G), tv.Drag(3.0), tv.Distance(rope.links)]
    w = world(tv.Particles(rope.position, pinned=[0]), features, precision="f64", solver=tv.Jacobi())
    used = []
    for tolerance in (1e-2, 1e-3):
        anew(w, rope.position, substeps=20)
        w.step(DT)
        reports = [w.step(DT, tolerance=tolerance) for _ in range(150)]
        assert all(r.residual <= tolerance and r.clean for r in reports)
        assert min(r.residual for r in reports[60:]) > tolerance / 50  # not far better than requested
        used.append([r.substeps for r in reports])
    assert np.mean(used[1]) > 2 * np.mean(used[0])
    assert w.substeps == 20  # the user's own number stays


def test_a_tolerance_is_one_of_the_motion(world):
    # Direct solutions leave no residual, but a rod that turns by phi in a substep turns too fast or too slowly by phi^2 / 24.
    # This error is relative: in 2 s of the double pendulum D01 it becomes about ten times as much in metres, for any tolerance.
    # So a tolerance may do with fewer substeps than usual: with one a frame the error is 4e-3 m.
    w = chain(world, "D01_double_pendulum")
    for tolerance in (1e-4, 1e-5, 2e-6):
        anew(w, w.particles.position)
        assert w.run(2.0, tolerance=tolerance).clean
        error = rms(w.position[1:], case("D01_double_pendulum")["values"]["t2.0"]["xy"])
        assert 3 * tolerance < error < 15 * tolerance


@pytest.mark.slow
def test_a_tolerance_is_one_of_vibrations_beads_and_rigid_bodies(world):
    # A spring, 1 + a cos(omega t): at a rate that is wrong by e it is off by e omega t a, where e a is what is asked, relative to
    # its length. No residual tells: one substep a frame was taken, which is off by 0.098 m after 2 s.
    k, a, t = 400.0, 0.3, 2.0
    x, omega = np.array([[0.0, 0.0], [1.0 + a, 0.0]]), k**0.5
    w = world(tv.Particles(x, pinned=[0]), [tv.Distance([(0, 1)], 1.0, compliance=1 / k)], precision="f64", substeps="auto")
    for tolerance in (1e-3, 1e-5):
        anew(w, x)
        assert w.run(t, tolerance=tolerance).clean
        assert abs(w.position[1, 0] - 1 - a * np.cos(omega * t)) < (1 + a) * tolerance * omega * t
    # A bead on a ring of wire is a pendulum, for which rods ask the same: some three times the tolerance in 1 s, next to 640
    # substeps. Without, it was off by 6e-4 m whatever was asked.
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring, x = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.array([[1.0, 0.0]])
    w = world(tv.Particles(x), [tv.Gravity(G), tv.Path([0], ring, closed=True)], precision="f64", substeps=640)
    w.run(1.0)
    want = w.position.copy()
    for tolerance in (1e-4, 1e-6):
        anew(w, x, substeps=640)
        assert w.run(1.0, tolerance=tolerance).clean
        assert np.abs(w.position - want).max() < 4 * tolerance
    # A plate that swings from a corner, one cluster: solved to rounding at any substep, one a frame for a tolerance of 1e-2, by
    # which its energy errs by 1e-2 m g L.
    x = np.stack(np.divmod(np.arange(15), 5), axis=1) * 0.1
    w = world(tv.Particles(x, pinned=[0]), [tv.Gravity(G), tv.ShapeMatch([range(15)])], substeps="auto")
    supply, used = G * 14 * 0.4, []
    for tolerance in (1e-2, 1e-4, 1e-5):
        anew(w, x)
        energy = [w.step(DT, tolerance=tolerance).energy for _ in range(60)]
        used.append((np.max(energy) - G * x[1:, 1].sum()) / supply)
    assert used[0] > 3e-3 and used[1] < 1e-3 and used[2] < 1e-4, used


def test_what_no_effort_improves_is_said_and_not_tried_each_time(world):
    # A rod of 1 m between anchors 3 m apart, by way of one particle: whatever the effort, half of the missing length remains.
    rods = tv.Distance([(0, 1), (1, 2)], rest=[1.0, 1.0])
    start = tv.Particles([(0, 0), (1.5, 0.1), (3, 0)], pinned=[0, 2])
    w = world(start, [tv.Gravity(G), tv.Drag(5.0), rods], substeps="auto")
    reports = [w.step(DT) for _ in range(60)]
    assert all("stuck" in r.flags for r in reports) and "contradict" in reports[0].notes[-1]
    assert sum(r.tries > 1 for r in reports) < 15 and max(r.tries for r in reports) < 10
    assert w.position[1] == pytest.approx([1.5, 0.0], abs=2e-2)


@pytest.mark.slow
def test_springs_vibrate_on_under_auto_and_cost_nothing_where_they_are_quiet(world):
    # A mass drawn to a place: a^2 / (2 alpha) stays. Nothing else asks for substeps, and in one of 1/60 s with alpha = 1e-3 m/N,
    # s = 0.5, a hundredth of it was left after 4 s; with 1e-5 m/N nothing after a tenth of a second.
    x, pin = np.array([[0.1, 0.0]]), tv.Pin([0], (0.0, 0.0), compliance=1e-3)
    w = world(tv.Particles(x), [pin], substeps="auto")
    for pin.compliance, seconds in ((1e-3, 4.0), (1e-5, 1.0)):
        anew(w, x)
        assert w.run(seconds).energy == pytest.approx(0.005 / pin.compliance[0], rel=0.01)
    # A bridge of springs of 1e6 N/m swings. At omega dt = sqrt(40 / alpha) / 60 = 105, some 1000 substeps would resolve how its
    # links vibrate, s = 0.1. It takes no more than a bridge of rigid links.
    bridge = tv.shapes.rope((0, 0), (1, 0), points=11)
    x = bridge.position - [0, 1] * (0.2 * np.sin(np.pi * bridge.position[:, :1]))
    links = tv.Distance(bridge.links, compliance=1e-6)
    w = world(tv.Particles(x, mass=0.05, pinned=[0, 10]), [tv.Gravity(G), links], substeps="auto", precision="f64")
    assert max(w.step(DT).substeps for _ in range(120)) <= 64
    # Springs of more than 8 periods in a frame, omega dt = 74 here, are left unresolved, and a flag says what that loses.
    bridge = tv.Particles([(0, 0), (1.001, 0)], mass=0.05, pinned=[0])
    w = world(bridge, [tv.Gravity(0.0), tv.Distance([(0, 1)], 1.0, compliance=1e-6)], substeps="auto", precision="f64")
    assert max(w.step(DT).substeps for _ in range(30)) <= 20 and w.last.flags == {"energy-loss"}


def test_a_truss_on_a_roller_settles(world):
    # A king post of links that one pass of Jacobi holds, pinned at one foot; the other runs on a wire. Each joint weighs m g.
    # Half of what hangs from the top, 2 m g, goes to each foot, so rafters bear sqrt(a^2 + b^2) / b m g, the tie beam a / b m g,
    # and the post m g. One substep a frame is enough until the sag is there, some 10 frames later. It was tried again at once,
    # for good: loads went from 2 to 100 N at the tie beam, and to -188 N at a rafter.
    a, b, m = 2.0, 3.0, 5.0
    links = tv.Distance([[0, 1], [1, 2], [0, 3], [2, 3], [1, 3]])
    start = tv.Particles([(0, 0), (a, 0), (2 * a, 0), (a, b)], mass=m, pinned=[0])
    wire = tv.Path([2], [(a, 0), (3 * a, 0)], smooth=False)
    w = world(start, [tv.Gravity(G), tv.Drag(1.0), links, wire], substeps="auto", precision="f64", solver=tv.Jacobi())
    used = [w.step(DT).substeps for _ in range(200)]
    rafter = -((a * a + b * b) ** 0.5) / b
    want = m * G * np.array([a / b, a / b, rafter, rafter, 1.0])
    for _ in range(150):
        used.append(w.step(DT).substeps)
        assert links.load == pytest.approx(want, abs=0.2 * m * G)
    assert np.count_nonzero(np.diff(used)) < 12 and len(set(used[-150:])) == 1


def test_too_much_for_the_budget_is_said(world):
    rope = tv.shapes.rope((0, 0), (1, 0), points=41)
    w = world(tv.Particles(rope.position, pinned=[0]), [tv.Gravity(G), tv.Distance(rope.links)], solver=tv.Jacobi())
    for _ in range(20):
        report = w.step(DT, tolerance=1e-9, budget=1e-9)
        assert report.flags - {"unconverged"} == {"substeps-capped"} and report.tries == 1 and "budget" in report.notes[-1]
    rich = [w.step(DT, budget=0.05) for _ in range(10)]
    assert max(r.substeps for r in rich) > 64  # all that fits: a substep of 40 links takes some microseconds
    for wrong in (0, -1e-3, np.nan, np.inf):
        for name in ("tolerance", "budget"):
            with pytest.raises(ValueError, match=name):
                w.step(DT, **{name: wrong})
    with pytest.raises(ValueError, match="substeps = 'adaptive', but it must be an integer of at least 1, \"auto\" or None"):
        w.substeps = "adaptive"


@pytest.mark.slow
def test_what_falls_through_a_soft_center_comes_back(world):
    # A Plummer sphere: E = v^2 / 2 - G M / sqrt(r^2 + e^2) per mass. Particles at rest at 1 m fall through the centre, or past
    # it, and come back to that distance. A circle of radius r has omega^2 = G M / (r^2 + e^2)^(3/2).
    pull, e, r = 4.0, 0.05, 0.3
    omega = np.sqrt(pull / (r * r + e * e) ** 1.5)
    x, v = np.array([[1.0, 0.0], [0.0, 1.0], [r, 0.0]]), np.array([[0.0, 0.0], [0.02, 0.0], [0.0, omega * r]])
    w = world(tv.Particles(x, velocity=v), [tv.Attractor((0, 0), pull, softening=e)], substeps="auto", precision="f64")
    kinetic, energy = (v**2).sum() / 2, (v**2).sum() / 2 - (pull / np.sqrt((x**2).sum(axis=1) + e * e)).sum()
    for _ in range(960):
        report = w.step(1 / 240)
        kinetic = max(kinetic, tv.measure.kinetic_energy(w))
        assert not report.flags and abs(report.energy - energy) < 0.02 * kinetic
    assert np.linalg.norm(w.position[2]) == pytest.approx(r, rel=0.01)


S, END = 0.1, 0.35  # [m]: where the Lennard-Jones force is 0, and where it ends


@ti.func
def collide(r):
    """Return the force 24 (2 (s / r)^12 - (s / r)^6) / r, along r."""
    q = (S * S / r.norm_sqr()) ** 3
    return 24.0 * (2.0 * q * q - q) / r.norm_sqr() * r


@ti.func
def collide_energy(r):
    """Return the potential 4 ((s / r)^12 - (s / r)^6), shifted to 0 where the force ends."""
    q, end = (S * S / r.norm_sqr()) ** 3, (S / END) ** 6
    return 4.0 * (q * q - q) - 4.0 * (end * end - end)


@pytest.mark.slow
def test_how_two_atoms_vibrate_is_resolved_wherever_they_are(world):
    # The same substeps and the same energy of two atoms: alone, at 100 m/s, beside many at rest, and among some that fly.
    x, still = np.array([[0.0, 0.0], [0.115, 0.0]]), 10.0 + np.stack([np.arange(300) % 20, np.arange(300) // 20], axis=1)
    q, end, used = (S / 0.115) ** 6, (S / END) ** 6, []
    begin = 4.0 * (q * q - q - end * end + end)
    for others, v, u in ((still[:0], 0.0, 0.0), (still[:0], 100.0, 100.0), (still, 0.0, 0.0), (still[:5], 0.0, 300.0)):
        speed = np.zeros((2 + len(others), 2))
        speed[:2, 0], speed[2:, 1] = v, u
        force = tv.PairForce(collide, END, potential=collide_energy)
        w = world(tv.Particles(np.vstack([x, others]), velocity=speed), [force], substeps="auto", precision="f64")
        reports = [w.step(DT) for _ in range(120)]
        apart, faster = np.diff(w.position[:2], axis=0)[0], np.diff(w.velocity[:2], axis=0)[0]
        q = (S / np.linalg.norm(apart)) ** 6
        used.append([r.substeps for r in reports])
        assert abs(4.0 * (q * q - q - end * end + end) + faster @ faster / 4 - begin) < 0.02
        assert used[-1] == used[0] and not any(r.flags for r in reports)


@pytest.mark.slow
def test_what_stands_stays_on_its_feet_where_the_substep_gets_shorter(world):
    # A block of links, twice as high as wide, on a slope of 15 degrees with friction 0.6 > tan 15: its weight acts through
    # 2 tan 15 = 0.54 half widths from the middle, so all feet bear some of it, and none leaves the ground or walks. The links
    # between feet are stretched by e, which friction bears. What takes that out lifts a foot by less than it had sagged, and the
    # block does not walk: half a second later each foot is on the ground and has moved by less than that.
    corners = np.indices((2, 2, 2)).reshape(3, -1).T * [1.0, 2.0, 1.0]
    slope, pairs = np.radians(15.0), np.stack(np.triu_indices(len(corners), 1), axis=1)
    down = np.array([np.sin(slope), -np.cos(slope), 0.0])
    floor, up = tv.HalfSpace((0, 1, 0), friction=0.6), corners[:, 1] == 0
    w = world(tv.Particles(corners), [tv.Gravity(G * down), tv.Distance(pairs), floor], substeps=2, precision="f64")
    for turns in ((2, 30), (4, 100)):
        w.substeps = turns[0]
        w.run(1.0)
        before = w.position
        sag = np.ptp([np.linalg.norm(before[i] - before[j]) - np.linalg.norm(corners[i] - corners[j]) for i, j in pairs])
        w.substeps = turns[1]
        w.step(DT)
        assert w.position[up, 1].max() < sag and np.abs(w.velocity).max() < 0.1
        w.run(0.5)
        moved = (w.position - before)[up]
        assert w.position[up, 1].max() < 0.02 * sag and np.abs(moved[:, 0]).max() < sag


@pytest.mark.slow
def test_few_substeps_that_do_not_help_are_not_the_last_word(world):
    # A figure lands on straight legs: two and four substeps leave as much violation as one, and 16 do not.
    s = tv.shapes.ragdoll((0, 0.5))
    floor = tv.HalfSpace((0, 1), friction=0.6)
    w = world(tv.Particles(s.position, mass=5.0, radius=0.05), [tv.Gravity(G), tv.Distance(s.links), floor], substeps="auto")
    reports = [w.step(DT) for _ in range(40)]
    assert not any(r.flags for r in reports[25:]) and max(r.residual for r in reports[21:]) < 0.1  # 1 at 1 to 4 substeps
