"""Rows about contacts, cells and walls: no contact is missed, no energy is gained, and no particle passes a wall."""

import numpy as np

from ....colliders import Ball, Box, Capsule, HalfSpace, Sdf
from ....constraints import Distance, Path, ShapeMatch
from ....contact import Contact
from ....device import ti
from ....forces import Drag, Gravity
from ....measure import kinetic_energy, overlapping
from ....neighbours import Periodic
from ....particles import Particles
from ....solvers import Jacobi
from ....world import World
from .row import Findings, at_most, contacts_of, finite, refused, rerun, row, same_pairs, summary, warned, world


@row(16, "coincident particles in contact: 2, 100, 1000", "they part the same way each time, and no momentum is made")
def _coincident() -> Findings:
    for count, dim, limit in ((2, 2, 0.01), (100, 2, 0.05), (1000, 3, 0.05)):
        with world(Particles(np.zeros((count, dim)), radius=0.01), [Contact(push_out=0.25)], substeps=5) as w:
            made = []
            for _ in range(2):
                rerun(w, 1.0)
                made.append(w.position)
            p = float(np.abs(w.velocity.sum(axis=0)).max())
            left = w.last.overlap
            yield at_most(f"{count}: overlap {left:.2g}", left, limit, np.array_equal(*made) and p <= 1e-12 * count)


@row(25, "radii of 1:1000", "no contact missed, by brute force; in 2D and 3D")
def _wide() -> Findings:
    rng = np.random.default_rng(7)
    wide = 10.0 ** rng.uniform(-3, 0, 1500)
    yield from same_pairs("2D: ", rng.uniform(-3, 3, (1500, 2)), wide)
    yield from same_pairs("3D: ", rng.uniform(-1.5, 1.5, (1500, 3)), wide)


@row(30, "negative cells", "no contact missed left of the origin, nor across it")
def _negative() -> Findings:
    rng = np.random.default_rng(1)
    yield from same_pairs("", rng.uniform(-2, 2, (600, 2)), 0.1)
    yield from same_pairs("far: ", rng.uniform(-900, -890, (400, 3)), rng.uniform(0.1, 0.5, 400))


@row(31, "hash of negative operands", "mirrored clouds have mirrored contacts")
def _mirrored() -> Findings:
    x = np.random.default_rng(2).uniform(0, 6, (500, 2))
    made = [contacts_of(x * s, 0.15) for s in ([1, 1], [-1, 1], [1, -1], [-1, -1])]
    yield f"{len(made[0])} contacts each", all(np.array_equal(made[0], m) for m in made)


@row(32, "hash collisions: clusters at multiples of 64 cells", "the same contacts as by brute force")
def _collide() -> Findings:
    rng = np.random.default_rng(3)
    return same_pairs("", rng.integers(-40, 40, (500, 2)) * 64.0 * 1.1 + rng.normal(size=(500, 2)) * 0.4, 0.5)


@row(33, "two neighbour cells in one bucket", "each pair once")
def _once() -> Findings:
    x = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), axis=-1).reshape(-1, 2) * 0.99
    found = contacts_of(x, 0.5)
    yield f"{len(found)} contacts", np.array_equal(found, overlapping(x, 0.5)[0])
    yield "each once", len(np.unique(found, axis=0)) == len(found)


@row(34, "4096 particles in one cell", "all pairs are there, and it is warned of")
def _crowd() -> Findings:
    n = 4096
    x = np.random.default_rng(0).uniform(0, 0.01, (n, 2))
    made = []

    def build() -> None:
        """Build a world of the particles, and count the pairs that touch."""
        with World(Particles(x, radius=0.5), [Contact()], precision="f64") as w:
            made.append(len(w.contacts.pairs))

    yield "warned of", warned(build, "near pairs per particle")
    yield f"{made[0]} pairs", made[0] == n * (n - 1) // 2


@row(35, "more near pairs than there was room for", "the list grows in the middle of a frame, and no contact is lost")
def _grows() -> Findings:
    side = 40
    loose = np.stack(np.divmod(np.arange(side**2), side), axis=1) * 4.0
    tight = np.stack(np.divmod(np.arange(side**2), side), axis=1) * 0.5
    with world(Particles(loose, radius=0.3), [Contact()]) as w:
        few = w.step(1 / 60).contacts
        w.position = tight
        found = len(w.contacts.pairs)
        yield f"{few}, then {found} contacts", few == 0 and found == len(overlapping(tight, 0.3)[0])


