"""Bend, AngleLimit and Dihedral: signs, straight and folded corners, limits that stop; and constraints that break as set."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.constraints.core.quantity import differences
from tiverlet.step import checkpoint

from .conftest import rerun
from .test_references import line


def triples(n: int) -> np.ndarray:
    """Return the corners of a chain of n particles."""
    k = np.arange(n - 2)
    return np.stack([k, k + 1, k + 2], axis=1)


@pytest.mark.slow
def test_rods_swing_through_straight_and_every_compliance_is_stable(world):
    # Row 56: an unsigned angle has a kink at straight. With the remembered side, a free rod moves in 3D as in 2D, without a
    # flag.
    # Rows 8, 9, 12: clamped beams from rigid to soft, with one pass: the kinetic energy never exceeds its initial value plus
    # the work of gravity.
    n, alphas, made = 21, (0.0, 1e-12, 1e-6, 1e-3, 1e-1, 1.0, 1e3, 1e12), []
    m, rod = len(alphas), 6
    for dim in (2, 3):
        x, v = np.zeros((m, n, dim)), np.zeros((m, n, dim))
        x[:, :, 0], x[:, :, 1] = 0.05 * np.arange(n), 10.0 * np.arange(m)[:, None]
        v[:, 2:, -1] = 0.3 * np.sin(7.0 * np.arange(2, n))
        y, u = np.zeros((rod, dim)), np.zeros((rod, dim))
        y[:, 0], u[:, 1] = 0.1 * np.arange(rod) - 1, 0.5 * np.sin(3.0 * np.arange(rod))
        corners = np.concatenate([triples(n) + n * c for c in range(m)] + [triples(rod) + m * n])
        links = np.concatenate([line(n - 1) + n * c for c in range(m)] + [line(rod - 1) + m * n])
        bend = tv.Bend(corners, 0.0, compliance=[*np.repeat(alphas, n - 2), 0.0, 1e-3, 1e-1, 10.0])
        held = np.arange(m * n).reshape(m, n)[:, :2].ravel()
        start = tv.Particles(
            np.concatenate([x.reshape(-1, dim), y]), velocity=np.concatenate([v.reshape(-1, dim), u]), mass=0.1, pinned=held
        )
        w = world(start, [tv.Gravity(9.81), tv.Distance(links), bend], substeps=4, precision="f64", solver=tv.Jacobi())
        begin = 0.05 * (v**2).sum(axis=(1, 2))
        for _ in range(180):
            w.step(1 / 60)
            supplied = 0.1 * 9.81 * (x[..., 1] - w.position[:-rod].reshape(x.shape)[..., 1]).sum(axis=1)
            speed = w._runner.memory.state()["displacement"][:-rod].reshape(x.shape) * 240
            assert (0.05 * (speed**2).sum(axis=(1, 2)) <= begin + supplied * 1.001 + 1e-4).all()
        made.append((w.position[-rod:], np.abs(bend.load[-rod + 2 :])))
    np.testing.assert_allclose(made[1][0][:, :2], made[0][0], atol=1e-9)
    np.testing.assert_array_equal(made[1][0][:, 2], 0.0)
    np.testing.assert_allclose(made[1][1], made[0][1], atol=1e-6)
    # The side from which each corner is seen is part of the state: restored after another run, the world repeats the same bits.
    kept, ends = checkpoint.keep(w), []
    for _ in range(2):
        w.run(0.1)
        ends.append(w.position)
        rerun(w, 0.1)
        checkpoint.put_back(w, kept)
    np.testing.assert_array_equal(*ends)


def test_a_crooked_rod_is_straightened_without_velocity_in_space(world):
    # Rods of rigid angles that start crooked by 0.2 rad are moved to where they are straight, at rest. If Newton's method may
    # bend a path across its plane at will, it ends at 5e-3 rad, and passes make 0.06 m/s of the rest.
    n, rng = 8, np.random.default_rng(0)
    x = np.zeros((n, 3))
    x[:, 0], x[2:, 1:] = 0.1 * np.arange(n), 0.02 * rng.normal(size=(n - 2, 2))
    rod = [tv.Distance(line(n - 1), 0.1), tv.Bend(triples(n), 0.0)]
    w = world(tv.Particles(x, mass=0.1, pinned=[0, 1]), rod, precision="f64", solver=tv.Jacobi())
    assert w.step(1 / 60).flags == {"moved"}
    assert np.abs(w.position[:, 1:]).max() < 1e-8 and np.abs(w.velocity).max() < 1e-7


def test_angles_have_signs_and_wrap(world):
    # In 2D positive is to the left. From 3 rad to -3 rad the angle turns by 0.28 rad through folded, not by 6 through straight.
    a = np.array([0.5, -0.5, 3.0, -3.0])
    x = np.zeros((4, 3, 2))
    x[:, 0, 0], x[:, 2, 0], x[:, 2, 1] = -1.0, np.cos(a), np.sin(a)
    x = (x + 10 * np.arange(4)[:, None, None]).reshape(-1, 2)
    corners = np.arange(12).reshape(4, 3)
    bend, want = tv.Bend(corners, compliance=1e-3, damping=80.0), np.array([-0.5, 0.5, -3.0, 3.0])
    links = tv.Distance(np.concatenate([corners[:, :2], corners[:, 1:]]))
    w = world(tv.Particles(x, pinned=corners[:, :2].ravel()), [links, bend], iterations=4, precision="f64")
    np.testing.assert_allclose(bend.rest, a)
    bend.rest = want
    angles = []
    for _ in range(120):
        w.step(1 / 60)
        angles.append(bend.rest_of(w.position))
    np.testing.assert_allclose(angles[-1], want, atol=1e-6)
    assert (np.abs(np.array(angles)[:, :2]) < 0.51).all() and (np.abs(np.array(angles)[:, 2:]) > 2.99).all()
    assert not w.last.flags
    with pytest.raises(ValueError, match=r"Bend: rest\[1\] = 9"):
        bend.rest = [0.0, 9.0, 0.0, 0.0]


def test_limbs_stop_at_their_limits(world):
    # A forearm on a fixed upper arm falls to its limit and rests there with the moment m g l cos. Between the limits it is free.
    x = np.array([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0], [-1.0, 5.0], [0.0, 5.0], [1.0, 5.0]])
    limit = tv.AngleLimit([[0, 1, 2]], -1.2, 2.5)
    features = [tv.Gravity(9.81), tv.Distance([[1, 2], [4, 5]]), limit, tv.Drag(3.0)]
    w = world(tv.Particles(x, pinned=[0, 1, 3, 4]), features, substeps=40, iterations=8, precision="f64")
    w.run(0.2)
    np.testing.assert_allclose(w.position[2], w.position[5] - [0, 5], atol=1e-12)  # no limit reached: as without one
    assert limit.load[0] == 0
    w.run(5.0)
    assert np.arctan2(w.position[2, 1], w.position[2, 0]) == pytest.approx(-1.2, abs=1e-4) and w.position[5, 1] < 4.01
    assert limit.load[0] == pytest.approx(9.81 * np.cos(1.2), rel=1e-3)
    limit.lower = -1.5
    rerun(w, 5.0)
    assert np.arctan2(w.position[2, 1], w.position[2, 0]) == pytest.approx(-1.5, abs=1e-4)
    with pytest.raises(ValueError, match=r"lower\[0\] = 3 and upper\[0\] = 2.5, but lower must not exceed upper"):
        limit.lower = 3.0
    with pytest.raises(ValueError, match="more than a turn apart"):
        tv.AngleLimit([[0, 1, 2]], -4.0, 4.0)
    with pytest.raises(ValueError, match=r"lower \(in 3D\)\[0\] = -1, but it must be at least 0"):
        world(tv.Particles(np.eye(3)), [tv.AngleLimit([[0, 1, 2]], -1.0, 1.0)])


def test_hinged_triangles_fold_to_either_side(world):
    # Positive towards e x p: with the edge along x and a wing at +y, towards +z. Flat and folded are as smooth as other angles.
    wings = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0]])
    x = np.concatenate([wings + [0, 0, 3.0 * k] for k in range(4)])
    quads = np.arange(16).reshape(4, 4)
    want = np.array([0.8, -0.8, 3.1, 0.0])
    bend = tv.Dihedral(quads, want, compliance=1e-2, damping=20.0)
    sides = np.concatenate([quads[:, [a, 3]] for a in (0, 1)])
    w = world(tv.Particles(x, pinned=quads[:, :3].ravel()), [bend, tv.Distance(sides)], iterations=4, precision="f64")
    w.run(6.0, dt=1 / 30)
    np.testing.assert_allclose(bend.rest_of(w.position), want, atol=1e-5)
    z = w.position.reshape(4, 4, 3)[:, 3, 2] - 3 * np.arange(4)
    np.testing.assert_allclose(z, np.sin(want), atol=1e-5)
    with pytest.raises(ValueError, match="Dihedral: there is no angle"):
        world(tv.Particles(np.zeros((4, 2))), [tv.Dihedral([[0, 1, 2, 3]])])


def test_a_rope_tears_where_it_is_told_to(world):
    # Link k of a hanging chain of 8 carries (8 - k) m g = 9.81 (8 - k) N. Only link 3 is too weak: it carries 49 N and has
    # break_at = 45. test_determinism.py tests breaking with a thread team.
    strength = np.full(8, 200.0)
    strength[[3, 6]] = 45.0, 25.0
    rope = tv.Distance(line(8), 1.0, break_at=strength)
    y = np.stack([np.zeros(9), -np.arange(9.0)], axis=1)
    w = world(tv.Particles(y, pinned=[0]), [tv.Gravity(0.0), rope, tv.Drag(5.0)], substeps=10, iterations=12, precision="f64")
    events, gravity = [], w.features[0]
    for frame in range(30):
        gravity.g = (0.0, -9.81 * min(1.0, frame / 15))  # slowly, so that nothing swings
        report = w.step(1 / 60)
        assert report.broken == sum(len(at) for _, at in w.broken)
        events += [(frame, f, at.tolist()) for f, at in w.broken]
    assert [(f is rope, at) for _, f, at in events] == [(True, [3])] and rope.broken.tolist() == [k == 3 for k in range(8)]
    assert events[0][0] == pytest.approx(15 * 45 / (5 * 9.81), abs=1.01)  # the link that carries 5 of 8
    assert w.position[4, 1] < -4.05 and rope.load[3] == 0 and rope.residual[3] == 0
    np.testing.assert_allclose(rope.load[:3], 9.81 * np.array([3, 2, 1]), rtol=1e-2)
    twin = w.clone()
    assert twin.hash() == w.hash() and (twin.features[1].broken == rope.broken).all() and not twin.features[1].copy().scene
    w.step(1 / 60)
    twin.step(1 / 60)
    assert twin.hash() == w.hash() and w.last.broken == 0 and w.broken == []
    twin.close()
    with pytest.raises(ValueError, match=r"Distance: break_at\[2\] = 0, but it must be above 0"):
        tv.Distance(line(3), break_at=[1.0, 1.0, 0.0])


def test_wrong_angles_are_named():
    # Rows 10, 19, 20. The three corners of a triangle are three constraints; a corner listed backwards is the same constraint.
    with pytest.raises(ValueError, match=r"Bend: compliance\[1\] = -1"):
        tv.Bend([[0, 1, 2], [1, 2, 3]], compliance=[0.0, -1.0])
    with pytest.raises(ValueError, match=r"Bend: rest\[0\] = nan"):
        tv.World(tv.Particles(np.eye(3)), [tv.Bend([[0, 1, 2]], np.nan)])
    with pytest.raises(ValueError, match=r"Bend: triples\[0\] = \(0, 1, 0\) names a particle twice"):
        tv.Bend([[0, 1, 0]])
    with pytest.raises(ValueError, match=r"Dihedral: quads has shape \(1, 3\), but \(m, 4\)"):
        tv.Dihedral([[0, 1, 2]])
    with pytest.raises(ValueError, match=r"AngleLimit: triples\[0\] = \(0, 1, 3\), but there are 3 particles"):
        tv.World(tv.Particles(np.eye(3)), [tv.AngleLimit([[0, 1, 3]], 0.0, 1.0)])
    with pytest.raises(ValueError, match=r"Bend: rest \(in 3D\)\[0\] = -0.5, but it must be at least 0"):
        tv.World(tv.Particles(np.eye(3)), [tv.Bend([[0, 1, 2]], -0.5)])
    bend, limit = tv.Bend([[0, 1, 2]], 0.5), tv.AngleLimit([[0, 1, 2]], 0.0, 1.0)
    with tv.World(tv.Particles(np.eye(3)), [bend, limit]), pytest.raises(ValueError, match="at least 0"):
        bend.rest = -0.5
    with pytest.raises(ValueError, match=r"AngleLimit: upper \(in 3D\)\[0\] = 4, but it must be at most 3.14159"):
        limit.upper = 4.0
    tv.Bend([[0, 1, 2], [1, 2, 0], [2, 0, 1]])
    with pytest.warns(UserWarning, match=r"Bend: 1 of the triples are duplicates, the first of them \(0, 1, 2\)"):
        tv.Bend([[0, 1, 2], [2, 1, 0]])


@pytest.mark.slow
def test_a_bent_corner_between_pins_stays_near_them(world):
    # The corner is straight only between the pins, L = 0.42 m apart. From a distance r the pins subtend L / r, so the gradient
    # falls as L / r^2, and a step of C = pi over the gradient would throw the corner to pi r^2 / L. A corner that starts so is
    # first placed between the pins, without a velocity. When the rest angle jumps later, the corner moves per frame by at most
    # a third of a radian (20 rad/s), or a third of the shorter leg, 0.3 m.
    x = np.array([[0.0, 0], [0.3, 0], [0, 0.3]])
    bend = tv.Bend([[0, 1, 2]], 0.0)
    for solver in (tv.Jacobi(), tv.Direct()):
        w = world(tv.Particles(x, pinned=[0, 2]), [bend.copy()], precision="f64", solver=solver)
        for substeps in (1, 20):
            bend = w.features[0]
            bend.rest = 0.0
            rerun(w, 0.1, substeps=substeps)
            assert np.abs(bend.rest_of(w.position)) < 1e-9 and w.position[1, 0] == pytest.approx(0, abs=1e-9)
            assert 0 < w.position[1, 1] < 0.3 and np.abs(w.velocity).max() < 1e-6 and not w.last.flags
            bend.rest = 2.0
            for _ in range(30):
                w.step(1 / 60)
                assert np.abs(w.position).max() < 1.0 and np.abs(w.velocity).max() < 20 * 0.3
            assert bend.rest_of(w.position) == pytest.approx(2.0, abs=1e-6)


@pytest.mark.slow
def test_limits_know_no_less_than_straight(world):
    # In 3D an angle is at least 0: straight limbs in any position meet limits of 0 to 2 rad, also in f32, where the sign of
    # |u x v| near 0 is rounding. Nothing acts on the limbs in free fall, and an inactive limit must report no turn.
    rng = np.random.default_rng(3)
    u = rng.normal(size=(200, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    x = (rng.uniform(-4, 4, (200, 1, 3)) + np.array([0.0, 0.2, 0.5])[:, None] * u[:, None]).reshape(-1, 3)
    legs = np.concatenate([np.arange(0, 600, 3)[:, None] + [a, a + 1] for a in (0, 1)])
    joints = tv.AngleLimit(np.arange(600).reshape(200, 3), 0.0, 2.0, compliance=1e-3, damping=0.2)
    w = world(tv.Particles(x), [tv.Gravity(9.81), tv.Distance(legs), joints], substeps=20, solver=tv.Jacobi())
    for _ in range(3):
        report = w.step(1 / 60)
        assert report.clean and report.turn == 0 and (joints.load == 0).all()


def test_what_is_slack_has_not_turned(world):
    # Two balls on a slack rope pass each other: its direction turns by 2 atan((10 / 2400) / (0.1 / 60)) = 136 degrees at once.
    x = [[0.0, 0.0], [-10 / 40 / 60, 0.1 / 60]]
    w = world(
        tv.Particles(x, velocity=[[0, 0], [10.0, 0.0]]),
        [tv.Rope([[0, 1]], 9.0)],
        substeps=20,
        solver=tv.Direct(),
        precision="f64",
    )
    for _ in range(2):
        report = w.step(1 / 60)
        assert report.clean and report.turn == 0


def test_gradients_of_paths_are_exact_where_they_are_almost_straight():
    # |grad_i f| = 1 / |a| and |grad_k f| = 1 / |b|, however little the path is bent; the unsigned angle has a kink at 0, over
    # which differences would be 0. Elsewhere they agree with differences of the angle.
    x = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, 0.9, -0.4]])
    bends, limits = tv.Bend([[0, 1, 2], [0, 1, 3]]), tv.AngleLimit([[0, 1, 2], [0, 1, 3]], 0.0, [3.0, 1.0])
    for kink in (1e-15, 1e-9, 1e-6, 1e-3):
        x[2, 1] = kink
        sizes = np.linalg.norm(bends.gradients(x), axis=2)
        np.testing.assert_allclose(sizes[0], [2.0, 4.0, 2.0], rtol=1e-5)
        np.testing.assert_allclose(bends.gradients(x)[1], differences(bends.values, x[bends.indices])[1], atol=1e-8)
        np.testing.assert_allclose(limits.gradients(x), [[[-1.0]], [[1.0]]] * bends.gradients(x), atol=1e-15)
    flat = tv.Bend([[0, 1, 3]])
    np.testing.assert_allclose(flat.gradients(x[:, :2]), differences(flat.values, x[flat.indices][..., :2]), atol=1e-8)


@pytest.mark.slow
def test_chains_that_start_straight_but_for_rounding_keep_their_energy(world):
    # Points on a line along (1, 2, 3) are off it by 1e-16 m. Where a path is almost straight, its plane turns far in a substep.
    # That is no error of a spring, which pulls with alpha^-1 times the angle, in that plane: a smooth vector.
    x = tv.shapes.rope((0, 0, 0), np.array([1.0, 2.0, 3.0]) / np.sqrt(14) * 15, points=16)
    v = np.random.default_rng(0).normal(size=(16, 3))
    features = [tv.Distance(x.links), tv.Bend(x.bends, compliance=0.2)]
    w = world(tv.Particles(x.position, velocity=v), features, substeps=10, precision="f64", solver=tv.Direct())
    before = w.step(0.2).energy
    report = w.run(4.0, dt=0.2)
    assert report.residual < 0.02 and report.clean
    assert report.energy == pytest.approx(before, rel=2e-3)
