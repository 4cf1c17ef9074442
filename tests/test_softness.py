"""Where the substep changes: no energy comes of it, and links rest where they do in the longest frames."""

import contextlib

import numpy as np
import pytest

import tiverlet as tv

from .fuzz.scenes import Call, Set, Step, Structure
from .fuzz.trials import Trial
from .properties import SCHEDULES, scheduled
from .scenes import SCENES

G, R, SUBSTEPS = 9.81, 0.5, 8


def linked(world, x, links, mass, pinned, drag=0.0, solver=None):
    """Return a world of links that Jacobi solves; all such worlds share kernels."""
    features = [tv.Gravity(G), tv.Distance(links), tv.Drag(drag)]
    return world(tv.Particles(x, mass=mass, pinned=pinned), features, solver=solver or tv.Jacobi(), substeps=SUBSTEPS)


def net(world, drag):
    """Return a net of 11 x 11 that hangs by its upper corners."""
    shape = tv.shapes.net((0, 0), (1, 0), (0, 1), points=(11, 11))
    corners = np.flatnonzero((shape.position[:, 1] == 1) & np.isin(shape.position[:, 0], (0, 1)))
    return linked(world, shape.position, shape.links, 0.01, corners, drag)


def weight(world):
    """Return a chain with a weight of 200 links, and m g L."""
    x = np.stack([0.05 * np.arange(25), np.zeros(25)], axis=1)
    links = np.stack([np.arange(24), np.arange(1, 25)], axis=1)
    return linked(world, x, links, [0.05] * 24 + [10.0], [0]), 11.2 * G * 1.2


def test_what_auto_leaves_violated_is_not_called_good(world):
    # However soft links are: 2 substeps let them sag, and they stiffen only as energy allows.
    w, _ = weight(world)
    w.substeps = 2
    w.run(0.5)
    w.substeps = "auto"
    reports = [w.step(1 / 60) for _ in range(9)]
    assert all("stuck" in r.flags for r in reports if r.residual > 1e-2) and reports[0].residual > 0.1


@pytest.mark.slow
def test_a_net_rests_where_it_does_in_the_longest_substeps(world):
    # Half as many substeps are twice as long, and s W h^2 F is four times the sag. Where there are as many as before again, the
    # net is lifted to where it rests in these, but for corners that fold another way, and never has more energy than at first.
    short, turns = net(world, 3.0), net(world, 3.0)
    begun = short.step(1 / 60)
    short.run(6.0)
    turns.substeps = SUBSTEPS // 2
    turns.run(6.0)
    sag = np.abs(turns.position - short.position).max()
    assert sag > 5e-3
    turns.substeps = SUBSTEPS
    most = max(turns.step(1 / 60).energy for _ in range(720))
    assert np.median(np.abs(turns.position - short.position)) < 0.02 * sag
    assert most < begun.energy - begun.energy_change


@pytest.mark.parametrize("dts", [(1 / 30,), (1 / 20, 1 / 60), (1 / 7.5,)])
def test_a_late_frame_has_the_bits_of_the_frames_that_it_missed(world, dts):
    # Substeps keep their length, so a frame that is n times as long is n frames. Up to eight times as many substeps: no flag.
    one, many = net(world, 1.0), net(world, 1.0)
    for w in (one, many):
        w.run(2 / 60)
    for dt in dts:
        assert one.step(dt).substeps == round(dt * 60) * SUBSTEPS and "substeps-capped" not in one.last.flags
        for _ in range(round(dt * 60)):
            many.step(1 / 60)
    np.testing.assert_array_equal(one.position, many.position)
    assert one.last.time == pytest.approx(many.last.time, rel=1e-12)


