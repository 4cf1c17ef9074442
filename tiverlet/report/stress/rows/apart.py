"""Rows about what acts between particles, and between frames: pair forces, sleep, copies, orders, edits and uneven frames."""

from collections.abc import Sequence

import numpy as np

from ....colliders import Box, HalfSpace
from ....constraints import Distance
from ....contact import Contact
from ....device import ti
from ....features.feature import Feature
from ....forces import Gravity, PairForce
from ....particles import Particles
from ....shapes import net, rope
from ....step.sleep import Sleep
from ...accuracy.cases import known
from ...accuracy.cases.chains import hung
from .row import Findings, at_most, finite, row, world

G = 9.81


@ti.func
def _spring(r):
    """Return the force of a spring of 1e4 N/m without length."""
    return -1e4 * r


@ti.func
def _of_spring(r):
    """Return the energy of that spring."""
    return 5e3 * r.norm_sqr()


@ti.func
def _pull(r):
    """Return an attraction of 1 N m^2 / r^2."""
    return -r / r.norm() ** 3


@row(
    113, "springs between all pairs, omega h = 0.05 ... 5, masses of 1 : 1e6", "a cos(omega t) to 3 (omega h)^2; beyond 2 flagged"
)
def _pairs() -> Findings:
    for heavy in (1.0, 1e6):
        start = Particles([[1.0, 0], [0, 0]], mass=[1.0, heavy])
        with world(start, [PairForce(_spring, potential=_of_spring)]) as w:
            omega = np.sqrt(1e4 * (1 + 1 / heavy))
            for n in (40, 4):
                w.position, w.velocity, w.substeps = start.position, np.zeros((2, 2)), n
                gain = max(w.step(1 / 60).energy for _ in range(6)) / 5e3 - 1
                error = abs(w.position[0, 0] - w.position[1, 0] - np.cos(0.1 * omega))
                bound = 1.5 * 0.1 * omega * (omega / 60 / n) ** 2 / 24  # of the phase, omega t (omega h)^2 / 24
                yield at_most(f"1 : {heavy:g}, {n} substeps: {error:.0e}", error, bound)
                yield at_most(f"energy {gain:+.0e}", gain, 0.0)
            w.position, w.velocity, w.substeps = start.position, np.zeros((2, 2)), 1
            flags = set().union(*(w.step(1 / 30).flags for _ in range(3)))
            yield f"at omega h > 2: {', '.join(sorted(flags))}", "stiff-force" in flags


@row(114, "particles that attract each other as 1 / r^2 and meet head on", "no energy is made, or it is flagged")
def _meet() -> Findings:
    for substeps in (20, "auto"):
        with world(Particles([[-1.0, 0], [1, 0]]), [PairForce(_pull)], substeps=substeps) as w:
            reports = [w.step(1 / 60) for _ in range(180)]
            told = any(r.flags & {"stiff-force", "energy-gain", "substeps-capped"} for r in reports)
            speed = float(np.abs(w.velocity).max())
            yield f"{substeps}: {speed:.2g} m/s in the end, {'flagged' if told else 'not flagged'}", told or speed < 10


@row(115, "sleep of 1e-12 ... 1 m/s after 1e-3 ... 1 s",
     "no energy; at rest all sleep, and a blow wakes all")  # fmt: skip
