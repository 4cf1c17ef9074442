"""Rows about invalid arguments, which are refused with the name and the index of the first invalid value."""

from typing import Any

import numpy as np

from .... import solvers
from ....colliders import Box, HalfSpace
from ....constraints import Distance, Rope
from ....contact import Contact
from ....features.feature import Feature
from ....forces import Gravity
from ....neighbours import Periodic
from ....particles import Particles
from ....world import World
from .row import INF, NAN, Findings, at_most, finite, refusals, refused, row, warned, world

LINE = np.arange(8.0).reshape(4, 2)


def given(**settings):
    """Return a function that makes particles with invalid settings."""
    return lambda: Particles(LINE, **settings)


def scene(*features: Feature, **settings):
    """Return a function that makes a world with invalid features or settings."""
    return lambda: World(Particles(LINE, radius=0.1), [f.copy() for f in features], **settings)


CHAIN, SPRING = Distance([[0, 1], [1, 2]]), Distance([[0, 1]], compliance=1.0)
SMALL = Periodic((0, 0), (9, 0.3))
NO_SUCH: Any = {"warm_start": 0.9}

refusals(3, "mass 0 (infinite inverse)", "build error",
    (given(mass=0.0), r"mass\[0\] = 0"),
    (given(mass=[1, 1, 0, 1]), r"mass\[2\] = 0"),
)  # fmt: skip
refusals(5, "negative mass, NaN mass", "build error naming the index",
    (given(mass=[1, 2, -3, 4]), r"mass\[2\] = -3"),
    (given(mass=[1, NAN, 1, 1]), r"mass\[1\] = nan"),
)  # fmt: skip
refusals(10, "compliance < 0 or NaN", "build error",
    (lambda: Distance([[0, 1]], compliance=-1e-3), r"compliance\[0\] = -0.001"),
    (lambda: Distance([[0, 1]], compliance=NAN), r"compliance\[0\] = nan"),
)  # fmt: skip
refusals(19, "rest length < 0, NaN", "build error",
    (lambda: Distance([[0, 1], [1, 2]], rest=[1, -2]), r"rest\[1\] = -2"),
    (lambda: Rope([[0, 1]], length=NAN), r"length\[0\] = nan"),
)  # fmt: skip
refusals(28, "coordinates > 2^22 cells", "refused, so that cells and their neighbours stay exact in f32",
    (lambda: World(Particles([[0, 0], [1e6, 0]], radius=0.05), [Contact()]), r"position\[1, 0\] = 1e"),
)  # fmt: skip
refusals(60, "restitution > 1 or < 0", "error",
    (lambda: Contact(restitution=1.5), "restitution"),
    (lambda: Contact(restitution=-0.1), "restitution"),
    (lambda: Box((0, 0), (1, 1), restitution=1.01), "restitution"),
)  # fmt: skip
refusals(63, "over-relaxation of 4/3 and more", "refused: with one pass it is unstable",
    (scene(CHAIN, solver=solvers.Jacobi(1.5)), r"4/3 / lambda_max"),
    (scene(SPRING, solver=solvers.Jacobi(1.4)), "stable only below 4/3"),
)  # fmt: skip
refusals(64, "Chebyshev with kappa > 1.29 k^2", "refused",
    (scene(CHAIN, solver=solvers.Chebyshev(kappa=200.0), iterations=10), r"kappa <= 1.29 iterations\^2"),
)  # fmt: skip
refusals(65, "warm starting with one pass", "refused: it diverges always, so there is no such setting",
    (lambda: solvers.Jacobi(**NO_SUCH), "warm_start"),
    (lambda: solvers.Direct(**NO_SUCH), "warm_start"),
    (lambda: solvers.Chebyshev(**NO_SUCH), "warm_start"),
    (scene(**NO_SUCH), "warm_start"),
)  # fmt: skip
refusals(66, "substeps 0, iterations 0, what is no integer", "error",
    (scene(substeps=0), "substeps = 0"),
    (scene(substeps=2.5), "substeps = 2.5"),
    (scene(iterations=-1), "iterations = -1"),
    (scene(iterations=0), "iterations = 0"),
)  # fmt: skip
refusals(87, "a periodic box that is none, or too small for contacts, links and forces in it; walls across it", "build error",
    (lambda: Periodic((0, 0), (1, 0)), "from 0 to 0 m, which is no length"),
    (lambda: Periodic((0, 0), (1, NAN)), "high"),
    (scene(Periodic((0, 0), (9, 0.39)), Contact()), "touch up to 0.2 m apart"),
    (scene(SMALL, Distance([[0, 1]], 0.2)), "link 0 holds particles up to 0.2 m"),
    (scene(SMALL, Box((0, 0), (9, 9))), "stops what goes along x"),
    (scene(SMALL, HalfSpace((0, 1))), "stops what goes along y"),
)  # fmt: skip


@row(13, "dt <= 0, NaN, inf", "error, and nothing has moved")
def _frames() -> Findings:
    with world(Particles([[0.0, 1.0]]), [Gravity()]) as w:
        before = w.hash()
        yield from refused(*((lambda dt=dt: w.step(dt), "dt") for dt in (0.0, -1.0, NAN, INF)))
        yield "nothing has moved", w.hash() == before