def test_frames_of_another_rate_have_as_many_substeps_as_are_set(world):
    # 15 frames in a row that are twice as long are late; the 16th is another rate, and so is each frame until a second one is
    # about as long. Frames that differ by less than half have no rate of their own.
    def counts(*frames):
        w = net(world, 1.0)
        return [w.step(k / 60).substeps for k in frames]

    n = SUBSTEPS
    assert counts(1, 1, *[2] * 15, 1, 2) == [n, n, *[2 * n] * 15, n, 2 * n]
    assert counts(1, 1, *[2] * 17, 1) == [n, n, *[2 * n] * 15, n, n, n // 2]
    assert counts(15, 1, 1, 2) == [n, n, n, 2 * n] and counts(1, 0.5, 0.5) == [n, n, n]
    assert counts(0.06, 1, 1, 2) == [n, n, n, 2 * n] and counts(1, 15, 1, 1, 2) == [n, n, n, n, 2 * n]
    assert counts(1, 1, *[0.7] * 17) == [n, n, *[round(0.7 * n)] * 17] and counts(1, 1, 0.01) == [n, n, 1]


def test_a_frame_that_is_far_too_late_says_so(world):
    # 12 times as late, of which 8 times as many substeps are taken: each is 12 / 8 times as long. So is it in many worlds.
    w = net(world, 1.0)
    copies = tv.Worlds(w, 2)
    for each in (w, copies):
        each.run(2 / 60)
        report = each.step(0.2)
        assert report.substeps == 8 * SUBSTEPS and "substeps-capped" in report.flags
        assert "substeps-capped" not in each.step(1 / 60).flags
        assert each is copies or any("12 times as long" in note and "1.5 times as long" in note for note in report.notes)
    np.testing.assert_array_equal(copies.position[0], w.position)


@pytest.mark.slow
def test_a_net_comes_to_rest_in_frames_of_any_length(world):
    # Frames differ by up to a fifth. At a start, velocities lack half a kick of the old substep, so what is at rest gets
    # g (h - h_old) / 2, and moves by less than g (h_max - h_min). If stiffness changed with h, it would be 50 times as fast.
    w, rng, fastest = net(world, 1.0), np.random.default_rng(0), []
    for frame in range(900):
        assert "energy-gain" not in w.step(rng.uniform(0.8, 1.2) / 60).flags
        if frame >= 780:
            fastest.append(np.sqrt(2 * tv.measure.kinetic_energy(w) / w.particles.mass[w.particles.inv_mass > 0].sum()))
    assert np.mean(fastest) < G * 0.4 / 60 / SUBSTEPS


def pile(world, x, r, wide, friction=0.0):
    """Return a world with discs in an open box; all such worlds share kernels with friction."""
    contact, box = tv.Contact(friction=0.5), tv.Box((0, 0), (wide, np.inf), friction=0.5)
    w = world(tv.Particles(x, radius=r), [tv.Gravity(G), contact, box], substeps=4, precision="f64")
    contact.friction = box.friction = friction
    return w


@pytest.mark.slow
def test_frames_much_shorter_than_the_last_throw_nothing(world):
    # A jammed pile under steps of 1/60 s, 10 us and 0.1 ms in turns, as a loop measures them. The overlap that the moves leave
    # would store (h / h')^2, up to 1e6, times its energy: 5e5 J in the first step. At most it lifts the pile by what it has
    # sagged, and sags again. The contact below j of k layers overlaps in proportion to j, so that particles sag by 2/3 k of the
    # mean overlap on average. Without friction the pile presses sideways, too, by as much: 4/3 in all.
    n, wide, r = 200, 2.4, 0.06
    w = pile(world, r + tv.golden(np.arange(n), dim=2) * (wide - 2 * r, 4 * n * r**2 * 1.8 / wide), r, wide)
    w.run(4.0)
    start, lift = w.last.energy, n * G * 4 / 3 * (n * 2 * r / wide) * w.contacts.overlap.mean()
    for dt in (1e-5, 1e-5, 1 / 60, 1e-4, 1 / 60, 1e-5, 1e-4):
        report = w.step(dt)
        assert report.clean and report.energy < start + lift and np.abs(w.velocity).max() < 1.0
    assert w.run(0.5).clean and w.last.energy < start + lift / 10
    w.add(tv.Particles([[wide / 2, 9.0]], radius=r))  # added particles do not keep those that lie there from being lifted
    w.step(1e-4)
    assert w.last.energy < start + lift + 9.0 * G and np.abs(w.velocity).max() < 1.0


@pytest.mark.slow
def test_what_lies_keeps_its_energy_in_frames_that_a_loop_measures(world):
    # A column, in frames that are up to a tenth longer or shorter than 1/60 s.
    n, rng, kinetic = 12, np.random.default_rng(0), []
    w = pile(world, np.stack([np.full(n, 9.0), R + np.arange(n)], axis=1), R, 18.0)
    start, lift = w.run(6.0).energy, 1e-4 * n * n * G * R
    for _ in range(600):
        report = w.step(rng.uniform(0.9, 1.1) / 60)
        kinetic.append(tv.measure.kinetic_energy(w))
        assert report.clean and report.energy < start + lift
    assert np.mean(kinetic) < lift / 30
    for k in range(60):  # nor where a force changes in each frame, as with a mouse
        w.features[0].g = G + 1e-6 * k
        assert w.step(rng.uniform(0.9, 1.1) / 60).energy < start + lift
    # A heap that friction holds does not creep down. If discs were moved apart whenever a frame is shorter, it would.
    w = pile(world, [(4 + i + 0.5 * j + 0.02 * np.sin(i), 0.5 + 0.9 * j) for j in range(4) for i in range(8 - j)], R, 18.0, 0.5)
    rest = w.run(6.0).energy
    for _ in range(300):
        w.step(np.exp(rng.normal(0, 0.2)) / 60)
    assert w.last.energy == pytest.approx(rest, rel=1e-2)


@pytest.mark.slow
def test_a_lattice_that_swings_keeps_its_energy_where_the_substep_gets_shorter(world):
    # Clusters of 6 x 6 share particles, hang from one and sag at 2 substeps by what passes leave. At 20 they have the shape that
    # they had at rest, and swing on. Without rows of soft and of large clusters 283 J became 326 and 291; with gradients that
    # leave out how a deformed cluster turns with its particles, rows that contradict each other would stop all motion.
    g = np.stack(np.meshgrid(np.arange(10), np.arange(6), indexing="ij"), axis=-1).reshape(-1, 2)
    clusters = [np.flatnonzero((g[:, 0] >= k) & (g[:, 0] < k + 6)) for k in range(0, 5, 2)]
    w = world(tv.Particles(0.2 * g, pinned=[5]), [tv.Gravity(9.81), tv.ShapeMatch(clusters, compliance=1e-7)], substeps=2)
    before = [w.step(1 / 60) for _ in range(20)][-1]
    w.substeps = 20
    after = [w.step(1 / 60) for _ in range(3)]
    kinetic = before.energy - 9.81 * (w.position[:, 1]).sum()
    assert before.energy - 0.1 * kinetic < min(r.energy for r in after) and max(r.energy for r in after) < before.energy + 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "a taut net between four pins",
        "a tent and a bag hang by ropes",
        "a wheel and a drawbridge hang by bars",
        "cantilevers of areas and of clusters",
        "a box of links hangs on a rope over discs",
    ],
)
def test_seconds_after_the_last_change_of_the_substep_nothing_tells_of_it(taichi, name):
    # Beside drag, which takes out motion: positions to 1e-3 of the size, loads to 3e-3 of the largest, whatever happened before.
    scene, labels, ends = SCENES[name], ("constant", "random", "uneven", "auto", "a hitch of 0.1 s"), []
    features = [call for call in scene.structure.features if call.name != "Drag"] + [Call("Drag", {"rate": 4.0})]
    with contextlib.closing(Trial(Structure(scene.structure.particles, tuple(features), scene.structure.settings))) as trial:
        for label in labels:
            last = [Set(None, "substeps", 20), *[Step(1 / 60)] * 300]
            trial.replay([*scheduled(name, SCHEDULES[label]), *last])
            borne = [f.load for f in trial.features if isinstance(f, (tv.Distance, tv.Rope, tv.ShapeMatch))]
            loads = np.concatenate([np.abs(load).reshape(len(load), -1).max(axis=1) for load in borne])
            ends.append((trial.world.position, loads))
            assert "softened" not in trial.world.last.flags
    (x, loads), size = ends[0], np.ptp(ends[0][0], axis=0).max()
    for label, (after, also) in zip(labels, ends, strict=True):
        assert np.abs(after - x).max() < 1e-3 * size, label
        assert np.abs(also - loads).max() < 3e-3 * loads.max(), label
