"""Rows about steps, precision and forces: nothing is lost in f32, and non-finite values are reported in their frame."""

import numpy as np

from ....colliders import Box, HalfSpace
from ....constraints import Distance, ShapeMatch
from ....contact import Contact
from ....device import ti
from ....forces import Drag, Force, Gravity
from ....measure import angular_momentum
from ....particles import Particles
from ...accuracy.cases import CASES, known
from .row import Findings, at_most, refused, rerun, row, world

PAIR = Particles([[0.0, 0], [1, 0]], pinned=[0])


@row(6, "all particles static", "a step is no step, and nothing is divided by 0")
def _static() -> Findings:
    x = np.array([[0.0, 0], [1, 0], [2, 0.5]])
    links = Distance([[0, 1], [1, 2]], [1.0, 3.0])
    features = [Gravity(), links, Contact(), Drag(1.0), Box((0, 0), (2, 2))]
    with world(Particles(x, pinned=[0, 1, 2], radius=0.7, velocity=(3, 3)), features) as w:
        report = w.run(0.5)
        moved = np.abs(w.position - x).max()
        yield f"moved {moved:g} m", moved == 0 and not w.velocity.any() and np.isfinite(report.energy)


@row(11, "dt of 1e-6 s in f32", "gravity is not lost: the fall is right to 1e-3")
def _tiny() -> Findings:
    for precision, limit in (("f32", 5e-5), ("f32-compensated", 2e-7)):
        with world(Particles([[0.0, 10.0]]), [Gravity(9.81)], substeps=10_000, precision=precision) as w:
            w.run(0.2, dt=0.01)
            drop = 9.81 * 0.2**2 / 2
            error = abs(10 - w.position[0, 1] - drop) / drop
            yield at_most(f"{precision} {error:.1e}", error, limit)


@row(14, "another dt in each frame", "second order is kept: exact under a constant acceleration")
def _uneven() -> Findings:
    rng = np.random.default_rng(1)
    x, v, a = np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([0, -9.81])
    worst = 0.0
    with world(Particles([x], velocity=v), [Gravity(9.81)], substeps=4) as w:
        for _ in range(100):
            dt = rng.uniform(1e-3, 0.1)
            w.substeps = int(rng.integers(1, 9))
            w.step(dt)
            x, v = x + v * dt + a * dt**2 / 2, v + a * dt
            worst = max(worst, float(np.abs(w.position[0] - x).max() / np.abs(x).max()))
    yield at_most(f"{worst:.1e} of the way after 100 frames", worst, 1e-12)


@row(27, "coordinates of 1e4 and 1e6 m", "f32-compensated: a pendulum of 10 s is right to 5e-5 m")
def _offset() -> Findings:
    v = known("R06b_pendulum_state")["values"]["90deg_t10"]
    for far, limit in ((1e4, 5e-5), (1e6, 5e-5)):
        at = np.array([far, -far])
        start = Particles(at + [[0, 0], [1, 0]], pinned=[0])
        with world(start, [Gravity(9.81), Distance([[0, 1]])], substeps=40, precision="f32-compensated") as w:
            w.run(10.0)
            error = float(np.linalg.norm(w.position[1] - at - [v["x"], v["y"]]))
            yield at_most(f"{far:g} m: {error:.1e} m", error, limit)


@row(29, "coordinates of 1e19 m", "range error before the squares overflow, and a flag at run time")
def _range() -> Findings:
    yield from refused((lambda: Particles([[0, 1e19]]), r"position\[0, 1\] = 1e\+19 m is out of range"))
    with world(Particles([[0.0, 0.0]], velocity=(1e16, 0)), precision="f32") as w:
        yield "flagged on its way out", "out-of-range" in w.step(1.0).flags


@row(36, "no particle, one particle, no constraint", "steps run")
def _nothing() -> Findings:
    for x in (np.zeros((0, 2)), np.zeros((0, 3)), np.array([[1.0, 2.0]])):
        features = [Gravity(), Distance(np.zeros((0, 2), int)), Contact()]
        with world(Particles(x, radius=0.1), features) as w:
            yield f"{x.shape} runs", w.run(0.1).clean and w.position.shape == x.shape


