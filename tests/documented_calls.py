"""Calls as the pages and docstrings show them, for type checkers only; this file is never run."""

import numpy as np

import tiverlet as tv

links = np.array([[0, 1], [1, 2]])
features = [
    tv.Gravity(), tv.Gravity(9.81), tv.Gravity((0, -9.81, 0)), tv.Gravity(np.zeros(2)), tv.Drag(0.3), tv.Wind((1, 0), 0.5),
    tv.Attractor((0, 0), 1.0), tv.Attractor((0, 0), 1.0, softening=0.1),
    tv.Hand((0, 0)), tv.Hand((0, 0), 3, rate=10), tv.Contact(), tv.Contact(friction=0.3), tv.Contact(friction=(0.5, 0.4)),
    tv.Contact(friction={(0, 1): 0.5}, restitution={(0, 0): 0.9}, groups=[(0, 1)], skin=0.1),
    tv.Polygons([range(4), [4, 5, 6]], friction=(0.5, 0.4)), tv.Box((0, 0), (np.inf, 2), friction=(0.5, 0.4), restitution=0.5),
    tv.HalfSpace((0, 1), 0.5, friction=0.2), tv.Ball((0, 0), 1.0, inside=True), tv.Capsule((0, 0), (1, 0), 0.1, one_way=(0, 1)),
    tv.Polygon([(0, 0), (1, 0), (0, 1)], position=(1.0, 2.0), rotation=0.5, radius=0.01),
    tv.Mesh(np.zeros((3, 3)), [(0, 1, 2)], rotation=(0, 0, 1), position=np.zeros(3)), tv.Distance([(0, 1)]),
    tv.Distance(links, 0.5), tv.Distance(links, rest=[0.5, 0.6], compliance=[1e-3, 0.0], damping=np.zeros(2), break_at=10.0),
    tv.Rope(links, 0.5, compliance=1e-4), tv.Rope(links, length=np.ones(2)), tv.Spacer(links, 0.5, damping=1),
    tv.Bend([(0, 1, 2)], np.pi, compliance=[1e-2]), tv.AngleLimit([(0, 1, 2)], 1.0, 2.0), tv.Dihedral([(0, 1, 2, 3)], 0.0),
    tv.Pin([0]), tv.Pin([0], (0, 0), compliance=1e-3, damping=0.1), tv.Pin(np.arange(3), np.zeros((3, 2)), compliance=np.ones(3)),
    tv.Area([[0, 1, 2]], pressure=2.0, compliance=[0.1]), tv.Volume([(0, 1, 2, 3)], pressure=[1.5]),
    tv.ShapeMatch([np.arange(4), [4, 5]], compliance=[5e-5, 0.0], damping=[5.0, 0.0], creep=0.1, yield_strain=[0.1, 0.2]),
    tv.Motor([(0, 1, 2)], 3.0, torque=0.5), tv.Motor([(0, 1, 2, 3)], [1.0], angle=np.pi),
    tv.Winch(links, -0.1, longest=2.0, force=[5, 6]),
    tv.Path([0, 1], [(0, 0), (1, 0)], closed=False, speed=1.0), tv.Snap(np.arange(3), 0.1, origin=(0.0, 0.05), compliance=0.05),
]  # fmt: skip
particles = tv.Particles([(0, 1), (1, 1), (2, 1)], mass=[1, 2, np.inf], radius=0.1, velocity=(0, 1), pinned=[0])
world = tv.World(particles, features, substeps="auto", iterations=2, solver=tv.Direct(), precision="f64", path="fused", order=2)
world.position = [(0, 0), (1, 0), (2, 0)]
world.velocity = world.velocity + (0, 1)
world.substeps, world.iterations = 30, 4
report = world.step(1 / 60, tolerance=1e-3)
report = report.worse(world.run(1.0, recorder="a.rrd", progress=True))
energy: float = report.energy
settings = world.report(1.0, dt=0.01, progress=False)
new = world.add(tv.Particles([(0, 5)]), [tv.Pin([3], compliance=1e-3)])
world.remove(new)
world.remove([0, 1])
found = world.near([(0, 0)], 0.5), world.nearest([(0, 0)]), world.contacts.pairs, world.broken, world.explain().splitlines()
seen = world.events(groups=[(0, 1)]).begun.pairs, world.wall_events().ended.impulse.sum(), len(world.events().lasting)
hits = world.ray((0, 0), (1, 0)), world.ray([(0, 0), (1, 1)], (0, -1), 3.0, radius=0.1, groups=[0], skip=[0], features=features)
there = hits[0].met, hits[1].distance.min(), world.inside(tv.Box((0, 0), (1, 1))), world.inside(tv.Ball((0, 0), 1.0), "whole")
clone: tv.World = world.clone(precision="f64", substeps=100)
with tv.Recorder("b.rrd", world, every=2, budget=1_000_000, overwrite=True) as recorder:
    recorder.log()
recording = tv.replay("b.rrd", given=[max])
again = recording.world(60).position + recording.position(60)
text: str = str(recording.verify())
strain = tv.measure.strain(world, links, 0.5)
rope = tv.shapes.rope((0, 2), (1, 2), points=40)
body, (first, second) = tv.shapes.join(rope.moved((1, 0)), tv.shapes.ball((0, 0), 0.5, 4).turned(0.3))
ends = rope.links + first.start, body.loops, len(body), second.stop
place = tv.mix(np.zeros(2), (1, 1), tv.smoothstep(0.0, 1.0, tv.golden(np.arange(5), dim=2)))
hand = tv.approach(0.0, (1.0, 1.0), rate=6.0, dt=1 / 60), tv.golden_colors(3), tv.clamp(2.0, 0, 1)
swept = tv.sweep(lambda x: tv.World(tv.Particles([(x, 1)])), {"x": np.arange(9)}, lambda worlds: {"end": worlds.position}, 4)
ended, lost = swept["end"].mean(), [part.why for part in swept.repeated]
