"""The velocity that a user reads, and writes back: for all constraints that may be soft."""

import numpy as np
import pytest

import tiverlet as tv

from .rows import ROWS, TETRA, WINGS

MASS = np.array([1.0, 2.5, 0.7, 4.0])
FLAT = WINGS[[0, 3, 1, 2], :2]
PLACES = {
    "Pin": lambda c, x, **soft: tv.Pin(c[:, 0], x[:, 0], **soft),
    "Snap": lambda c, x, **soft: tv.Snap(c[:, 0], 100.0, x[0, 0], **soft),
    "Path": lambda c, x, **soft: tv.Path(c[:, 0], [x[0, 0] - (9, 0), x[0, 0] + (9, 0)], smooth=False, **soft),
    "ShapeMatch 2D": lambda c, x, **soft: tv.ShapeMatch(c, x.reshape(-1, 2), **soft),
    "ShapeMatch 3D": lambda c, x, **soft: tv.ShapeMatch(c, x.reshape(-1, 3), **soft),
    "Motor": lambda c, x, **soft: tv.Motor(c, 0.0, **soft),
    "Winch": lambda c, x, **soft: tv.Winch(c, 0.0, **soft),
    "Volume of surfaces": lambda c, x, **soft: tv.Volume(np.concatenate([row[TETRA] for row in c]), **soft),
}
POINTS = {"ShapeMatch 3D": WINGS, "Volume of surfaces": WINGS, "ShapeMatch 2D": FLAT, "Motor": FLAT[:3], "Winch": FLAT[:2]}
STIFF = np.array([0.02, 0.05, 0.1, 0.2, 0.32, 0.5, 0.8, 1.3, 2.0, 5.0, 20.0])  # omega h, about, in 20 substeps


def scene(name, damped):
    """Blocks of one constraint each, as stiff as STIFF says, in motion; what of them there is to make a world of."""
    points = ROWS[name].points if name in ROWS else POINTS.get(name, FLAT[:1])
    (k, dim), m = points.shape, len(STIFF)
    corners, x = np.arange(m * k).reshape(m, k), np.tile(points, (m, 1, 1))
    alpha = 1 / (1200 * STIFF) ** 2
    if name in ROWS:
        probe = ROWS[name].make(corners, np.zeros(m))
        probe.prepare(tv.Particles(x.reshape(-1, dim)), np.ones(m * k))
        slopes, rest = probe.gradients(x.reshape(-1, dim)), probe.violation(x.reshape(-1, dim))
        size = (slopes**2).reshape(m, -1).sum(axis=1)
        if name not in ("Rope 2D", "AngleLimit 3D", "Spacer 2D"):  # what is one-sided only just touches
            rest = rest - 0.1 * ROWS[name].off
        made = ROWS[name].make(corners, rest, compliance=alpha * size, damping=damped * 2.4 / size)
    else:
        made = PLACES[name](corners, x, compliance=alpha, damping=damped * 2.4)
    v = 0.02 * np.random.default_rng(5).normal(size=points.shape)
    return tv.Particles(x.reshape(-1, dim), velocity=np.tile(v, (m, 1)), mass=np.tile(MASS[:k], m)), made


@pytest.mark.parametrize("name", [*ROWS, *PLACES])
def test_velocities_written_back_change_nothing(world, name):
    # Without gravity a block has the energy of its start. Read and written back after each frame, velocities may neither pump a
    # spring nor brake it by more than 1 - (1 - (omega h)^4 / 16) a start; with the force of a substep ago in them they grew by
    # 1 + (omega h)^2 / 4 a frame, e^(15 omega^2 h^2) a second.
    start, made = scene(name, damped=0)
    w = world(start, [made], precision="f64")
    blocks = len(STIFF)

    def kinetic(back):
        w.position, w.velocity = start.position, start.velocity
        out = []
        for _ in range(frames):
            if back:
                w.velocity = w.velocity
            w.step(1 / 60)
            out.append((w.particles.mass * (w.velocity**2).sum(axis=1)).reshape(blocks, -1).sum(axis=1))
        return np.array(out)

    for substeps, frames in (2, 600), (8, 300), (20, 200), (80, 60):
        w.substeps = substeps
        alone, back = kinetic(False), kinetic(True)
        few = frames // 5
        most, first, last = alone.max(axis=0), back[:few].max(axis=0), back[-few:].max(axis=0)
        assert (last <= 1.02 * np.maximum(first, most)).all(), (name, substeps, last / np.maximum(first, most))
        resolved = STIFF * 20 / substeps < 0.3
        assert (last >= 0.9 * alone[-few:].max(axis=0))[resolved].all(), (name, substeps, last / alone[-few:].max(axis=0))