@row(43, "1e5 idle substeps of a resting column", "no creep, no energy")
def _creep() -> Findings:
    x = [[0.5, 0.5], [0.5, 1.499]]
    with world(Particles(x, radius=0.5), [Gravity(9.81), Drag(1.0), Contact(), Box((0, 0), (1, 9))], substeps=200) as w:
        w.run(20.0, dt=0.2)
        before = w.position
        w.run(100.0, dt=0.2)
        creep, energy = float(np.abs(w.position - before).max()), kinetic_energy(w)
        yield at_most(f"{creep:.1e} m", creep, 1e-12)
        yield at_most(f"{energy:.0e} J", energy, 1e-12)


@row(45, "speeds up to 1e6 m/s against a half-space and a box", "impossible to pass")
def _fast() -> Findings:
    rng = np.random.default_rng(0)
    aim = rng.normal(size=(60, 2))
    v = aim / np.linalg.norm(aim, axis=1)[:, None] * 10.0 ** rng.uniform(0, 6, 60)[:, None]
    slope = np.array([1.0, 2.0]) / np.sqrt(5)
    with world(Particles(np.zeros((60, 2)), velocity=v, radius=0.1), [Box((-1, -1), (1, 1)), HalfSpace(slope, -0.5)]) as w:
        deepest = 0.0
        for _ in range(20):
            w.step(1 / 60)
            deepest = max(deepest, float(np.abs(w.position).max() - 0.9), float(-0.4 - (w.position @ slope).min()))
    yield at_most(f"deepest {deepest:.0e} m, in the corner of both", deepest, 1e-12)


ROOMS = {
    "box": (lambda **k: [Box((-1, -1), (1, 1), **k)], lambda x: 1 - np.abs(x).max(axis=1)),
    "corner": (lambda **k: [HalfSpace((1, 0), -1, **k), HalfSpace((0, 1), -1, **k)], lambda x: 1 + x.min(axis=1)),
    "ball": (lambda **k: [Ball((0, 0), 1, inside=True, **k)], lambda x: 1 - np.linalg.norm(x, axis=1)),
}


def _kept_in(features, pinned, **settings) -> Findings:
    """Throw 40 particles about in every room, at v h = 0.1 ... 100 half widths."""
    rng, worst, holds = np.random.default_rng(0), 0.0, {}
    x = np.concatenate([rng.uniform(-0.6, 0.6, (40, 2)), rng.uniform(-3, 3, (len(pinned), 2))])
    aim = rng.normal(size=x.shape)
    aim /= np.linalg.norm(aim, axis=1)[:, None]
    for name, (make, inside) in ROOMS.items():
        walls = make(friction=0.5, restitution=1.0)
        with world(Particles(x, radius=0.1, pinned=pinned), [*features(), *walls], substeps=1, **settings) as w:
            for friction, restitution in ((0.0, 0.0), (0.5, 0.0), (0.0, 1.0), (0.4, 1.0)):
                for wall in walls:
                    wall.friction, wall.restitution = friction, restitution
                deepest = 0.0
                for iterations in (1, 2, 8):
                    w.iterations = iterations
                    for ratio in (0.1, 1.0, 10.0, 100.0):
                        w.position, w.velocity = x, 60 * ratio * aim
                        for _ in range(10):
                            w.step(1 / 60)
                            deepest = max(deepest, 0.1 - float(inside(w.position[:40]).min()))
                worst = max(worst, deepest)
                holds[f"{name}, friction {friction:g}, restitution {restitution:g}: {deepest:.1e} m"] = deepest <= 1e-12
    yield from summary(f"{worst:.0e} m outside", holds)


@row(80, "v h = 0.1 ... 100 half widths in a Box, a corner of two HalfSpaces, inside a Ball", "inside after every substep")
def _thrown() -> Findings:
    return _kept_in(lambda: [], [])


@row(81, "links that pull through a wall, 1 ... 8 iterations, restitution 0 ... 1", "inside after every substep")
def _drawn() -> Findings:
    pairs = np.stack([np.arange(20), np.arange(40, 60)], axis=1)
    return _kept_in(lambda: [Distance(pairs, 0.1, compliance=1e-5)], np.arange(40, 60), solver=Jacobi())


