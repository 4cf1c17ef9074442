"""Constraints of every kind, from soft to rigid, at rest, in swing, driven and broken."""

import numpy as np

import tiverlet as tv

from .scene import c, scene

G = 9.81
CUBE = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
                 [1, 5, 7], [1, 7, 3]])  # fmt: skip
CORNERS = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)


def chain(n: int, k: int, first: int = 0) -> np.ndarray:
    """Return every k consecutive particles of a chain of n."""
    return first + np.arange(n - k + 1)[:, None] + np.arange(k)


@scene(flags={"unconverged", "energy-loss", "softened"})
def clamped_beams_from_rigid_to_soft_sag():
    alphas, n = (0.0, 1e-12, 1e-6, 1e-3, 1e-1, 1.0, 1e12), 8
    x = np.zeros((len(alphas), n, 3))
    x[:, :, 0], x[:, :, 2] = 0.05 * np.arange(n), np.arange(len(alphas))[:, None]
    v = np.zeros_like(x)
    v[:, 2:, 1:] = 0.3 * np.sin(7.0 * np.arange(2 * n - 4)).reshape(n - 2, 2)
    bends = np.concatenate([chain(n, 3, n * k) for k in range(len(alphas))])
    links = np.concatenate([chain(n, 2, n * k) for k in range(len(alphas))])
    held = [n * k + i for k in range(len(alphas)) for i in (0, 1)]
    start = c.Particles(x.reshape(-1, 3), velocity=v.reshape(-1, 3), mass=0.1, pinned=held)
    features = [c.Gravity(G), c.Distance(links), c.Bend(bends, 0.0, compliance=np.repeat(alphas, n - 2))]
    return start, features, {"solver": c.Jacobi(), "substeps": 4, "precision": "f64"}


@scene()
def a_chain_that_is_straight_but_for_rounding_flies():
    # Points on a line along (1, 2, 3) are off it by 1e-16 m: the plane of a path that is almost straight turns far in a substep.
    rope = tv.shapes.rope((0, 0, 0), np.array([1.0, 2.0, 3.0]) / np.sqrt(14) * 9, points=10)
    v = np.random.default_rng(0).normal(size=(10, 3))
    features = [c.Distance(rope.links), c.Bend(rope.bends, compliance=0.2)]
    return c.Particles(rope.position, velocity=v), features, {"solver": c.Jacobi(), "precision": "f64"}


@scene(smooth=True)
def a_racket_of_more_links_than_hold_it_tumbles():
    x = np.repeat(np.diag([1.0, 0.8, 0.5]), 2, axis=0) * np.array([1, -1] * 3)[:, None]
    links = np.stack(np.triu_indices(6, 1), axis=1)
    start = c.Particles(x, velocity=np.cross([0.02, 3.0, 0.01], x))
    return start, [c.Distance(links)], {"solver": c.Jacobi(), "precision": "f64"}


@scene()
def a_rope_falls_apart_into_beads_on_a_floor():
    # The directions of broken links turn, which is no turn.
    x = [[0.1 * k, 1.0] for k in range(12)]
    start = c.Particles(x, radius=0.03, velocity=np.random.default_rng(0).normal(0, 0.3, (12, 2)))
    features = [c.Gravity((3.0, -G)), c.Distance(chain(12, 2), break_at=1e-3), c.Box((-0.2, 0), (1.4, 2), friction=0.1)]
    return start, features, {"solver": c.Direct()}


@scene()
def a_door_lifts_a_weight_and_winches_pull():
    x = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0.5], [-1, 0, 0.5], [0, -1, 0.5]], dtype=float)
    features = [
        c.Motor([[0, 1, 2, 3]], 5.0, torque=1.0),
        c.Winch([[4, 2], [3, 4], [1, 3]], [-0.5, 0.2, 0.1], force=[5.0, np.inf, 7.0]),
        c.Distance([[0, 2], [1, 2], [0, 3], [1, 3]]),
        c.Gravity((0, -G, 0)),
    ]
    return c.Particles(x, mass=1.0 + np.arange(5) % 2, pinned=[0, 1]), features


