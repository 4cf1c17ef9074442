"""Bend, AngleLimit and Dihedral: signs, straight and folded corners, and limits that stop."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.constraints.core.quantity import differences

from .conftest import rerun


def chain(n: int, k: int) -> np.ndarray:
    """Return every k consecutive particles of a chain of n."""
    return np.arange(n - k + 1)[:, None] + np.arange(k)


def rod(world, x, triples, compliance, **settings):
    """Return a world of the links of a chain, and of its angles: one structure for each dimension."""
    bend = tv.Bend(triples, 0.0, compliance=compliance)
    start = tv.Particles(x, mass=0.1, **settings)
    return world(start, [tv.Distance(chain(len(x), 2), 0.1), bend], precision="f64", solver=tv.Jacobi()), bend


@pytest.mark.slow
def test_rods_swing_through_straight_in_space_as_in_the_plane(world):
    # An unsigned angle has a kink at straight. With the remembered side, a free rod moves in 3D as in 2D.
    n, made = 6, []
    for dim in (2, 3):
        x, v = np.zeros((n, dim)), np.zeros((n, dim))
        x[:, 0], v[:, 1] = 0.1 * np.arange(n) - 1, 0.5 * np.sin(3.0 * np.arange(n))
        w, bend = rod(world, x, chain(n, 3), [0.0, 1e-3, 1e-1, 10.0], velocity=v)
        w.run(3.0)
        made.append((w.position, np.abs(bend.load[2:])))
    np.testing.assert_allclose(made[1][0][:, :2], made[0][0], atol=1e-9)
    np.testing.assert_array_equal(made[1][0][:, 2], 0.0)
    np.testing.assert_allclose(made[1][1], made[0][1], atol=1e-6)


@pytest.mark.slow
def test_a_crooked_rod_is_straightened_without_velocity_in_space(world):
    # A rod of rigid angles that starts crooked by 0.2 rad is moved to where it is straight, at rest. If Newton's method may bend
    # a path across its plane at will, it ends at 5e-3 rad, and passes make 0.06 m/s of the rest.
    n, rng = 8, np.random.default_rng(0)
    x = np.zeros((n, 3))
    x[:, 0], x[2:, 1:] = 0.1 * np.arange(n), 0.02 * rng.normal(size=(n - 2, 2))
    w, _ = rod(world, x, [*chain(n, 3), [3, 0, 1]], [0.0] * (n - 2) + [1e12], pinned=[0, 1])
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_limits_in_space_know_no_less_than_straight(world):
    # In 3D an angle is at least 0: straight limbs in any position meet limits of 0 to 2 rad, also in f32, where the sign of
    # |u x v| near 0 is rounding. Nothing acts on the limbs in free fall, and an inactive limit must report no turn. Nor is
    # straight a stop: a limb at 3 rad/s turns on from 0.3 rad on one side to 0.3 rad on the other.
    rng = np.random.default_rng(3)
    u = rng.normal(size=(200, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    x = (rng.uniform(-4, 4, (200, 1, 3)) + np.array([0.0, 0.2, 0.5])[:, None] * u[:, None]).reshape(-1, 3)
    limb = np.array([[9.0, 0.0, 0.0], [10.0, 0.0, 0.0], [10 + np.cos(0.3), 0.0, np.sin(0.3)]])
    x, v = np.concatenate([x, limb]), np.zeros((603, 3))
    v[602] = 3.0 * np.array([np.sin(0.3), 0.0, -np.cos(0.3)])
    legs = np.concatenate([np.arange(0, 603, 3)[:, None] + [a, a + 1] for a in (0, 1)])
    joints = tv.AngleLimit(np.arange(603).reshape(201, 3), 0.0, 2.0, compliance=1e-3 * (np.arange(201) % 2), damping=0.2)
    start = tv.Particles(x, velocity=v, mass=np.where(np.arange(603) < 600, 1.0, [1e6, 1e6, 1.0] * 201))
    w = world(start, [tv.Gravity(9.81), tv.Distance(legs), joints], substeps=20, solver=tv.Jacobi(), path="fused")
    for frame in range(12):
        report = w.step(1 / 60)
        assert report.clean and (joints.load == 0).all() and (report.turn == 0 or frame > 2)
    a, b = w.position[602] - w.position[601], w.position[601] - w.position[600]
    assert np.arctan2(a[2], a[0]) - np.arctan2(b[2], b[0]) == pytest.approx(-0.3, abs=1e-3)


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


def space(feature):
    """Return a world of a feature in space."""
    return tv.World(tv.Particles(np.eye(3)), [feature])


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: tv.Bend([[0, 1, 2], [1, 2, 3]], compliance=[0.0, -1.0]), r"Bend: compliance\[1\] = -1"),
        (lambda: space(tv.Bend([[0, 1, 2]], np.nan)), r"Bend: rest\[0\] = nan"),
        (lambda: tv.Bend([[0, 1, 0]]), r"Bend: triples\[0\] = \(0, 1, 0\) names a particle twice"),
        (lambda: setattr(tv.Bend([[0, 1, 2], [1, 2, 3]]), "rest", [0.0, 9.0]), r"Bend: rest\[1\] = 9"),
        (lambda: space(tv.Bend([[0, 1, 2]], -0.5)), r"Bend: rest \(in 3D\)\[0\] = -0.5, but it must be at least 0"),
        (lambda: tv.Dihedral([[0, 1, 2]]), r"Dihedral: quads has shape \(1, 3\), but \(m, 4\)"),
        (lambda: tv.World(tv.Particles(np.zeros((4, 2))), [tv.Dihedral([[0, 1, 2, 3]])]), "Dihedral: there is no angle"),
        (lambda: space(tv.AngleLimit([[0, 1, 3]], 0, 1)), r"AngleLimit: triples\[0\] = \(0, 1, 3\), but there are 3 particles"),
        (lambda: tv.AngleLimit([[0, 1, 2]], 3.0, 2.5), r"lower\[0\] = 3 and upper\[0\] = 2.5, but lower must not exceed upper"),
        (lambda: setattr(tv.AngleLimit([[0, 1, 2]], 0, 2.5), "lower", 3.0), "lower must not exceed upper"),
        (lambda: tv.AngleLimit([[0, 1, 2]], -4.0, 4.0), "more than a turn apart"),
        (lambda: space(tv.AngleLimit([[0, 1, 2]], 0, 4)), r"upper \(in 3D\)\[0\] = 4, but it must be at most 3.14159"),
        (lambda: space(tv.AngleLimit([[0, 1, 2]], -1, 1)), r"lower \(in 3D\)\[0\] = -1, but it must be at least 0"),
    ],
)
def test_wrong_angles_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