@row(46, "a rod of 1 mm, v h from 0.1 to 1000 mm", "nothing passes")
def _thin() -> Findings:
    n = 200
    rng = np.random.default_rng(2)
    x = np.stack([rng.uniform(-0.9, 0.9, n), np.full(n, 0.5)], axis=1)
    v = np.stack([np.zeros(n), -(10.0 ** rng.uniform(-4, 0, n)) * 600], axis=1)
    rod = Capsule((-1.0, 0.0), (1.0, 0.0), 0.0005)
    with world(Particles(x, velocity=v), [rod, Gravity()], substeps=1) as w:
        lowest = np.inf
        for _ in range(600):
            w.step(1 / 600)
            lowest = min(lowest, float(w.position[:, 1].min()))
    yield at_most(f"lowest at {1e3 * lowest:.4f} mm", 0.0005 - lowest, 1e-12)


@row(47, "head-on at v h / r = 0.5, 0.9, 2, 5", "caught below 1, flagged above")
def _passing() -> Findings:
    with world(Particles([[-0.55, 0.0], [0.55, 0.0]], radius=0.1), [Contact()], substeps=10) as w:
        for ratio in (0.5, 0.9, 2.0, 5.0):
            v = ratio * 0.1 * 600
            w.position, w.velocity = w.particles.position, [[v, 0], [-v, 0]]
            told = "tunnelling-risk" in w.run(0.1).flags
            caught = w.position[0, 0] < w.position[1, 0]
            yield f"{ratio:g}: {'flagged' if told else 'caught'}", told if ratio > 1 else caught and not told


@row(48, "deep initial overlap: 200 discs in a tenth of their room", "no explosion: they part without kinetic energy")
def _deep() -> Findings:
    x = np.random.default_rng(0).uniform(0, 0.5, (200, 2))
    with world(Particles(x, radius=0.1), [Contact(push_out=0.5)]) as w:
        energies = []
        for _ in range(240):
            w.step(1 / 60)
            energies.append(kinetic_energy(w))
        yield at_most(f"{max(energies):.1f} J", max(energies), 1e-12, finite(w))
        yield at_most(f"overlap {w.last.overlap:.2g}", w.last.overlap, 0.02)


@row(82, "a link draws a disc through a pinned one", "flagged; not where the link is as long as it should be")
def _drawn_through() -> Findings:
    for rest in (0.7, 3.0):
        start = Particles([[0.0, 0], [3.0, 0], [1.15, 0.0]], radius=0.3, pinned=[1, 2])
        with world(start, [Distance([[0, 1]], rest), Contact()], substeps=1) as w:
            told, moved = "tunnelling-risk" in w.step(1 / 60).flags, float(w.position[0, 0])
            yield f"to {moved:.2f} m: {'flagged' if told else 'not flagged'}", told == (moved > 0.3)


