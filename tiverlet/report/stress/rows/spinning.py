"""Rows about particles that spin: fast, of unequal mass and size, or without a radius."""

import numpy as np

from ....colliders import Box
from ....contact import Contact
from ....forces import Gravity
from ....measure import angular_momentum, momentum
from ....particles import Particles
from .row import Findings, at_most, finite, refused, row, world


@row(100, "spins of 1e4 rad/s in f32, in 2D and 3D", "finite, and energy falls in every frame")
def _fast() -> Findings:
    for dim in (2, 3):
        x = 0.5 * np.stack(np.meshgrid(*[np.arange(4.0)] * dim, indexing="ij"), -1).reshape(-1, dim) + 0.3
        spin = 1e4 * np.where(np.arange(len(x)) % 2, 1.0, -1.0)
        start = Particles(x, radius=0.2, spin=spin if dim == 2 else spin[:, None] * [0.6, 0.0, 0.8])
        features = [Gravity(), Contact(friction=0.5, restitution=0.3), Box(np.zeros(dim), np.full(dim, 2.2), friction=0.5)]
        with world(start, features, precision="f32") as w:
            reports = [w.step(1 / 60) for _ in range(120)]
            before, after = reports[0].energy - reports[0].energy_change, reports[-1].energy
            gained = max(report.energy_change for report in reports[10:])
            yield f"{dim}D: {1 - after / before:.1%} of the energy gone after 2 s", finite(w) and gained < 0 and after < before


@row(101, "spins, masses of 1 : 1e6 and radii of 1 : 100 that collide", "momentum and angular momentum kept, no energy made")
def _unequal() -> Findings:
    for heavy in (1.0, 1e6):
        start = Particles(
            [(0, 0, 0), (2.0, 0.3, 0.1)], velocity=[(0, 0, 0), (-3.0, 0, 0)], mass=[heavy, 1.0], radius=[1.0, 0.01],
            spin=[(0, 0, 50.0), (500.0, 0, 0)],
        )  # fmt: skip
        with world(start, [Contact(friction=0.7, restitution=(0.9, 0.5))]) as w:
            before = momentum(w), angular_momentum(w, (1, 2, 3))
            gained = max(w.step(1 / 60).energy_change for _ in range(60))
            off = [
                np.abs(a - b).max() / heavy for a, b in zip((momentum(w), angular_momentum(w, (1, 2, 3))), before, strict=False)
            ]
            yield at_most(f"1 : {heavy:g} off by {max(off):.1e}", max(off), 1e-12)
            yield at_most(f"energy {gained:+.0e} J", gained, 0.0)
            yield f"1 : {heavy:g} hit", w.velocity[1, 0] > -2.0


@row(102, "particles without a radius among those that spin",
     "a spin of theirs is refused by name; without one they touch as before")  # fmt: skip
def _points() -> Findings:
    yield from refused((lambda: Particles([(0, 0), (1, 0)], radius=[0.1, 0.0], spin=[1.0, 2.0]), r"spin\[1\]"))
    start = Particles([(0, 0.5), (0.05, 0.9)], radius=[0.1, 0.0], spin=[30.0, 0.0])
    features = [Gravity(), Contact(friction=0.5), Box((-1, 0), (1, 2), friction=0.5)]
    with world(start, features) as w:
        report = w.run(2.0)
        yield "the point does not spin", finite(w) and w.spin[1] == 0.0
        yield at_most(f"overlap {report.overlap:.2g}", report.overlap, 1e-5)
