"""What stands, stays: bodies that lie on each other neither drift nor sink nor sway, and overlap gives no momentum."""

import numpy as np
import pytest

import tiverlet as tv

SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    """Turn points about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]])


def tower(levels: int) -> list[np.ndarray]:
    """Boxes of 1 m on each other."""
    return [SQUARE + (0, 0.5 + k) for k in range(levels)]


def pyramid(rows: int) -> list[np.ndarray]:
    """Boxes of 1 m in rows, each a box shorter than the one below."""
    return [SQUARE + (1.05 * (k - (rows - r) / 2), 0.5 + r) for r in range(rows) for k in range(rows - r)]


def arch(stones: int) -> list[np.ndarray]:
    """Half a ring of stones between the radii 2 and 2.6 m."""
    at = np.linspace(np.pi, 0, stones + 1)
    inner, outer = (r * np.stack([np.cos(at), np.sin(at)], axis=1) for r in (2.0, 2.6))
    return [np.array([inner[k], inner[k + 1], outer[k + 1], outer[k]]) for k in range(stones)]


def cards() -> list[np.ndarray]:
    """A house of cards: two tents with a card across, and a tent on it. Cards are 1 m long and 4 cm thick, at 75 degrees."""
    length, thick, angle = 1.0, 0.04, np.radians(75)
    flat = SQUARE * (length, thick)

    def tent(x: float, y: float) -> list[np.ndarray]:
        out = []
        for turn, side in ((angle, np.max), (np.pi - angle, np.min)):
            card = turned(flat, turn)
            out.append(card - (side(card[:, 0]), card[:, 1].min()) + (x, y))
        return out

    width, height = length * np.cos(angle) + thick * np.sin(angle), np.max(tent(0, 0)[0][:, 1])
    roof = SQUARE * (2 * width + 0.6, thick) + (width, height + thick / 2)
    return [*tent(0, 0), *tent(2 * width, 0), roof, *tent(width, height + thick)]


def world(bodies: list[np.ndarray], mass=None, links: bool = False, gravity: float = 9.81, **options) -> tv.World:
    """A world of polygons on a floor, of 1 kg each or of the masses given [kg]."""
    ends = np.cumsum([0, *map(len, bodies)])
    loops = [list(range(a, b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    each = np.repeat(np.ones(len(bodies)) if mass is None else mass, np.diff(ends)) / np.repeat(np.diff(ends), np.diff(ends))
    holds = tv.Distance([(i, j) for k in loops for i in k for j in k if i < j]) if links else tv.ShapeMatch(loops)
    features = [tv.Polygons(loops, friction=0.8), holds, tv.Gravity((0, -gravity)), tv.HalfSpace((0, 1), 0, friction=0.8)]
    return tv.World(tv.Particles(np.concatenate(bodies), radius=0.0, mass=each), features, **options)


HEAVY_TOP = [*np.ones(54), 100.0]
STRUCTURES = {
    "tower of 8": (tower(8), None, False),
    "tower of 20": (tower(20), None, False),
    "tower of 20, on links": (tower(20), None, True),
    "pyramid under 100 kg": (pyramid(10), HEAVY_TOP, False),
    "arch": (arch(9), None, False),
    "house of cards": (cards(), None, False),
}


@pytest.mark.parametrize("substeps", [4, pytest.param(8, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", STRUCTURES)
def test_what_stands_stays(name, substeps):
    """Statics: no body moves. Within a few digits of the coordinates, 20 m * 2^-24 = 1e-6 m, and for links ten times as far."""
    bodies, mass, links = STRUCTURES[name]
    w = world(bodies, mass, links, substeps=substeps)
    for _ in range(180):
        w.step(1 / 60)
    start = w.position.copy()
    for _ in range(900):
        w.step(1 / 60)
        assert not w.last.flags
    assert np.abs(w.position - start).max() < (4e-5 if links else 4e-6)
    assert np.abs(start - np.concatenate(bodies)).max() < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [4, 8])
def test_towers_far_out_stand_for_a_minute(substeps):
    """Towers of 20 boxes, up to 60 m from the origin in f32: the top may move by 1e-3 of a box for each box below it."""
    bodies = [box + (15 * k, 0) for k in range(5) for box in tower(20)]
    w = world(bodies, substeps=substeps)
    for _ in range(3600):
        w.step(1 / 60)
    assert np.abs(w.position[:, 0] - np.concatenate(bodies)[:, 0]).max() < 20e-3


@pytest.mark.parametrize("depth", [1e-5, 1e-4, 1e-3])
def test_overlap_of_corners_gives_no_momentum(depth):
    """Overlap is no reason for an impulse, wherever corners meet: boxes in each other lie still under their weight.

    Where one box begins beside the other one, and leans over it, their corners cross. Overlap is below 3 slops, which places
    leave. In a substep passes leave 5e-4 of g h for each row.
    """
    leans = [(0, 0), (1.5, 0), (0, 1.5), (-1.5, 0), (0, -1.5), (4, 4), (-4, -4)]
    places = [(sign * shift, *lean) for shift in (0, 1e-14, 1e-13) for sign in (1, -1) for lean in leans]
    bodies = []
    for k, (shift, below, above) in enumerate(places):
        lower, upper = turned(SQUARE + (0.5, -0.5), below * shift / depth), turned(SQUARE + 0.5, above * shift / depth)
        bodies += [lower + (1.5 * k - 0.5, 1), upper + (1.5 * k - 0.5 + shift, 1 - depth)]
    w = world(bodies, substeps=8, precision="f64")
    start = w.position.copy()
    for _ in range(10):
        w.step(1 / 60)
        assert np.abs(w.velocity).max() < 0.02 * 9.81 / 480
    assert np.abs(w.position - start).max() < 1e-6


@pytest.mark.parametrize("substeps", [20, 200])
@pytest.mark.parametrize("what", ["point", "box", "box among contacts"])
def test_friction_holds_far_from_the_origin(what, substeps):
    """Statics: tan of the slope 0.3 < friction 0.6. In f32 at 50 m a digit is 4e-6 m, 60 times g h^2 at 200 substeps."""
    along = np.array([1.0, 0.3]) / np.hypot(1.0, 0.3)
    normal, foot = np.array([-along[1], along[0]]), np.array([50.0, 0.0])
    shape = np.zeros((1, 2)) if what == "point" else (SQUARE + (0, 0.5)) @ np.array([along, normal])
    features = [tv.Gravity((0, -9.81)), tv.HalfSpace(normal, float(normal @ foot), friction=0.6)]
    if what != "point":
        features += [tv.ShapeMatch([[0, 1, 2, 3]])]
    if what == "box among contacts":
        features += [tv.Polygons([[0, 1, 2, 3]], friction=0.6)]
    w = tv.World(tv.Particles(shape + foot, radius=0.0, mass=0.25), features, substeps=substeps)
    for _ in range(60):
        w.step(1 / 60)
    start = w.position.copy()
    for _ in range(300):
        w.step(1 / 60)
    assert np.abs(w.position - start).max() < 1e-8


def test_scenes_take_as_many_substeps_as_they_need():
    # 4 where particles and rigid bodies fall freely between contacts. That is exact but for turns, by phi with sin phi = omega h:
    # (omega h)^2 / 6 of an angle is too much. Links, and clusters that share particles or give way, take 20.
    squares, loops = np.concatenate([SQUARE, SQUARE + (2, 0)]), [[0, 1, 2, 3], [4, 5, 6, 7]]
    discs = tv.Particles(squares, radius=0.1)
    for few, *features in (
        (True,), (True, tv.ShapeMatch(loops)), (True, tv.ShapeMatch(loops[:1]), tv.ShapeMatch(loops[1:])),
        (False, tv.ShapeMatch(loops), tv.ShapeMatch([[0, 4]])), (False, tv.ShapeMatch(loops, compliance=1e-4)),
        (False, tv.ShapeMatch(loops), tv.Distance([(0, 4)])), (False, tv.ShapeMatch(loops), tv.Attractor((0, 0), 1.0)),
    ):  # fmt: skip
        with tv.World(discs, [tv.Gravity(), tv.Contact(), *features]) as w:
            assert w.substeps == (4 if few else 20), features
    omega, v, t = 5.0, np.array([1.0, 4.0]), 1.0
    speed = v + omega * np.stack([-SQUARE[:, 1], SQUARE[:, 0]], axis=1)
    start = tv.Particles(squares, velocity=np.concatenate([speed, speed]))
    with tv.World(start, [tv.Gravity(9.81), tv.Polygons(loops), tv.ShapeMatch(loops)], precision="f64") as w:
        w.run(t)
        end = turned(SQUARE, omega * t) + v * t - (0, 9.81 * t**2 / 2)
        off = w.position - np.concatenate([end, end + (2, 0)])
        turn = omega * t * (omega / 60 / w.substeps) ** 2 / 6
        assert np.hypot(*off.T).max() == pytest.approx(0.5**0.5 * turn, rel=0.01)