@row(
    83, "skins of 0.01 ... 2 contact distances, discs with soft links", "the same bits, as nothing moves past a disc in a substep"
)
def _skins() -> Findings:
    n, rng = 60, np.random.default_rng(3)
    start = Particles(rng.uniform(-2, 2, (n, 2)), velocity=rng.normal(size=(n, 2)) * 4, radius=0.1)
    rest, made = rng.uniform(0.2, 1.5, n // 2), []
    for skin in (0.002, 0.05, 0.4):
        features = [Gravity(9.81), Distance(np.arange(n).reshape(-1, 2), rest, compliance=3e-3), Contact(skin=skin)]
        with world(start, [*features, Box((-2.2, -2.2), (2.2, 2.2))], substeps=4) as w:
            w.run(1.0)
            made.append(w.hash())
            yield f"overlap {w.last.overlap:.2g}", made[-1] == made[0]


@row(67, "particles outside every wall", "they still collide")
def _outside() -> Findings:
    start = Particles([[-50.0, 0], [-50.5, 0.0]], velocity=[[-1, 0], [1, 0]], radius=0.2)
    with world(start, [Contact()]) as w:
        w.run(1.0)
        gap = abs(w.position[0, 0] - w.position[1, 0])
        yield at_most(f"{gap:.3f} m apart", 0.4 - gap, 1e-12)


@row(88, "a periodic box hardly longer than two contacts, and one 1e5 times as long", "each pair meets once; no energy is made")
def _small_periodic() -> Findings:
    for size in (2.01, 2e5):
        x = np.array([[0.1, 0.2], [1.1, 1.2]]) + size * np.array([[0, 0], [3, -2]])
        v = np.array([[1.0, 0.5], [-1, -0.8]])
        start = Particles(x, velocity=v, radius=0.5)
        with world(start, [Periodic((0, 0), (size, size)), Contact(restitution=1.0)], substeps=20) as w:
            w.run(2.0)
            gained = abs((w.velocity**2).sum() / (v**2).sum() - 1)
            yield f"{size:g} m: collided", not np.allclose(w.velocity, v)
            yield at_most(f"energy to {gained:.0e}", gained, 1e-12)
            yield "momentum kept", np.allclose(w.velocity.sum(axis=0), v.sum(axis=0), atol=1e-9)


@row(103, "crosses of four discs hook into each other in a heap, e = 0.1 ... 1", "no energy is made, none is pressed together")
def _crosses() -> Findings:
    rng, cross = np.random.default_rng(0), 0.28 * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    angle = rng.uniform(0, 2 * np.pi, 30)
    turn = np.moveaxis(np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]), 2, 0)
    places = 0.6 + 0.8 * np.stack(np.divmod(np.arange(30), 6)[::-1], axis=1)
    x, body = (places[:, None] + cross @ turn).reshape(-1, 2), np.arange(120).reshape(30, 4)
    pairs = body[:, [[0, 1], [1, 2], [2, 3], [3, 0], [0, 2]]].reshape(-1, 2)
    gains, overlaps = [], []
    for name, holding in (("links", lambda: Distance(pairs)), ("clusters", lambda: ShapeMatch(body))):
        for e in (0.1, 0.9, 1.0):
            features = [Gravity(9.81), holding(), Contact(friction=0.5, restitution=e), Box((0, 0), (5.3, 20), friction=0.5)]
            with world(Particles(x, radius=0.1), features, substeps=8) as w:
                energy = [w.step(1 / 60).energy for _ in range(240)]
                gains.append((max(energy) / energy[0] - 1, f"{name}, e = {e}"))
                overlaps.append(w.last.overlap)
    yield at_most(f"energy {max(gains)[0]:+.0e} ({max(gains)[1]})", max(gains)[0], 0.0)
    yield at_most(f"overlap of at most {max(overlaps):.2g} radii at the end", max(overlaps), 0.05)


@row(70, "resting contact on a moving belt", "friction drags the right way: up to its speed after v / (mu g), then along")
def _belt() -> Findings:
    belt = Capsule((-50.0, -1.0), (50.0, -1.0), 1.0, friction=0.4)
    with world(Particles([[0.0, 0.1]], radius=0.1), [Gravity(9.81), belt]) as w:
        for k in range(90):
            shift = (k + 1) / 60
            belt.a, belt.b = (-50.0 + shift, -1.0), (50.0 + shift, -1.0)
            w.step(1 / 60)
        error = abs(w.position[0, 0] - (1.5 - 0.5 / (0.4 * 9.81)))
        yield at_most(f"{error:.0e} m off", error, 2e-7)
        yield at_most("at the speed of the belt", abs(w.velocity[0, 0] - 1), 1e-12)


@row(85, "another particle at 1e2 ... 1e6 m, in f32: discs in a round room, beads on a wire", "the same bits for the rest")
def _far() -> Findings:
    x = [(-0.5, 0.2), (0.0, 0.1), (0.5, 0.3), (0.1, 0.4), (2.017036, -0.207938), (2.5, -1.0)]

    def places(far: float, *contact: Contact) -> np.ndarray:
        """Return the final positions of all other particles, with a static particle at (far, far)."""
        wire = Path([4, 5], [[2.0, 0.0], [2.5, -1.0], [3.0, -0.5], [4.0, -1.5]])
        start = Particles([*x, (far, far)], radius=0.05, pinned=[len(x)])
        with world(start, [Gravity(9.81), Sdf(_round_room), wire, *contact], precision="f32") as w:
            w.run(1.0)
            return w.position[: len(x)]

    near, alone = places(1e2, Contact()), places(1e2)
    for far in (1e4, 1e5):
        yield f"{far:g} m", np.array_equal(near, places(far, Contact()))
    yield "1e6 m, without contacts", np.array_equal(alone, places(1e6))
    # f32 cannot distinguish neighbouring cells of 5 cm there.
    yield from refused((lambda: places(1e6, Contact()), "Shift the scene"))
    gap = float((0.95 - np.linalg.norm(near[:4], axis=1)).min())
    yield at_most(f"{abs(gap):.0e} m above the ground", abs(gap), 3e-6)


@ti.func
def _round_room(p):
    """Return the distance from a round wall, measured from inside."""
    return 1 - p.norm()
