"""Loads of constraints and walls: in the substep whose length changes, they equal the loads of the others."""

from itertools import product

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import forget_pace

G, MASS = 9.81, 2.0
WEIGHT = MASS * G
H = 0.002
RATIOS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 10.0)


@ti.func
def length(a, b):
    """Return the length of a link."""
    return (a - b).norm()


class Bodies:
    """Bodies side by side at rest, each at its own place, the features that hold them, and the load of each feature."""

    def __init__(self, dim):
        self.dim, self.x, self.held = dim, [], []
        self.features: list = []
        self.loads: list[float] = []

    def put(self, corners, make, load, held=-1):
        """Hold a body of these corners by make(their numbers), which bears `load`; the first `held` corners are pinned."""
        first, k, place = len(self.x), len(corners), 6.0 * (len(self.features) + 1) * np.eye(self.dim)[0]
        self.x += [place + np.resize([*corner, 0.0], self.dim) for corner in corners]
        self.held += [first + j for j in range(held % k)]
        self.features.append(make(first + np.arange(k)[None]))
        self.loads.append(load)


HANGING, BENT = [(0, 0), (0, -2)], [(0, 1), (0, 0), (1, 0)]
FAN, SIMPLEX = [(-0.5, 0), (0.5, 0), (0, -1)], [(0, 0, 0), (1, 0, 0), (0, 0, 1), (0.3, -1, 0.3)]


def all_kinds(dim):
    """Return bodies whose weight is borne by each kind of rigid constraint, at an arm of 1 m where it is a moment."""
    bodies, strong = Bodies(dim), {"break_at": np.inf} if dim == 3 else {}
    bodies.put(BENT, lambda triples: tv.Bend(triples, **strong), WEIGHT)
    bodies.put(BENT, lambda triples: tv.AngleLimit(triples, np.pi / 2, 3.0, **strong), WEIGHT)
    bodies.put([(0, 0), (0, -1), (0, -2)], lambda three: tv.ShapeMatch(three[:, 1:], **strong), WEIGHT, held=1)
    bodies.features.append(tv.Distance([(len(bodies.x) - 3, len(bodies.x) - 2)]))  # the link from which the cluster hangs
    bodies.loads.append(2 * WEIGHT)
    if dim == 2:
        for make in (tv.Distance, tv.Rope, lambda p: tv.Winch(p, 0.0), lambda p: tv.Constraint(length, p, rest=2.0)):
            bodies.put(HANGING, make, WEIGHT)
        bodies.put([(0, 0), (0, 2)], lambda pairs: tv.Spacer(pairs, 2.0), WEIGHT)
        bodies.put(BENT, lambda hinges: tv.Motor(hinges, 0.0), WEIGHT)
        bodies.put(FAN, tv.Area, 2 * WEIGHT)  # the area changes by 1 / 2 m^2 per m
        bodies.put([(0, -2)], lambda one: tv.Path(one[:, 0], [(0, -2), (1e3, -2)], smooth=False), WEIGHT, held=0)
    else:
        faces = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])
        bodies.put([(0, 0, -1), (0, 0, 1), (-1, 0, 0), (1, 0, 0)], lambda quads: tv.Dihedral(quads, **strong), WEIGHT)
        bodies.put(SIMPLEX, lambda four: tv.Volume(four, **strong), 6 * WEIGHT)
        bodies.put(SIMPLEX, lambda four: tv.Volume(four[0][faces], **strong), 6 * WEIGHT)
    return bodies


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_at_rest_bears_its_weight_however_the_substep_changes(world, dim):
    # A constraint moves a body at rest by h^2 g in a substep. In the first substep after one of another length h_old,
    # displacements become velocities that lack h_old g / 2 along the constraint, and gravity acts for h / 2. So the constraint
    # moves the body by (h^2 + h h_old) g / 2; after velocities were given, by h^2 g / 2.
    bodies = all_kinds(dim)
    features = [tv.Gravity(-G * np.eye(dim)[1]), *bodies.features]
    start = tv.Particles(bodies.x, mass=MASS, pinned=bodies.held)
    w = world(start, features, substeps=1, precision="f64", iterations=200)

    def told():
        """Return the load that each feature reports, divided by its true load."""
        return [np.linalg.norm(f.load) / load for f, load in zip(bodies.features, bodies.loads, strict=True)]

    for ratio in RATIOS:
        w.velocity = np.zeros_like(w.position)
        for h in (H, H, ratio * H, ratio * H):
            forget_pace(w)
            w.step(h)
            np.testing.assert_allclose(told(), 1.0, rtol=1e-6, err_msg=f"{h} s after {H} s")
    # What can bear a thousandth less than it has to breaks, and a thousandth more does not. None: velocities are given.
    forget_pace(w)
    w.step(H)
    for ratio, share in product((*RATIOS, None), (0.999, 1.001)) if dim == 3 else ():
        with w.clone() as other:
            if ratio is None:
                other.velocity = 0 * other.velocity
            weak = [(f, load) for f, load in zip(other.features[1:], bodies.loads, strict=True) if f.breaks]
            for f, load in weak:
                f.break_at = share * load
            forget_pace(other)
            other.step((ratio or 1.0) * H)
            assert [f.broken.all() for f, _ in weak] == [share < 1] * len(weak) and len(weak) > 4, ratio


