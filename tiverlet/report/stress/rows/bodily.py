"""Rows about elements and bodies that have no extent, are inverted or flat, or spin too fast."""

import numpy as np

from ....constraints import Area, Bend, Distance, ShapeMatch, Volume
from ....forces import Drag
from ....measure import momentum
from ....particles import Particles
from .row import Findings, at_most, finite, row, world

TET = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


@row(54, "triangles without area, tetrahedra in one point", "no gradient: skipped, no 0 / 0, and the residual says so")
def _flat() -> Findings:
    x = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 0, 0], [5, 0, 0], [5, 0, 0], [7, 0, 0], [7, 0, 0], [7, 0, 0], [7, 0, 0.0]])
    features = [Area([[0, 1, 2], [3, 4, 5]], rest=1.0), Volume([[6, 7, 8, 9]], rest=0.1)]
    with world(Particles(x), features, iterations=4) as w:
        first = w.step(1 / 60).residual
        w.run(0.5)
        yield f"residual {first:.2g}", finite(w) and first >= 0.99


@row(55, "a tetrahedron inside out", "returns to the positive side")
def _inverted() -> Findings:
    x = TET.copy()
    x[3, 2] = -1.0
    edges = [(i, j) for i in range(4) for j in range(i)]
    length = [np.linalg.norm(TET[i] - TET[j]) for i, j in edges]
    solid = Volume([[0, 1, 2, 3]], rest=1 / 6)
    with world(Particles(x), [solid, Distance(edges, length, compliance=1e-2), Drag(20.0)], iterations=4) as w:
        w.run(1.0)
        volume = float(solid.rest_of(w.position)[0])
        yield at_most(f"volume {volume:.4f} of {1 / 6:.4f}", abs(volume * 6 - 1), 1e-12)


@row(56, "bending at the angles 0 and pi", "finite gradients: straight beams bend, folded ones open")
def _folded() -> Findings:
    x = np.array([[0.0, 0], [1, 0], [2, 0], [5, 0], [6, 0], [5, 0]])
    bend = Bend([[0, 1, 2], [3, 4, 5]], [0.5, 0.5])
    links = Distance([[0, 1], [1, 2], [3, 4], [4, 5]])
    with world(Particles(x), [bend, links, Drag(5.0)], iterations=10) as w:
        w.run(3.0)
        error = np.abs(bend.violation(w.position))
        yield at_most(f"off by {error[0]:.0e} and {error[1]:.0e} rad", error.max(), 1e-12, finite(w))


@row(57, "shapes that are flat, on a line, in a point, mirrored, of one particle", "the rest shape comes back, never mirrored")
def _ranks() -> Findings:
    rng = np.random.default_rng(0)
    full, flat = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    flat[:, -1] = 0
    parts = [full, flat, np.outer(rng.normal(size=6), [1.0, 2, 3]), np.full((6, 3), 0.5), full, full[:1]]
    q = np.concatenate([a + 3 * k for k, a in enumerate(parts)])
    x = q.copy()
    x[24:30, 0] = 24 - x[24:30, 0]
    clusters = [np.arange(6 * k, min(6 * k + 6, len(q))) for k in range(6)]
    start = Particles(x, velocity=rng.normal(size=x.shape))
    with world(start, [ShapeMatch(clusters, rest=q)]) as w:
        w.run(1.0)
        y = w.position
        far = 0.0
        for c in clusters:
            now, rest = (np.linalg.norm(a[c][:, None] - a[c][None], axis=2) for a in (y, q))
            far = max(far, float(np.abs(now - rest).max()))
        turned = float(np.linalg.det((y[24:30] - y[24]).T @ (q[24:30] - q[24])))
        lost = float(np.abs(momentum(w) - start.velocity.sum(axis=0)).max())
    yield at_most(f"lengths to {far:.0e} m", far, 1e-12)
    yield "not mirrored", turned > 0
    yield at_most(f"momentum {lost:.0e}", lost, 3e-9)


@row(58, "shapes that spin by 90 degrees and more in a substep", "shape kept, no energy made, flagged")
def _spinning() -> Findings:
    x = np.array([[1.0, 0], [-1, 0], [0, 0.7], [0, -0.7]])
    with world(Particles(x), [ShapeMatch([np.arange(4)])]) as w:
        for spin in (3000.0, 1e5):
            w.position, w.velocity = x, spin * np.stack([-x[:, 1], x[:, 0]], axis=1)
            kinetic = 0.5 * (w.velocity**2).sum()
            report = w.run(1.0)
            kept = abs(np.linalg.norm(w.position[0] - w.position[1]) - 2) < 1e-6
            yield f"{spin:g} rad/s flagged, no energy made", kept and w.last.energy <= kinetic and "turned" in report.flags