@scene()
def motors_turn_what_is_free():
    # Gradients sum to 0, and so do their moments: a motor gives no momentum.
    x = np.array([[-1, 0.1], [0, 0], [0.7, 0.4], [9, 0], [10, 0], [11.0, 0.5]])
    v = np.random.default_rng(0).normal(size=x.shape)
    motor = c.Motor([[0, 1, 2], [3, 4, 5]], [4.0, -2.0], torque=[0.3, np.inf])
    links = c.Distance([[0, 1], [1, 2], [3, 4], [4, 5]])
    return c.Particles(x, velocity=v, mass=1.0 + np.arange(6) % 3), [motor, links], {"precision": "f64"}


@scene()
def cubes_of_springs_flow_and_hold_their_volume():
    q = CORNERS * 0.5
    x = np.concatenate([q, q * [1.3, 1, 1] + [2, 0, 0], 0.1 * np.sin(9.0 * np.arange(36)).reshape(12, 3) + [4, 0, 0]])
    edges = [(i, j) for i in range(8) for j in range(i) if np.abs(CORNERS[i] - CORNERS[j]).sum() == 1]
    features = [
        c.Volume(np.concatenate([CUBE, CUBE + 8]), compliance=[1e-3, 0.0], pressure=[1.1, 1.0]),
        c.Distance(edges, compliance=1e-3, damping=0.1),
        c.ShapeMatch(
            [np.arange(8, 16), np.arange(16, 28)], compliance=[1e-3, 1e-2], damping=0.1, creep=[1.0, 0.0], yield_strain=0.05
        ),
        c.Pin([0], compliance=1e-3),
    ]
    return c.Particles(x, mass=0.2), [c.Gravity(G), *features]


@scene(smooth=True)
def beads_slide_on_wires_in_space():
    t = np.linspace(0, 4 * np.pi, 100)
    helix = np.stack([np.cos(t), -0.25 * t, np.sin(t)], axis=1)
    ring = np.stack([3 + np.sin(t[:50]), np.cos(t[:50]), 0 * t[:50]], axis=1)[::2]
    features = [
        c.Gravity(G),
        c.Path([0], helix),
        c.Path([1], ring[:-1], closed=True),
        c.Path([2], [[5, 0, 0], [9, 0, 0.5]], compliance=1e-2),
        c.Snap([3], 1.0, compliance=1e-2),
        c.Distance([[0, 4]]),
    ]
    x = np.array([helix[30], ring[3], [6, 0.0, 0.125], [0.1, 0.2, 9.3], helix[30] - [0, 0.4, 0]])
    return c.Particles(x, mass=[1.0, 1.0, 2.0, 1.0, 0.5]), features, {"precision": "f64", "iterations": 4}


@scene(flags={"softened"})  # in one frame, after a blow of a stop
def limbs_doors_and_struts_swing_against_their_stops():
    x = np.array(
        [[0, 0, 0], [0.5, 0, 0], [1, 0.1, 0], [3, 0, 0], [4, 0, 0], [3.5, 0, 0.8], [3.5, 0.3, -0.8], [6, 0, 0], [6.3, 0, 0]]
    )
    features = [
        c.Gravity(G),
        c.Distance([[0, 1], [1, 2], [3, 5], [4, 5], [3, 6], [4, 6]]),
        c.AngleLimit([[0, 1, 2]], 0.0, 0.6, compliance=1e-4),
        c.Dihedral([[3, 4, 5, 6]], compliance=1e-2, damping=0.1),
        c.Spacer([[2, 7]], 4.5),
        c.Rope([[7, 8], [2, 8]], [0.4, 5.5]),
    ]
    return c.Particles(x, mass=0.5, pinned=[0, 3, 4, 7]), features
