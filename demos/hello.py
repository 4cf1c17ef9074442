"""A rope that hangs from one end and swings: the ten lines of the README.

    python demos/hello.py

What to look for: the report of the worst frame, and what the scene is made of. Watch the recording with `rerun rope.rrd`.
"""

import tiverlet as tv

rope = tv.shapes.rope((0, 2), (1, 2), points=40)
world = tv.World(
    tv.Particles(rope.position, mass=0.01, radius=0.01, pinned=[0]),
    [tv.Gravity(9.81), tv.Distance(rope.links), tv.Box((-2, 0), (2, 3)), tv.Contact()],
    substeps="auto",
)
with tv.Recorder("rope.rrd", world, overwrite=True) as recorder:
    report = world.run(5.0, recorder=recorder)
print(report)
print(world.explain())