def _sleep() -> Findings:
    k = np.arange(20)
    x = np.stack([0.25 + 0.42 * (k % 5), 0.25 + 0.45 * (k // 5)], axis=1)

    def scene(*more):
        """Provide a heap of discs that fall into a box."""
        return world(Particles(x, radius=0.2), [Gravity(G), Contact(friction=0.5), Box((0, 0), (2.2, 9), friction=0.5), *more])

    for speed, time in ((1e-12, 1e-3), (1e-3, 1.0), (1.0, 1.0)):
        with scene(Sleep(speed, time)) as w:
            energies = [w.step(1 / 60).energy for _ in range(600)]
            asleep = w.last.asleep
            yield f"{speed:g} m/s, {time:g} s: {asleep} of 20 sleep", asleep == 20
            yield at_most("energy", (max(energies) - energies[0]) / abs(energies[0]), 0.0)
            w.velocity = np.where(k[:, None] == 19, [0.0, -50.0], 0.0)
            w.step(1 / 60)
            yield "a blow wakes all", w.last.asleep == 0


@row(116, "6 copies with masses, lengths and speeds of 1e-6 ... 1e9, some out of range", "each has the same bits as alone")
def _copies() -> Findings:
    from ....worlds import Worlds  # here, since it stands on all else that is imported

    size = 10.0 ** np.linspace(-6, 9, 6)
    x = np.array([[0.0, 0], [1, 0], [2, 0.5]])

    def alone(s: float):
        """Provide one of the worlds."""
        start = Particles(x, mass=[1.0, s, 1 / s], velocity=[[0, 0], [0, s], [1 / s, 0]], pinned=[0])
        return world(start, [Gravity(G), Distance([[0, 1], [1, 2]], compliance=[0.0, 1e-3 / s])], precision="f32")

    ends, made = [], []
    for s in size:
        with alone(s) as w:
            made.append(w.clone())
            w.run(1.0)
            ends.append((w.position, w.velocity))
    with Worlds(made) as all_:
        all_.run(1.0)
        same = [
            np.array_equal(all_.position[k], p, equal_nan=True) and np.array_equal(all_.velocity[k], v, equal_nan=True)
            for k, (p, v) in enumerate(ends)
        ]
    for w in made:
        w.close()
    yield f"{sum(same)} of {len(same)} the same", all(same)


@row(117, "orders 4, 6 and 8 of a chain of masses 1 : 1e3, and at 1 substep",
     "more digits with each order; finite, no energy")  # fmt: skip
def _orders() -> Findings:
    want = known("D07_massratio_1000")["values"]["t0.5"]["heavy_xy"]
    for order, limit in ((4, 5e-9), (6, 1e-10), (8, 1e-12)):
        particles, features = hung("D07_massratio_1000")
        with world(particles, features, order=order, substeps=20) as w:
            w.run(0.5)
            error = float(np.linalg.norm(w.position[2] - want))
            yield at_most(f"order {order}: {error:.0e} m", error, limit)
    for order in (4, 6, 8):
        particles, features = hung("D01_double_pendulum")
        with world(particles, features, order=order, substeps=1) as w:
            energies = [w.step(1 / 60).energy for _ in range(600)]
            gain = (max(energies) - energies[0]) / np.ptp(energies)
            yield at_most(f"order {order}, 1 substep: energy {gain:+.0e}", gain, 1.0, finite(w))


@row(118, "discs and links of 1e-3 ... 1e3 kg that come and go in each of 40 frames",
     "what they do not touch has the same bits; they fall by g t")  # fmt: skip
def _edits() -> Findings:
    rng = np.random.default_rng(0)
    x = np.array([[0.0, 0], [0.6, 0], [1.2, 0], [1.8, 0]])
    features = [Gravity(G), Distance([[0, 1], [1, 2], [2, 3]]), Contact(), HalfSpace((0, 1), -1.0)]
    start = Particles(x, radius=0.1, pinned=[0])
    with world(start, features) as w, w.clone() as plain:
        top = []
        for _ in range(40):
            plain.step(1 / 60)
            at = np.array([[50.0, 5.0], [50.5, 5.0]]) + rng.uniform(0, 20, (1, 2))
            mass = 10.0 ** rng.uniform(-3, 3, 2)
            more = w.add(Particles(at, radius=0.1, mass=mass), [Distance([[len(w.position), len(w.position) + 1]])])
            w.step(1 / 60)
            top.append(np.abs(w.velocity[more]).max())
            w.remove(more, features=[w.features[-1]])
        same = np.array_equal(w.position, plain.position) and np.array_equal(w.velocity, plain.velocity)
        yield "the same bits for the rest", same
        yield at_most(f"speeds of new discs {max(top):.3g} m/s", max(top), 2 * G / 60)


def uneven(particles: Particles, features: Sequence[Feature], late: float) -> float:
    """Return the largest energy of a scene in frames of 1e-4 ... 1/30 s, over the start, as a share of m g L.

    late: the share of frames that last 0.25 s. They do not count, as their energy has an error of second order in their substep.
    """
    most, supply = -np.inf, G * float(np.ptp(particles.position, axis=0).max() * particles.mass[~particles.pinned].sum())
    with world(particles, features, precision="f32") as w:
        for seed in range(3):
            rng = np.random.default_rng(seed)
            w.position, w.velocity, first = particles.position, particles.velocity, None
            for _ in range(400):
                waits = rng.random() < late
                report = w.step(0.25 if waits else rng.uniform(1e-4, 1 / 30))
                first = report.energy - report.energy_change if first is None else first
                most = most if waits else max(most, (report.energy - first) / supply)
    return most


def hanging() -> dict[str, tuple[Particles, list[Feature]]]:
    """Return ropes and a net."""
    line, sheet = rope((0, 2), (1, 2), points=8), net((0, 0, 0), (1, 0, 0), (0, 0, 1), (6, 6))
    return {
        "rope": (Particles(line.position, mass=0.05, pinned=[0]), [Gravity(G), Distance(line.links)]),
        "taut rope": (Particles(line.position, mass=0.05, pinned=[0, 7]), [Gravity(G), Distance(line.links)]),
        "soft rope": (Particles(line.position, mass=0.05, pinned=[0]), [Gravity(G), Distance(line.links, compliance=1e-4)]),
        "net": (Particles(sheet.position, mass=0.05, pinned=[0, 5]), [Gravity(G), Distance(sheet.links)]),
    }


@row(119, "a heap and a soft rope in frames of 1e-4 ... 1/30 s, of which one of 60 lasts 0.25 s", "no energy")
def _uneven() -> Findings:
    k = np.arange(20)
    heap = Particles(np.stack([0.25 + 0.42 * (k % 5), 0.25 + 0.45 * (k // 5)], axis=1), radius=0.2)
    gain = uneven(heap, [Gravity(G), Contact(friction=0.5), Box((0, 0), (2.2, 9), friction=0.5)], 1 / 60)
    yield at_most(f"heap {gain:+.1e} m g L", gain, 1e-7)
    gain = uneven(*hanging()["soft rope"], 1 / 60)
    yield at_most(f"soft rope {gain:+.1e} m g L", gain, 1e-3)


@row(120, "rigid ropes, one with an end 40 times as heavy, and a net in such frames, without and with late ones",
     "at most 3e-2 m g L")  # fmt: skip
def _uneven_rigid() -> Findings:
    scenes = hanging()
    start, features = scenes["rope"]
    heavy = Particles(start.position, mass=np.r_[np.full(7, 0.05), 2.0], pinned=[0])
    scenes = {**scenes, "heavy end": (heavy, [f.copy() for f in features])}
    del scenes["soft rope"]
    for name, scene in scenes.items():
        for late in (0.0, 1 / 60):
            gain = uneven(scene[0], [f.copy() for f in scene[1]], late)
            yield f"{name}{', late' * (late > 0)} {gain:+.1e} m g L", gain <= 3e-2