def test_springs_at_rest_bear_their_weight(world):
    # Velocities lack theta of the half kick of a spring: all of it where the spring is as good as rigid. The start adds it again.
    compliance = np.concatenate([[0.0], 10.0 ** np.arange(-12, -1)])
    x = np.stack([np.arange(len(compliance)), np.zeros(len(compliance))], axis=1)
    low = x - [0, 2]
    pairs = np.arange(len(x))[:, None] + [0, len(x)]
    link = tv.Distance(pairs, 2.0 - compliance * WEIGHT, compliance=compliance)
    soft = compliance[1:]
    pin = tv.Pin(2 * len(x) + np.arange(len(soft)), low[1:] + np.outer(soft * WEIGHT, [0, 1]), compliance=soft)
    particles = tv.Particles(np.concatenate([x, low, low[1:]]), mass=MASS, pinned=np.arange(len(x)))
    w = world(particles, [tv.Gravity(G), link, pin], substeps=1, precision="f64")
    for ratio in RATIOS:
        w.position, w.velocity = particles.position, np.zeros_like(w.position)
        for h in (H, H, ratio * H):
            forget_pace(w)
            w.step(h)
            np.testing.assert_allclose(link.load, WEIGHT, rtol=1e-6, err_msg=f"{h} s after {H} s")
            np.testing.assert_allclose(pin.load, np.outer(np.ones(len(soft)), [0, WEIGHT]), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_walls_give_the_momentum_that_gravity_takes_away(world, restitution):
    # sum J = m g t + m (v - v_0), from the first frame on, for what rests and for what strikes: the blow counts once. The substep
    # of a start moves by h^2 / 2 times the load only.
    start = tv.Particles([[0.0, 0.1], [1.0, 0.1]], radius=0.1, mass=MASS, velocity=[[0, 0], [0, -3.0]])
    w = world(start, [tv.Gravity(G), tv.HalfSpace((0, 1), events=True, restitution=restitution)], substeps=2, precision="f64")

    def pushed(dt):
        w.step(dt)
        touches = w.wall_events().touches
        return np.bincount(touches.pairs[:, 0], touches.impulse, minlength=2)

    for _ in range(2):
        begin, given = w.time, sum(pushed(0.02) for _ in range(8))
        gained = MASS * (w.velocity - start.velocity)[:, 1]
        np.testing.assert_allclose(given - gained, WEIGHT * (w.time - begin), rtol=1e-9)
        assert given[0] == pytest.approx(WEIGHT * 8 * 0.02, rel=1e-9)
        w.position, w.velocity = start.position, start.velocity  # another start
    # Where the substep changes, the impulse is counted from the middle of the substep before to the middle of the last one, where
    # the displacement gives the velocity, so nothing is lost or counted twice.
    w.substeps, begin, given = 4, w.time, 0.0
    for dt in () if restitution else (4 * H, 4 * H, 40 * H, 4 * H, 0.4 * H, 8 * H, H, 3 * H):
        forget_pace(w)
        given += pushed(dt)[0]
        assert given == pytest.approx(WEIGHT * (w.time - begin - dt / 8 + H / 2), rel=1e-9)


@pytest.mark.slow
def test_a_blow_breaks_a_spring_that_is_weaker_than_its_peak(world):
    # A weight at v on a spring k at its rest length: F = m g + sqrt((m g)^2 + k m v^2) at most. N = 16 substeps in a period
    # 2 pi sqrt(m / k) see at least cos(pi / N) = 0.98 of it.
    for substeps, v in ((4, 0.5), (4, 5.0), (60, 0.5), (60, 5.0)):
        k = MASS * (2 * np.pi * 60 * substeps / 16) ** 2
        peak = WEIGHT + np.sqrt(WEIGHT**2 + k * MASS * v * v)
        links = tv.Distance([(0, 1), (2, 3)], 1.0, compliance=1 / k, break_at=[0.97 * peak, 1.03 * peak])
        x = [(0, 0), (0, -1), (1, 0), (1, -1)]
        particles = tv.Particles(x, mass=MASS, velocity=np.outer([0, 1, 0, 1], (0, -v)), pinned=[0, 2])
        w = world(particles, [tv.Gravity(G), links], substeps=substeps, precision="f64")
        assert "a blow counts" not in w.explain()
        w.run(0.5)
        assert links.broken.tolist() == [True, False]
    # omega = sqrt(k / m) = 316 rad/s: 16 substeps in 2 pi / omega are 13.4 in a frame of 1/60 s. Pins do not break.
    link, pin = tv.Distance([(0, 1)], compliance=5e-6, break_at=1.0), tv.Pin([1], (0, -1), compliance=5e-6)
    w = world(tv.Particles([(0, 0), (0, -1)], mass=MASS, pinned=[0]), [link, pin], substeps=13)
    assert "14 substeps resolve it" in w.explain()
    w.substeps = 14
    assert "a blow counts" not in w.explain()


def test_the_most_overloaded_breaks_and_unloads_the_others(world):
    # Overloads of 2 and 2 * more: by less than an eighth of the larger one they are taken for equal, and the first one breaks.
    for more, breaks in ((1.1, 0), (1.18, 1)):
        links = tv.Distance([(0, 1), (1, 2)], break_at=[9.81, 9.81 / 2 / more])
        particles = tv.Particles([(0, 0), (0, -1), (0, -2)], pinned=[0])
        w = world(particles, [tv.Gravity(9.81), links], precision="f64", solver=tv.Direct())
        w.step(1 / 60)
        assert np.flatnonzero(links.broken).tolist() == [breaks]


@pytest.mark.slow
@pytest.mark.parametrize("precision, substeps", [("f32", 4), ("f32", 60), ("f32", "auto"), ("f32-compensated", 60), ("f64", 20)])
def test_a_truss_breaks_at_the_load_of_statics(world, precision, substeps):
    # A cantilever of 4 squares with a diagonal each: sum over links of S u = -m g for each of 8 free points, 16 equations for 16
    # links. Loads of the whole length act on the first links, and so does rounding of all positions: it breaks nothing, neither
    # at the start nor at two thirds of the strength.
    x = np.array([(i, j) for i in range(5) for j in (0, 1)], dtype=float)
    links = np.array([(a + k, b + k) for k in range(0, 8, 2) for a, b in ((0, 2), (1, 3), (1, 2), (2, 3))])
    mass = np.array([1.0] * 9 + [3.0])
    u = np.diff(x[links], axis=1)[:, 0]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    sums = np.zeros((20, 16))
    for k, (a, b) in enumerate(links):
        sums[2 * a : 2 * a + 2, k], sums[2 * b : 2 * b + 2, k] = u[k], -u[k]
    strength = 3.0 * np.abs(np.linalg.solve(sums[4:], np.outer(mass[2:], (0, 1)).ravel())).max()  # at g = 3 m/s^2
    gravity = tv.Gravity(2.0)
    features = [gravity, tv.Distance(links, break_at=strength), tv.Drag(4.0)]
    w = world(tv.Particles(x, mass=mass, pinned=[0, 1]), features, substeps=substeps, precision=precision)
    assert not any(w.step(1 / 60).broken for _ in range(60))
    while gravity.g < 4.0 and not w.step(1 / 60).broken:
        gravity.g = gravity.g + 1 / 120
    assert gravity.g == pytest.approx(3.0, rel=0.03)
