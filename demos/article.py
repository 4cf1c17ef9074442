"""The article's scene: discs of golden-ratio sizes and places fall onto a rope bridge and a chain in a box.

    python demos/article.py [article.rrd]

What to look for: nothing overlaps, nothing leaves the box, the chain keeps its length, and a disc is led along a path by
exponential smoothing, through all the others. Watch the recording with `rerun article.rrd`.
"""

import functools
import sys
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import tiverlet as tv

DT = 1 / 60
SECONDS = 8.0
WIDTH, HEIGHT = 8.0, 7.0


@dataclass
class Scene:
    """The world, and the parts of it that main() needs."""

    world: tv.World
    hand: tv.Pin
    chain: np.ndarray


def build(discs: int = 360, **settings) -> Scene:
    """Make discs above, a bridge of ropes below them, a chain from the ceiling, and a hand that holds one disc."""
    spots = tv.golden(np.arange(discs), dim=3)
    falling = tv.mix(np.array([0.3, 3.3]), np.array([WIDTH - 0.3, HEIGHT - 0.3]), spots[:, :2])
    sizes = tv.mix(0.045, 0.125, tv.smoothstep(0.0, 1.0, spots[:, 2]))
    bridge = tv.shapes.rope((0.07, 1.9), (WIDTH - 0.07, 1.9), points=51)
    chain = tv.shapes.rope((2.0, HEIGHT - 1.0), (4.4, HEIGHT - 1.0), points=13)
    both, (_, on_chain) = tv.shapes.join(bridge, chain)
    position = np.concatenate([both.position, [_path(0.0)], falling])
    radius = np.concatenate([np.full(51, 0.07), np.full(13, 0.09), [0.22], sizes])
    # Leave out discs that would overlap the hand, the bridge or the chain at the start.
    keep = np.ones(len(position), dtype=bool)
    pairs, _ = tv.measure.overlapping(position, radius * 1.02)
    keep[[j for i, j in pairs if i < 65 <= j]] = False
    particles = tv.Particles(
        position[keep],
        radius=radius[keep],
        mass=300 * np.pi * radius[keep] ** 2,
        pinned=[0, 50, on_chain.start],
    )
    hand = tv.Pin([64], _path(0.0), compliance=2e-5, damping=200.0)
    links = both.links
    features = [
        tv.Gravity(9.81),
        tv.Drag(0.02),
        tv.Rope(links[:50], length=0.168),
        tv.Distance(links[50:]),
        hand,
        tv.Contact(),
        tv.Box((0, 0), (WIDTH, HEIGHT)),
    ]
    return Scene(tv.World(particles, features, **{"substeps": 12, **settings}), hand, links[50:])


def play() -> tv.World:
    """Return the world for `tiverlet play article`: without the hand, since the user has the mouse."""
    scene = build()
    scene.world.remove(features=[scene.hand])
    return scene.world


def _path(time: float) -> np.ndarray:
    """Return the place towards which the hand is drawn at a given time: a figure of eight through the heap."""
    return np.array([WIDTH / 2 + 2.9 * np.sin(0.8 * time), 2.4 + 1.3 * np.sin(1.6 * time)])


def lead(scene: Scene) -> None:
    """Move the hand part of the way towards the path: the article's exponential smoothing."""
    target = tv.approach(scene.hand.target[0], _path(scene.world.time + DT), rate=6.0, dt=DT)
    scene.hand.target = target[None]


def check(scene: Scene, worst: tv.StepReport) -> None:
    """Check overlap, and that no disc left the box: contacts leave an overlap of up to 0.009 radii."""
    x, r = scene.world.position, 0.99 * scene.world.particles.radius[:, None]
    if not ((x > r) & (x + r < np.array([WIDTH, HEIGHT]))).all():
        raise SystemExit("a disc left the box")
    if worst.bad is not None or worst.overlap > 0.35:
        raise SystemExit(f"overlap of {worst.overlap:.2f} radii: {worst.notes}")


def main(path: str = "article.rrd") -> None:
    """Simulate, record, and print the results."""
    scene = build()
    world, reports, stretch = scene.world, [], 0.0
    rest = np.linalg.norm(np.diff(world.position[scene.chain], axis=1)[:, 0], axis=1)
    with tv.Recorder(path, world, overwrite=True) as recorder:
        for _ in track(range(round(SECONDS / DT)), description=f"{len(world.particles)} particles"):
            lead(scene)
            reports.append(world.step(DT))
            recorder.log()
            stretch = max(stretch, float(np.abs(tv.measure.strain(world, scene.chain, rest)).max()))
    first, last, worst = reports[0], reports[-1], functools.reduce(tv.StepReport.worse, reports)
    gain = last.energy - (first.energy - first.energy_change)
    check(scene, worst)
    table = Table(title=f"{path}: {len(world.particles)} particles, {world.substeps} substeps x {world.iterations} iterations")
    table.add_column("figure")
    table.add_column("value", justify="right")
    table.add_row("frames", str(len(reports)))
    table.add_row("time per frame, median (ms)", f"{1e3 * float(np.median([report.seconds for report in reports])):.2f}")
    table.add_row("worst overlap (radii of the smaller disc)", f"{worst.overlap:.3f}")
    table.add_row("overlap at the end (radii)", f"{last.overlap:.4f}")
    table.add_row("worst stretch of the chain", f"{stretch:.2%}")
    table.add_row("energy drift (J): lost in contacts and drag, added by the hand", f"{gain:.1f}")
    table.add_row("flags", ", ".join(sorted(worst.flags)) or "none")
    Console().print(table)
    for note in worst.notes:
        print(note)


if __name__ == "__main__":
    main(*sys.argv[1:2])
