"""Scenes like those of the demos: machines and figures, whose features no other scene has together."""

import numpy as np

import tiverlet as tv

from .scene import c, scene

G = 9.81


@scene()
def a_figure_falls_on_a_step():
    body = tv.shapes.ragdoll((0.0, 0.9), 0.8)
    joints = c.AngleLimit(body.limits, body.lower, body.upper, compliance=1e-3, damping=0.2)
    bones = c.Distance(np.concatenate([body.links, body.braces]))
    step = c.Polygon([(-2.0, -1.0), (2.0, -1.0), (2.0, -0.3), (0.1, -0.3), (0.1, 0.0), (-2.0, 0.0)], friction=0.5)
    particles = c.Particles(body.position, mass=1.0 + 20 * body.radius, radius=body.radius, velocity=(1.0, 0.0))
    return particles, [c.Gravity(G), c.Drag(0.2), bones, joints, step], {"solver": c.ConjugateGradient(10), "substeps": 40}


@scene()
def a_bead_on_a_wire_drags_a_chain_through_a_one_way_gate():
    wire = [(-0.6, 1.0), (-0.2, 0.8), (0.2, 0.8), (0.6, 1.0)]
    chain = np.array([[-0.6, 1.0], [-0.6, 0.8], [-0.6, 0.6], [-0.6, 0.4]])
    gate = c.Polygon([(0.0, 0.0), (0.0, 0.7)], closed=False, one_way=(1, 0))
    particles = c.Particles(chain, mass=0.2, radius=0.02)
    return particles, [c.Gravity(G), c.Path([0], wire), c.Distance([(0, 1), (1, 2), (2, 3)]), gate], {"precision": "f64"}


@scene()
def a_chain_of_quads_slides_off_a_rod_and_down_a_slope():
    x = np.array([[0.1 * k, 0.5 + 0.1 * (j % 2)] for k in range(6) for j in range(2)])
    links = [(2 * k + j, 2 * k + j + 2) for k in range(5) for j in range(2)] + [(2 * k, 2 * k + 1) for k in range(6)]
    braces = c.Distance([(2 * k, 2 * k + 3) for k in range(5)], compliance=1e-4, damping=0.2)
    walls = [c.Capsule((0.1, 0.2), (0.25, 0.22), 0.05, friction=0.3), c.HalfSpace((0.1, 1), 0.0, friction=(0.4, 0.3))]
    areas = c.Area([(2 * k, 2 * k + 2, 2 * k + 3, 2 * k + 1) for k in range(5)], compliance=1e-3)
    features = [c.Gravity(G), c.Distance(links), braces, areas, *walls]
    return c.Particles(x, mass=0.05, radius=0.02), features, {"precision": "f32-compensated"}


@scene()
def a_grid_takes_what_falls_on_it():
    x = np.array([[0.02, 0.55], [0.31, 0.45], [0.58, 0.62], [0.12, 0.9]])
    snap = c.Snap(np.arange(4), 0.3, origin=(0.0, 0.15), compliance=0.05, damping=0.4)
    return c.Particles(x, mass=0.1, radius=0.05), [c.Gravity(1.0), snap, c.Drag(0.5), c.Spacer([(0, 3)], 0.3)]