@row(20, "link of a particle to itself, index out of range, duplicates", "error, error, warning")
def _indices() -> Findings:
    yield from refused(
        (lambda: Distance([[0, 1], [2, 2]]), r"pairs\[1\] = \(2, 2\)"),
        (scene(Distance([[0, 1], [3, 250]])), r"pairs\[1\] = \(3, 250\)"),
        (lambda: Distance([[0, -1]]), r"pairs\[0\] = \(0, -1\)"),
    )
    yield "duplicates are warned of", warned(lambda: Distance([[0, 1], [1, 0]]), "duplicate")


@row(26, "radius 0, negative, NaN, larger than the domain", "a point is allowed, the others are build errors")
def _radii() -> Findings:
    yield from refused(
        (given(radius=[1, 1, -1, 1]), r"radius\[2\] = -1"),
        (given(radius=NAN), r"radius\[0\] = nan"),
        (scene(Box((0, 0), (9, 0.15))), "does not hold a particle of radius 0.1"),
    )
    with world(Particles(LINE, radius=0.0), [Contact(), Gravity()]) as w:
        w.run(0.1)
        yield "points step", finite(w)


@row(38, "arrays that no longer fit after a change of the scene", "rejected")
def _stale() -> Findings:
    link = Distance([[0, 1]])
    with world(Particles([[0.0, 1.0], [1, 1]]), [link]) as w:
        yield from refused(
            (lambda: setattr(w, "position", [[0.0, 0.0]]), "position has shape"),
            (lambda: setattr(w, "velocity", np.zeros((3, 2))), "velocity has shape"),
            (lambda: World(Particles([[0.0, 1.0], [1, 1]]), [link]), "already acts in another world"),
            (lambda: World(Particles([[0.0, 1.0]]), [Distance([[0, 1]])]), r"pairs\[0\] = \(0, 1\)"),
        )


@row(49, "NaN or inf in input arrays", "build error with the index")
def _nan() -> Findings:
    with world(Particles(LINE)) as w:
        yield from refused(
            (lambda: Particles([[0, 0], [1, NAN]]), r"position\[1, 1\] = nan"),
            (given(velocity=(1, INF)), r"velocity\[1\] = inf"),
            (given(mass=[1, 1, 1, NAN]), r"mass\[3\] = nan"),
            (given(radius=INF), r"radius\[0\] = inf"),
            (lambda: Gravity(NAN), "g = nan"),
            (lambda: HalfSpace((0, 1), INF), "offset = inf"),
            (lambda: setattr(w, "position", [[0.0, 0], [0, 0], [0, NAN], [0, 0]]), r"position\[2, 1\] = nan"),
        )


@row(53, "infinite velocity", "error when it is set")
def _infinite() -> Findings:
    with world(Particles([[0.0, 0], [1, 0]], pinned=[0])) as w:
        yield from refused(
            (lambda: setattr(w, "velocity", [[0.0, 0], [INF, 0]]), r"velocity\[1, 0\] = inf"),
            (lambda: Particles([[0.0, 0]], velocity=(INF, 0)), r"velocity\[0\] = inf"),
        )


@row(59, "friction 0, 1e6, < 0, NaN", "frictionless, stick, error, error")
def _friction() -> Findings:
    yield from refused((lambda: Contact(friction=-0.1), "at least 0"), (lambda: HalfSpace((0, 1), friction=NAN), "friction"))
    for mu, way in ((0.0, 2.0), (1e6, 0.0)):
        floor = HalfSpace((0, 1), friction=mu)
        with world(Particles([[0.0, 0.1]], velocity=(2.0, 0.0), radius=0.1), [Gravity(), floor]) as w:
            w.run(1.0)
            yield at_most(f"friction {mu:g}: {w.position[0, 0]:.3g} m in 1 s", abs(w.position[0, 0] - way), 1e-12)


@row(90, "rays without direction, NaN, of another dimension, negative reach", "error naming the index, and nothing has moved")
def _rays() -> Findings:
    with world(Particles([[0.0, 1.0]], radius=0.1), [Rope(np.zeros((0, 2), dtype=int))]) as w:
        before = w.hash()
        yield from refused(
            (lambda: w.ray((0, 0), (0, 0)), "direction = 0"),
            (lambda: w.ray((0, 0), [(1, 0), (0, 0)]), r"direction\[1\] = 0"),
            (lambda: w.ray((0, 0), (NAN, 1)), r"direction\[0\] = nan"),
            (lambda: w.ray([(0, 0), (0, INF)], (0, 1)), r"origin\[1, 1\] = inf"),
            (lambda: w.ray((0, 0, 0), (0, 1)), "origin has shape"),
            (lambda: w.ray((0, 0), (0, 1), -1.0), r"reach\[0\] = -1"),
            (lambda: w.inside(Box((0, 0, 0), (1, 1, 1))), "but the particles are in 2D"),
        )
        yield "nothing has moved", w.hash() == before