@row(37, "1e6 particles", "at most 610 bytes each, no flag")
def _many() -> Findings:
    i = np.arange(1_000_000)
    x = np.stack([i % 1000, i // 1000], axis=1) * 1.05 + 0.5
    features = [Gravity(), Contact(), Box((0, 0), (1100, 1200))]
    with world(Particles(x, radius=0.5), features, substeps=2, precision="f32") as w:
        yield "no flag", w.step(1 / 60).clean
        size = sum(w.fields.values()) / len(x)
        yield at_most(f"{size:.0f} bytes each", size, 610)


@row(42, "1e6 substeps", "a pendulum keeps its energy to 3e-5 J and its angular momentum to 1e-12")
def _long() -> Findings:
    particles, features = CASES["S01_spherical_pendulum"].build()
    want = known("S01_spherical_pendulum")["values"]
    energy, spin = 0.0, []
    with world(particles, features, substeps=1000) as w:
        for _ in range(1000):
            energy = max(energy, abs(w.step(1.0).energy - want["energy_per_m"]))
            spin.append(angular_momentum(w)[1])
    drift = abs(np.mean(spin[-100:]) - np.mean(spin[:100])) / want["Ly"]
    yield at_most(f"energy {energy:.1e} J", energy, 3e-5)
    yield at_most(f"L {drift:.1e}", drift, 1e-12)


@ti.func
def _spoilt(x, v, t, i):
    """Return NaN for particle 3 after 0.1 s, else no force."""
    f = 0.0 * x
    if t > 0.099 and i == 3:
        f[0] = ti.sqrt(-1.0 - x[0] * x[0])
    return f


def check_nan_flag(*features, **settings) -> Findings:
    """Check that NaN of particle 3 is flagged in its frame, with the particle."""
    with world(Particles(np.arange(12.0).reshape(6, 2), radius=0.1), [Force(_spoilt), *features], substeps=4, **settings) as w:
        seen = [w.step(0.05) for _ in range(4)]
        others = np.isfinite(np.delete(w.position, 3, axis=0)).all()
    told = [("non-finite" in r.flags, r.bad) for r in seen]
    yield "particle 3 named on its frame", told == [(False, None)] * 2 + [(True, 3)] * 2
    yield "the others go on", others


@row(50, "NaN at run time", "flagged on its frame, with the particle; in f32 and f64")
def _nan() -> Findings:
    for precision in ("f32", "f64"):
        yield from check_nan_flag(precision=precision)


@row(51, "NaN and walls, which would clamp it", "flagged all the same")
def _clamped() -> Findings:
    return check_nan_flag(Box((-9, -9), (99, 99)), HalfSpace((0, 1), -5))


@row(52, "NaN and the cells of contacts", "flagged, and no memory is overwritten")
def _celled() -> Findings:
    return check_nan_flag(Contact(), precision="f32")


@row(61, "gravity 0, 1e6, another in each frame", "exact for what is constant in a frame")
def _gravity() -> Findings:
    pull = Gravity(0.0)
    with world(Particles([[0.0, 0.0]]), [pull], substeps=3) as w:
        for g in (0.0, 1e6, -1e6):
            pull.g = (0.0, -g)
            rerun(w, 0.5, 0.1)
            yield f"g = {g:g}", np.isclose(w.position[0, 1], -g * 0.125, rtol=1e-13, atol=0)
        w.position, w.velocity = np.zeros((1, 2)), np.zeros((1, 2))
        x, v = 0.0, 0.0
        for g in np.random.default_rng(0).uniform(-1e3, 1e3, 20):
            pull.g = (0.0, -g)
            w.step(0.1)
            x, v = x + v * 0.1 - g * 0.005, v - g * 0.1
        error = abs(w.position[0, 1] - x)
        yield at_most(f"20 of them: {error:.0e} m", error, 1e-12)


@ti.func
def _stiff(x):
    """Return the force of a spring of 1e6 N/m."""
    return -1e6 * x


@row(62, "a user's force with omega h > 2", "the growth is flagged, with a number of substeps that is stable")
def _stiffness() -> Findings:
    with world(Particles([[1e-6, 0.0]]), [Force(_stiff)], substeps=4) as w:
        report = [w.step(4 * 2.2e-3) for _ in range(3)][-1]
        note = next((n for n in report.notes if "omega h" in n), "at least 0 ")
        need = int(note.split("at least ")[1].split(" ")[0])
        yield f"{need} substeps advised", "stiff-force" in report.flags
        rerun(w, 1.0, 4 * 2.2e-3, substeps=max(1, need))
        yield at_most("they are stable", abs(w.position[0, 0]), 1e-6)


@row(68, "f32 against f64, the same scene", "the difference is within the floor of f32: 5e-6 m after 10 s of a pendulum")
def _floor() -> Findings:
    made = []
    for precision in ("f32", "f64"):
        with world(PAIR, [Gravity(9.81), Distance([[0, 1]])], substeps=10, precision=precision) as w:
            w.run(10.0)
            made.append(w.position)
    error = float(np.abs(made[0] - made[1]).max())
    yield at_most(f"{error:.1e} m", error, 5e-6)


@row(84, "drag, rate h = 1e-6 ... 1e4",
     "the velocity is that of the closed form to 1e-6, in every precision, also after another dt")  # fmt: skip
def _dragged() -> Findings:
    h = 1e-3
    for precision, limit in (("f32", 1e-6), ("f32-compensated", 1e-6), ("f64", 1e-12)):
        drag = Drag(0.0)
        with world(Particles([[0.0, 0.0]]), [Gravity(9.81), drag], substeps=1, precision=precision) as w:
            error = 0.0
            for z in 10.0 ** np.arange(-6, 5) * 2.5:
                w.position, w.velocity, drag.rate = np.zeros((1, 2)), np.zeros((1, 2)), z / h
                for dt, t in ((h, 1), (h, 2), (h / 2, 2.5), (h, 3.5)):
                    w.step(dt)
                    error = max(error, abs(w.velocity[0, 1] / (9.81 * np.expm1(-z * t) * h / z) - 1))
            yield at_most(f"{precision} {error:.0e}", error, limit)


def _whole(x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the momentum and angular momentum of particles of 1 kg."""
    spin = [x[:, j] @ v[:, k] - x[:, k] @ v[:, j] for j in range(x.shape[1]) for k in range(j)]
    return np.r_[v.sum(axis=0), spin]


@row(
    86,
    "velocities of linked, touching, spinning groups",
    "momentum and angular momentum of the motion, to 1e-12; where contacts bear loads, which act along the directions at the "
    "start of a substep, angular momentum to 1e-10",
)
def _momenta() -> Findings:
    rod = Particles([[0.5, 0], [-0.5, 0]], velocity=[[0, 18.5], [0, -18.5]])
    pushed = Particles([[0.0, 0], [0.5, 0], [1.2, 0.1]], velocity=[[1.0, 0], [1, 0], [0, 0]], radius=0.3)
    body = Particles([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], velocity=[[0.0, 1, 2], [3, 0, 0], [0, 0, 2], [0, 1, 0]])
    groups = {
        "rod at 37 rad/s": (rod, [Distance([[0, 1]])]),
        "pair that pushes a third disc": (pushed, [Distance([[0, 1]]), Contact()]),
        "rigid body": (body, [ShapeMatch([np.arange(4)])]),
        "soft body": (body, [ShapeMatch([np.arange(4)], compliance=1e-3)]),
    }
    for name, (start, features) in groups.items():
        with world(start, features, substeps=1) as w:
            errors, at, turn = [], start.position, 1e-10 if any(isinstance(f, Contact) for f in features) else 1e-12
            for _ in range(400):
                w.step(7e-4)
                seen, done = (_whole(w.position, v) for v in (w.velocity, (w.position - at) / 7e-4))
                errors.append(np.abs(seen - done) / np.abs(done).max())
                at = w.position
            error, dim = np.max(errors, axis=0), at.shape[1]
            yield at_most(f"{name}: momentum {error[:dim].max():.0e}", error[:dim].max(), 1e-12)
            yield at_most(f"angular momentum {error[dim:].max():.0e}", error[dim:].max(), turn)
