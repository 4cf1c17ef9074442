"""Impacts of bodies on walls, against Newton's law of restitution for rigid bodies."""

import numpy as np
import pytest

import tiverlet as tv

# The links of what these bodies are made of, and where their particles are [m].
BAR = np.array([[0.0, 0.0], [0.0, 0.5]])
TRIANGLE = np.array([[0.0, 0.0], [0.5, 0.0], [0.25, 0.4]])
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [0.5, 0.05, 0.1], [0.2, 0.12, 0.5], [0.2, 0.45, 0.2]])


def links(x) -> np.ndarray:
    """Between all of them."""
    return np.array([(i, j) for i in range(len(x)) for j in range(i)])


def turned(x, angle: float) -> np.ndarray:
    """About the center, in the plane of the first two axes."""
    turn = np.eye(x.shape[1])
    turn[:2, :2] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    return (x - x.mean(axis=0)) @ turn


def row(k: int) -> tuple[np.ndarray, np.ndarray]:
    """A stiff rod of k particles, upright."""
    i = np.arange(k)
    pairs = [np.stack([i[: k - s], i[s:]], axis=1) for s in (1, 2)]
    return np.stack([0 * i, 0.1 * i], axis=1), np.concatenate(pairs)


def struck(x, v, n, e: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocities of the center and all particles after a rigid body of unit masses, without spin, met a plane of normal n at the
    velocity v with its lowest particle: v' = v + J n / M, J = -(1 + e) v.n / (1 / M + (r x n) . I^-1 (r x n))."""
    r, m = x - x.mean(axis=0), len(x)
    low = int(np.argmin(x @ n))
    # In any dimension a turn is an antisymmetric matrix B, v_i = B r_i: the least squares fit of it is the rigid motion.
    axes = [(i, j) for i in range(x.shape[1]) for j in range(i)]
    turns = np.array([[(r[:, j, None] * np.eye(x.shape[1])[i] - r[:, i, None] * np.eye(x.shape[1])[j])] for i, j in axes])[:, 0]
    inertia = np.einsum("akd,bkd->ab", turns, turns)
    arm = turns[:, low] @ n
    turn = np.linalg.solve(inertia, arm)
    impulse = -(1 + e) * (v @ n) / (1 / m + arm @ turn)
    after = v + impulse / m * n
    return after, after + np.einsum("a,akd->kd", turn * impulse, turns)


@pytest.mark.parametrize("e", [1e-9, 0.4, 1.0])
@pytest.mark.parametrize("shape", [BAR, TRIANGLE, TETRAHEDRON], ids=["bar", "triangle", "tetrahedron"])
def test_rigid_bodies_leave_by_newtons_law(world, shape, e):
    # Without forces: velocities before and after are constant, so the only error is that of the turn in a substep, omega h.
    for angle in (0.1, 0.35, 0.9):
        x = turned(shape, angle)
        x[:, 1] += 0.3 - x[:, 1].min()
        v, n = np.zeros(x.shape[1]), np.eye(x.shape[1])[1]
        v[:2] = 0.4, -2.0
        w = world(
            tv.Particles(x, velocity=v), [tv.Distance(links(x)), tv.HalfSpace(n, restitution=e)], substeps=10, precision="f64"
        )
        for _ in range(160):  # it meets the plane at 0.15 s; a frame later no other particle has
            w.step(1 / 600)
            if (w.velocity @ n).mean() > -1.9:
                break
        center, each = struck(x, v, n, e)
        assert np.abs(w.velocity.mean(axis=0) - center).max() < 2e-3, (angle, w.velocity.mean(axis=0), center)
        if angle == 0.35:  # speeds of the particles do not depend on how far it has turned since, but for their direction
            spins = np.linalg.norm(w.velocity - w.velocity.mean(axis=0), axis=1), np.linalg.norm(each - center, axis=1)
            assert np.abs(spins[0] - spins[1]).max() < 2e-2
        w.close()


@pytest.mark.parametrize("solver", [None, tv.Jacobi(), tv.ConjugateGradient(20)], ids=repr)
def test_elastic_bodies_keep_their_energy_and_gain_none(world, solver):
    # Ten seconds in a box: what is solved exactly keeps its energy, up to O(h) in each impact; what is not may lose some.
    settings = {} if solver is None else {"solver": solver}
    for x, pairs in ((BAR, links(BAR)), (TRIANGLE, links(TRIANGLE)), row(6)):
        turns = 3 * (x - x.mean(axis=0))[:, ::-1] * (-1, 1)
        w = world(
            tv.Particles(turned(x, 0.2) + (1.0, 1.3), velocity=turns + (1.5, 0.5)),
            [tv.Gravity(9.81), tv.Distance(pairs), tv.Box((0, 0), (2.5, 3), restitution=1.0)], substeps=20,
            precision="f64", **settings,
        )  # fmt: skip
        energy = [w.step(1 / 60).energy for _ in range(600)]
        assert max(energy) < 1.02 * energy[0]
        if solver is None and len(x) < 4:
            assert energy[-1] > 0.96 * energy[0]


@pytest.mark.parametrize("e", [0.0, 0.5, 1.0])
def test_friction_takes_its_share_of_the_blow(world, e):
    # A bar that lands flat and slides on: both ends are stopped alike, and Coulomb's law takes mu (1 + e) v_y of v_x at once.
    mu, v = 0.1, np.array([2.0, -1.5])
    w = world(
        tv.Particles([[0.0, 0.3], [0.4, 0.3], [0.2, 0.5]], velocity=v),
        [tv.Distance([(0, 1), (1, 2), (2, 0)]), tv.HalfSpace((0, 1), restitution=e, friction=mu)], substeps=100, precision="f64",
    )  # fmt: skip
    w.run(0.3)
    after = w.velocity.mean(axis=0)
    if e:
        assert after == pytest.approx((v[0] + mu * (1 + e) * v[1], -e * v[1]), abs=0.02)
    else:
        assert after[0] == pytest.approx(v[0] + mu * v[1], abs=0.1)  # without restitution, the links take it in many substeps


def test_velocities_have_no_part_of_a_blow(world):
    # With frames of one substep, in the one with the blow, too: they have the energy of the report, where multipliers of the blow
    # would have been taken for loads, and half of it counted again (8.3 J of 4).
    w = world(
        tv.Particles([[0.0, 0.1], [0.15, 0.4]], velocity=(0.0, -2.0)),
        [tv.Distance([(0, 1)]), tv.HalfSpace((0, 1), restitution=1.0)], substeps=1, precision="f64",
    )  # fmt: skip
    for _ in range(80):
        report = w.step(1e-3)
        assert 0.5 * (w.velocity**2).sum() == pytest.approx(report.energy, rel=1e-4)
    assert w.velocity[0, 1] > 1  # it has met the floor


@pytest.mark.parametrize("solver", [tv.Direct(), tv.Jacobi(), tv.ConjugateGradient(5)], ids=repr)
def test_all_paths_have_the_same_bits(world, solver):
    x, pairs = row(5)
    bodies = np.concatenate([turned(x, 0.3 * k) + (0.5 + 0.7 * k, 0.6) for k in range(3)])
    pairs = np.concatenate([pairs + 5 * k for k in range(3)])

    def run(path):
        w = world(
            tv.Particles(bodies, velocity=(1.0, -3.0), radius=0.04),
            [tv.Gravity(), tv.Distance(pairs), tv.Contact(friction=0.2), tv.Box((0, 0), (3, 2), restitution=0.8, friction=0.3)],
            substeps=8, path=path, solver=solver,
        )  # fmt: skip
        w.run(1.0)
        return w.hash()

    assert run("fused") == run("parallel") == run("launched")


@pytest.mark.parametrize("lean", [0.0, -0.1, -5.0])
def test_what_leans_on_another_wall_bounces_all_the_same(world, lean):
    # An upright rod between a floor and a smooth wall at its side, which has nothing to do with e^2 y.
    walls = [tv.HalfSpace((0, 1), restitution=0.9), tv.HalfSpace((1, 0), restitution=0.9)]
    w = world(tv.Particles([[0, 0.5], [0, 0.8]]), [tv.Gravity((lean, -9.81)), tv.Distance([(0, 1)]), *walls], precision="f64")
    w.run(0.35)  # it lands after 0.319 s
    top = max(w.position[0, 1] for _ in range(40) if w.step(1 / 60))
    assert top == pytest.approx(0.81 * 0.5, abs=1e-3)


def test_what_spins_and_rubs_has_all_of_its_friction(world):
    # v_x - mu (1 + e) v_y, as where it does not spin.
    w = world(
        tv.Particles([[0, 0.5], [0.3, 0.5]], radius=0.05, velocity=(2.0, -1.0), spin=0.0),
        [tv.Distance([(0, 1)]), tv.HalfSpace((0, 1), restitution=0.5, friction=0.3)], precision="f64",
    )  # fmt: skip
    w.run(0.8)
    assert w.velocity[:, 0] == pytest.approx(2 - 0.3 * 1.5, abs=1e-6) and (w.spin < -1).all()


def test_what_is_struck_is_never_inside(world):
    # Passes wait for what a wall has struck, but no substep ends with it inside, however short the last passes are.
    x, pairs = row(12)
    w = world(
        tv.Particles(turned(x, 0.7) + (0.9, 0.8), velocity=(20.0, -35.0)),
        [tv.Distance(pairs), tv.Box((0, 0), (2, 2), restitution=0.9)], substeps=2, precision="f64",
    )  # fmt: skip
    for _ in range(120):
        w.step(1 / 60)
        assert (w.position >= -1e-12).all() and (w.position <= 2 + 1e-12).all()


def test_the_impulse_of_an_impact_is_that_of_the_body(world):
    # M (1 + e) v, of a body of three that lands flat on two of them.
    w = world(
        tv.Particles([[0.0, 0.3], [0.4, 0.3], [0.2, 0.5]], velocity=(0.0, -1.5)),
        [tv.Distance([(0, 1), (1, 2), (2, 0)]), tv.HalfSpace((0, 1), restitution=0.5, events=True)], substeps=20,
        precision="f64",
    )  # fmt: skip
    total = 0.0
    for _ in range(30):
        w.step(1 / 60)
        total += w.wall_events().touches.impulse.sum()
    assert total == pytest.approx(3 * 1.5 * 1.5, rel=0.01)
