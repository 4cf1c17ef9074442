"""Loads of constraints and walls: in the substep whose length changes, they equal the loads of the others."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

G, MASS = 9.81, 2.0
WEIGHT = MASS * G
H = 0.002
RATIOS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 10.0)


@ti.func
def length(a, b):
    """Return the length of a link."""
    return (a - b).norm()


class Bodies:
    """Bodies side by side at rest, each at its own place, and the features that hold them.

    loads: the load of each feature, in newtons or in the unit of its load.
    """

    def __init__(self, dim):
        self.dim, self.x, self.held = dim, [], []
        self.features: list = []
        self.loads: list[float] = []

    def put(self, corners, make, load, held=-1, copies=1):
        """Hold bodies of these corners by make(their numbers), which bears `load`; the first `held` corners are pinned."""
        first, (k, dim) = len(self.x), np.shape(corners)
        for copy in range(copies):
            place = np.zeros(self.dim)
            place[:dim] = [6.0 * len(self.features) + 6.0 + 3.0 * copy / copies, 0.0, 0.0][:dim]
            self.x += [place + np.resize([*corner, 0.0], self.dim) for corner in corners]
            self.held += [first + copy * k + j for j in range(held % k)]
        self.features.append(make(first + np.arange(copies * k).reshape(copies, k)))
        self.loads.append(load)
        return self.features[-1]

    def world(self, world, **settings):
        """Return a world with all bodies."""
        gravity = np.zeros(self.dim)
        gravity[1] = -G
        particles = tv.Particles(self.x, mass=MASS, pinned=self.held)
        return world(particles, [tv.Gravity(gravity), *self.features], **({"substeps": 1, "precision": "f64"} | settings))


HANGING, BENT = [(0, 0), (0, -2)], [(0, 1), (0, 0), (1, 0)]
FAN, SIMPLEX = [(-0.5, 0), (0.5, 0), (0, -1)], [(0, 0, 0), (1, 0, 0), (0, 0, 1), (0.3, -1, 0.3)]


def all_kinds(dim):
    """Return bodies whose weight is borne by each kind of rigid constraint, at an arm of 1 m where it is a moment."""
    bodies = Bodies(dim)
    bodies.put(BENT, tv.Bend, WEIGHT)
    bodies.put(BENT, lambda triples: tv.AngleLimit(triples, np.pi / 2, 3.0), WEIGHT)
    bodies.put([(0, 0), (0, -1), (0, -2)], lambda three: tv.ShapeMatch(three[:, 1:]), WEIGHT, held=1)
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
        bodies.put([(0, 0, -1), (0, 0, 1), (-1, 0, 0), (1, 0, 0)], tv.Dihedral, WEIGHT)
        bodies.put(SIMPLEX, tv.Volume, 6 * WEIGHT)
        faces = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])
        bodies.put(SIMPLEX, lambda four: tv.Volume(four[0][faces]), 6 * WEIGHT)
    return bodies


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_at_rest_bears_its_weight_however_the_substep_changes(world, dim):
    # A constraint moves a body at rest by h^2 g in a substep. In the first substep after one of another length h_old,
    # displacements become velocities that lack h_old g / 2 along the constraint, and gravity acts for h / 2. So the constraint
    # moves the body by (h^2 + h h_old) g / 2; after velocities were given, by h^2 g / 2.
    bodies = all_kinds(dim)
    w = bodies.world(world, iterations=200)

    def told():
        """Return the load that each feature reports, divided by its true load."""
        return [np.linalg.norm(f.load) / load for f, load in zip(bodies.features, bodies.loads, strict=True)]

    for ratio in RATIOS:
        w.velocity = np.zeros_like(w.position)
        for h in (H, H, ratio * H, ratio * H):
            w.step(h)
            np.testing.assert_allclose(told(), 1.0, rtol=1e-6, err_msg=f"{h} s after {H} s")


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
            w.step(h)
            np.testing.assert_allclose(link.load, WEIGHT, rtol=1e-6, err_msg=f"{h} s after {H} s")
            np.testing.assert_allclose(pin.load, np.outer(np.ones(len(soft)), [0, WEIGHT]), rtol=1e-6, atol=1e-9)


BREAKING = [  # corners, the feature that holds them, its load, the number of pinned corners
    (HANGING, lambda p: tv.Distance(p, break_at=np.inf), WEIGHT, 1),
    (HANGING, lambda p: tv.Distance(p, 2.0 - 1e-10 * WEIGHT, compliance=1e-10, break_at=np.inf), WEIGHT, 1),
    (FAN, lambda p: tv.Area(p, break_at=np.inf), 2 * WEIGHT, 2),
    ([(0, 0), (0, -1), (0, -2)], lambda p: tv.ShapeMatch(p[:, 1:], break_at=np.inf), WEIGHT, 1),
]


@pytest.mark.slow
@pytest.mark.parametrize("path", ["fused", "many"])
def test_only_what_is_too_weak_breaks_where_the_substep_changes(world, path):
    # Two of each kind: one can bear a thousandth more than it has to, the other a thousandth less. None: velocities are given.
    bodies = Bodies(2)
    kinds = [bodies.put(corners, make, load, held, copies=2) for corners, make, load, held in BREAKING]
    upper = bodies.features[-1].indices.reshape(2, 2)[:, 0]
    bodies.features.append(tv.Distance(np.stack([upper - 1, upper], axis=1)))
    with bodies.world(world, iterations=60, path="fused") as made:
        made.step(H)
        for ratio in (*RATIOS, None):
            with tv.Worlds(made, 2) if path == "many" else made.clone() as w:
                if ratio is None:
                    w.velocity = 0 * w.velocity
                for feature, load in zip(w.features[1:], bodies.loads, strict=False):
                    feature.break_at = load * np.array([1.001, 0.999])
                w.step((ratio or 1.0) * H)
                for told in w.each(broken) if path == "many" else [broken(w)]:
                    assert told == len(kinds) * [[False, True]], ratio


def broken(w):
    """Return which constraints of each kind are broken."""
    return [f.broken.tolist() for f in w.features[1:-1]]


@pytest.mark.slow
def test_rounding_breaks_nothing_and_holds_nothing(world):
    # f32 places are known to 4e-6 m at 30 m, and loads in substeps of 13 us to m 4e-6 m / h^2 = 45 kN. What they sum up to over
    # N substeps is known to m 4e-6 m, so a body of 20 N on strengths of 30 N and 2 N is told from it by MARGIN times that
    # / (h^2 18 N) = 1e4 substeps, 8 frames. A blow of m v = 40 kg m/s is m v h = 5e-4 kg m, 17 times that, and
    # breaks at once.
    bodies, frame, n = Bodies(2), 1 / 60, 1280
    for corners, make, load, held in [*BREAKING, (BENT, lambda p: tv.Bend(p, break_at=np.inf), WEIGHT, 2)]:
        bodies.put(corners, make, load, held, copies=2)
    upper, angles = bodies.features[3].indices.reshape(2, 2)[:, 0], bodies.features[-1].indices
    bodies.features.append(tv.Distance(np.concatenate([np.stack([upper - 1, upper], axis=1), angles[:, 1:]])))
    w = bodies.world(world, precision="f32", substeps=n)
    kinds = w.features[1:-1]
    for feature, load in zip(kinds, bodies.loads, strict=True):
        feature.break_at = load * np.array([1.5, 0.1])
    noise = 0.0
    for _ in range(12):
        w.step(frame)
        noise = max(noise, abs(kinds[2].load[0]) / bodies.loads[2])
    assert noise > 10  # in one substep
    assert broken(w) == len(kinds) * [[False, True]]
    for feature, load in zip(kinds, bodies.loads, strict=True):
        feature.break_at = 1000 * load
    w.velocity = np.tile([0.0, -20.0], (len(w.position), 1))
    w.substeps = 2  # for the cluster, which hangs by a link, and has its blow from there
    w.step(2 * frame / n)
    assert broken(w) == len(kinds) * [[True, True]]


def test_a_pendulum_breaks_at_its_strength_under_auto(world):
    # Released at rest at an angle a, the pendulum pulls with T = m g (3 cos b - 2 cos a) at b, and most at its lowest point. The
    # load of a substep is the mean over a time around it that is at most a frame. So the link breaks within a frame of where T
    # passes its strength. A link that is stronger than the largest T, by more than the error of the motion, holds.
    a = np.radians(120)
    top = 3 - 2 * np.cos(a)
    links = [tv.Distance([(0, 1)], break_at=share * top * G) for share in (0.6, 0.8, 0.95, 1.02)]
    for link, share in zip(links, (0.6, 0.8, 0.95, 1.02), strict=True):
        particles = tv.Particles([(0.0, 0.0), (np.sin(a), -np.cos(a))], pinned=[0])
        w = world(particles, [tv.Gravity(G), link], substeps="auto", precision="f64")
        tension = [np.cos(a) / top]
        for _ in range(240):
            report = w.step(1 / 60)
            tension.append((-3 * w.position[1, 1] - 2 * np.cos(a)) / top)
            if report.broken:
                break
        if share > 1:
            assert not link.broken.any() and max(tension) > 0.999
        else:
            change = abs(tension[-1] - tension[-2])
            assert link.broken.all() and tension[-2] - change < share < tension[-1] + change


def test_walls_give_as_much_as_gravity_takes_away(world):
    # The impulse of a wall is a change of momentum: all that gravity gave to the particle on it, m g dt in each frame. Where the
    # substep changes, it is counted from the middle of the substep before to the middle of the last one, where the displacement
    # gives the velocity, so nothing is lost or counted twice.
    floor = tv.HalfSpace((0, 1), -2.0, events=True)
    w = world(tv.Particles([[0.0, -2.0]], mass=MASS), [tv.Gravity(G), floor], substeps=4, precision="f64")
    given = 0.0
    for dt in (4 * H, 4 * H, 40 * H, 4 * H, 0.4 * H, 8 * H, H, 3 * H):
        w.step(dt)
        given += w.wall_events().touches.impulse.sum()
        assert given == pytest.approx(WEIGHT * (w.time - dt / 8 + H / 2), rel=1e-9)


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_a_start_gives_the_impulse_of_a_whole_frame(world, restitution):
    # sum J = m g t + m (v - v_0), from the first frame on, for what rests and for what strikes: the blow counts once. The substep
    # of a start moves by h^2 / 2 times the load only.
    start = tv.Particles([[0.0, 0.1], [1.0, 0.1]], radius=0.1, mass=MASS, velocity=[[0, 0], [0, -3.0]])
    floor = tv.HalfSpace((0, 1), events=True, restitution=restitution)
    w = world(start, [tv.Gravity(G), floor], substeps=2, precision="f64")
    for _ in range(2):
        given, begin = np.zeros(2), w.time
        for _ in range(8):
            w.step(0.02)
            touches = w.wall_events().touches
            np.add.at(given, touches.pairs[:, 0], touches.impulse)
        gained = MASS * (w.velocity - start.velocity)[:, 1]
        np.testing.assert_allclose(given - gained, WEIGHT * (w.time - begin), rtol=1e-9)
        assert given[0] == pytest.approx(WEIGHT * 8 * 0.02, rel=1e-9)
        w.position, w.velocity = start.position, start.velocity  # another start


SIDES = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)])
BLOCK = [(0, 0), (0.5, 0.05), (0.45, 0.55), (-0.05, 0.5)]
ROPE = [(0, 0.2 * k) for k in range(8)]
FALLING = {  # a floor, bodies of one world, and what holds their particles, numbered from 0
    "discs": (
        tv.Capsule((-9, -1), (40, -1), 1.0, events=True),
        [BLOCK, BLOCK, [(0, 0)], [(0, 0), (0.5, 0.3)], ROPE],
        lambda: [
            tv.Distance(np.concatenate([SIDES, [(9, 10)], [(11 + k, 12 + k) for k in range(7)]])),
            tv.ShapeMatch([range(4, 8)]),
            tv.Contact(),
        ],
    ),
    "outline": (tv.HalfSpace((0, 1), events=True), [BLOCK], lambda: [tv.ShapeMatch([range(4)]), tv.Polygons([range(4)])]),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", FALLING)
def test_walls_give_all_the_momentum_of_a_landing(world, kind):
    # sum J = sum m (v - v_0) + m g t, whatever lands, on a plane as on a rod. An impulse counts until the middle of the last
    # substep, and a velocity until its end, with half of a kick: m g h / 2 for each particle. Bodies are 6 m apart.
    floor, bodies, held = FALLING[kind]
    x = np.concatenate([np.add(body, (6.0 * k, 1.0)) for k, body in enumerate(bodies)])
    start = tv.Particles(x, radius=0.05 if kind == "discs" else 0.0, mass=MASS, velocity=(1.0, -3.0))
    for substeps in (2, 60):
        w = world(start, [tv.Gravity(G), *held(), floor.copy()], substeps=substeps, precision="f64")
        given, sizes = np.zeros(len(x)), np.array([len(body) for body in bodies])
        for _ in range(90):
            w.step(1 / 60)
            touches = w.wall_events().touches
            np.add.at(given, touches.pairs[:, 0], touches.impulse)
        gained = MASS * (w.velocity - start.velocity)[:, 1] + WEIGHT * w.time
        off = np.add.reduceat(given - gained, np.cumsum([0, *sizes[:-1]]))
        assert (np.abs(off) < 1.1 * sizes * WEIGHT / 60 / substeps / 2 + 1e-9).all(), off


@pytest.mark.slow
@pytest.mark.parametrize(("make", "substeps"), [(tv.Distance, 4), (tv.Rope, 60)])
def test_a_blow_breaks_a_spring_that_is_weaker_than_its_peak(world, make, substeps):
    # A weight at v on a spring k at its rest length: F = m g + sqrt((m g)^2 + k m v^2) at most. N = 16 substeps in a period
    # 2 pi sqrt(m / k) see at least cos(pi / N) = 0.98 of it.
    for v in (0.5, 5.0):
        k = MASS * (2 * np.pi * 60 * substeps / 16) ** 2
        peak = WEIGHT + np.sqrt(WEIGHT**2 + k * MASS * v * v)
        links = make([(0, 1), (2, 3)], 1.0, compliance=1 / k, break_at=[0.97 * peak, 1.03 * peak])
        x = [(0, 0), (0, -1), (1, 0), (1, -1)]
        particles = tv.Particles(x, mass=MASS, velocity=np.outer([0, 1, 0, 1], (0, -v)), pinned=[0, 2])
        w = world(particles, [tv.Gravity(G), links], substeps=substeps, precision="f64")
        assert "a blow counts" not in w.explain()
        w.run(0.5)
        assert links.broken.tolist() == [True, False]


def test_springs_whose_blows_substeps_do_not_resolve_are_named(world):
    # omega = sqrt(k / m) = 316 rad/s: 16 substeps in 2 pi / omega are 13.4 in a frame of 1/60 s.
    link, pin = tv.Distance([(0, 1)], compliance=5e-6, break_at=1.0), tv.Pin([1], (0, -1), compliance=5e-6)  # pins do not break
    w = world(tv.Particles([(0, 0), (0, -1)], mass=MASS, pinned=[0]), [link, pin], substeps=13)
    assert "14 substeps resolve it" in w.explain()
    w.substeps = 14
    assert "a blow counts" not in w.explain()


@pytest.mark.slow
def test_what_sags_holds_where_the_substep_gets_shorter(world):
    # A pass holds a moment by a sag that falls with h^2: 1e-4 rad here. In a substep of a half to a tenth of the length, this sag
    # would be 4 to 100 times the moment. It stays that moment, but for what vibrates, and in the end without.
    particles = tv.Particles([(0, 1), (0, 0), (1, 0), (2, 0)], mass=[1, 1, 2, 1], pinned=[0, 1])
    for ratio in (2, 10):
        angles = tv.Bend([[0, 1, 2], [1, 2, 3]], break_at=np.inf)
        w = world(particles, [tv.Gravity(G), tv.Distance([[1, 2], [2, 3]]), angles], precision="f64")
        w.run(2.0)
        np.testing.assert_allclose(np.abs(angles.load), [4 * G, G], rtol=1e-4)
        angles.break_at = 1.2 * np.array([4.0, 1.0]) * G
        for seconds, error in ((0.5, 0.03), (6.0, 1e-4)):
            w.run(seconds, dt=1 / 60 / ratio)
            np.testing.assert_allclose(np.abs(angles.load), [4 * G, G], rtol=error)
        assert not angles.broken.any()


@pytest.mark.slow
def test_what_is_moved_steadily_bears_its_weight_in_f32(world):
    # What is lifted without acceleration bears m g, whatever lifts it: a winch, rest lengths, pins or paths. Coordinates of 3 m
    # end at e = 2^-22 m in f32: where a rest value or a place is rounded to that it jerks, by m e / h^2 = 17 N here. Angles
    # likewise, by I e / (r h^2): a motor that turns a spoke of 1 m steadily gives m g cos(angle), and a bend holds m g 1 m.
    h, speed = 1 / 6000, 0.5
    bodies = Bodies(2)
    bodies.put(HANGING, lambda p: tv.Winch(p, -speed), WEIGHT, held=1)
    lifted = bodies.put(HANGING, tv.Distance, WEIGHT, held=1)
    bodies.put(HANGING, tv.Distance, WEIGHT, held=0)
    bodies.put(HANGING, tv.Distance, WEIGHT, held=0)
    bodies.put(BENT, lambda p: tv.Motor(p, speed), WEIGHT, held=2)
    bodies.put(BENT, tv.Bend, -WEIGHT, held=2)
    spokes = tv.Distance([[9, 10], [12, 13]])
    pin = tv.Pin([4], bodies.x[4])
    path = tv.Path([6], [bodies.x[6], bodies.x[6] + np.array([0.0, 9.0])], speed=speed)
    bodies.features += [pin, path, spokes]
    w = bodies.world(world, substeps=100, precision="f32", solver=tv.Direct())
    for frame in range(40):
        lifted.rest, pin.target = 2 - speed * (frame + 1) / 60, bodies.x[4] + np.array([0.0, speed * (frame + 1) / 60])
        w.step(100 * h)
        turned = speed * (w.time - h)
        expected = [*bodies.loads[:4], -WEIGHT * np.cos(turned), bodies.loads[5]]
        np.testing.assert_allclose([f.load[0] for f in bodies.features[:6]], expected, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("substeps", "path"), [(4, "fused"), (20, "launched")])
def test_what_breaks_first_unloads_the_others(world, path, substeps):
    # 20 kg on a chain of 20 links that bear 50 N each: the uppermost one bears most, 216 N, and breaks. The rest falls freely.
    x, k = np.stack([np.zeros(21), -0.1 * np.arange(21)], axis=1), np.arange(20)
    links = tv.Distance(np.stack([k, k + 1], axis=1), break_at=50.0)
    mass = np.append(np.full(20, 0.1), 20.0)
    w = world(tv.Particles(x, mass=mass, pinned=[0]), [tv.Gravity(9.81), links], substeps=substeps, path=path, solver=tv.Direct())
    w.run(0.5)
    assert np.flatnonzero(links.broken).tolist() == [0]
    np.testing.assert_allclose(w.velocity[1:, 1], -9.81 * 0.5, rtol=0.01)


@pytest.mark.parametrize(("more", "breaks"), [(1.1, 0), (1.18, 1)])
def test_of_loads_that_are_alike_the_first_breaks(world, more, breaks):
    # Overloads of 2 and 2 * more: by less than an eighth of the larger one they are taken for equal.
    links = tv.Distance([(0, 1), (1, 2)], break_at=[9.81, 9.81 / 2 / more])
    particles = tv.Particles([(0, 0), (0, -1), (0, -2)], pinned=[0])
    w = world(particles, [tv.Gravity(9.81), links], precision="f64", solver=tv.Direct())
    w.step(1 / 60)
    assert np.flatnonzero(links.broken).tolist() == [breaks]
