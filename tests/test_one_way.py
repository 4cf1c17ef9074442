"""One-way walls: they hold particles that come from one side, and let through those from the other."""

import numpy as np
import pytest

import tiverlet as tv

G, R, THICK = 9.81, 0.05, 0.1
BOARD = np.array([[-2, -THICK], [2, -THICK], [2, THICK], [-2, THICK]])
WALLS = {  # platforms along y = 0, and the height of their tops
    "Capsule": (lambda **k: tv.Capsule((-2, 0), (2, 0), THICK, **k), THICK),
    "Polygon": (lambda **k: tv.Polygon(BOARD, **k), THICK),
    "line": (lambda **k: tv.Polygon([[-2, 0], [0, 0], [2, 0]], closed=False, **k), 0.0),
}
# Six particles by start height and speed: one falls onto the wall; one rises through it and lands; one rises into it and falls
# back; one starts inside of it; the last two are fast, downwards and upwards.
START = np.array([1.0, -0.8, -0.8, 0.02, 3.0, -3.0])
SPEED = np.array([0.0, 5.0, np.sqrt(2 * G * 0.8), 0.0, -80.0, 80.0])
STAYS = np.array([True, True, False, False, True, False])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "precision"), [("Capsule", "f32"), ("Polygon", "f64"), ("line", "f64")])
def test_what_comes_from_below_passes_and_what_comes_from_above_lands(world, name, precision):
    # Particles that pass move as without the wall: y0 + v t - g t^2 / 2, to rounding, for any number of substeps.
    make, top = WALLS[name]
    x = np.stack([np.linspace(-1.5, 1.5, len(START)), START], axis=1)
    start = tv.Particles(x, velocity=np.stack([0 * SPEED, SPEED], axis=1), radius=R)
    w = world(start, [tv.Gravity(G), make(one_way=(0, 3), friction=0.5)], precision=precision)
    for substeps in (1, 20):
        w.velocity, w.position, w.substeps, t = start.velocity, start.position, substeps, 0.0
        for frame in range(120):
            w.step(1 / 60)
            t += 1 / 60
            free = START + SPEED * t - G * t**2 / 2
            going = ~STAYS | (np.arange(6) == 1) & (SPEED - G * t > 0)
            np.testing.assert_allclose(w.position[going, 1], free[going], atol=1e-9 if precision == "f64" else 2e-4)
            if frame > 60:
                np.testing.assert_allclose(w.position[STAYS, 1], top + R, atol=1e-12 if precision == "f64" else 2e-6)
        assert (w.position[[2, 3], 1] < -10).all()


def test_a_platform_that_moves_and_turns(world):
    # A platform carries the particle on it up and down, and passes a pinned one from below; its direction turns with it.
    lift = tv.Polygon(BOARD, position=(0.0, 0.0), one_way=(0, 1), friction=0.8)
    x = np.array([[0.0, THICK + R], [1.0, 1.0], [-1.0, -0.4]])
    w = world(tv.Particles(x, radius=R, pinned=[2]), [tv.Gravity(G), lift], precision="f64")
    for speed in (0.5, -0.5, 0.0):
        for _ in range(60):
            lift.position = lift.position + [0, speed / 60]
            w.step(1 / 60)
        assert w.position[0] == pytest.approx([0.0, lift.position[1] + THICK + R], abs=1e-9)
        assert w.position[1] == pytest.approx([1.0, lift.position[1] + THICK + R], abs=1e-9)
    lift.rotation = np.pi  # upside down the platform holds nothing
    w.run(1.0)
    assert (w.position[:2, 1] < -3).all() and not w.step(1 / 60).flags


@pytest.mark.slow
def test_a_sheet_in_space(world):
    corners = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], dtype=float)
    sheet = tv.Mesh(corners, [(0, 2, 1), (0, 3, 2)], closed=False, one_way=(0, 1, 0))
    rope = tv.shapes.rope((-0.4, 0.3, 0.0), (0.4, 0.3, 0.1), points=6)
    x = np.concatenate([rope.position, rope.position - [0, 0.6, 0.3]])
    v = np.repeat([[0.0, 0, 0], [0, 4.0, 0]], 6, axis=0)
    w = world(
        tv.Particles(x, velocity=v, radius=0.02),
        [tv.Gravity(G), tv.Distance(np.concatenate([rope.links, rope.links + 6])), sheet],
    )
    w.run(0.3)
    assert (w.position[6:, 1] > 0.1).all()  # the rope that was thrown is through
    w.run(2.0)
    assert w.position[:, 1] == pytest.approx(0.02, abs=1e-5)  # both ropes lie on the sheet


def test_bad_directions_are_refused():
    for wrong, message in (
        (lambda: tv.Capsule((0, 0), (1, 0), 0.1, one_way=(0, 0)), "one_way = 0 has no direction"),
        (lambda: tv.Polygon(BOARD, one_way=(0, 1, 0)), r"one_way has shape \(3,\), but 2 numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()


@pytest.mark.slow
def test_a_heap_stays_on_a_platform_of_many_edges(world):
    # Discs that are pressed into the platform, and pushed over its vertices, are no discs on their way through.
    line, k = np.linspace(-2, 2, 21), np.arange(80)
    platform = tv.Polygon(np.stack([line, 0 * line], axis=1), closed=False, radius=0.01, one_way=(0, 1))
    x = np.stack([-1.4 + k % 14 * 0.2, 0.3 + k // 14 * 0.22], axis=1) + np.random.default_rng(0).uniform(0, 0.01, (80, 2))
    walls = [tv.HalfSpace((1, 0), -1.5), tv.HalfSpace((-1, 0), -1.5)]
    start = tv.Particles(x, radius=0.05 + 0.045 * tv.golden(k))
    w = world(start, [tv.Gravity(9.81), platform, *walls, tv.Contact()], substeps=2)
    w.run(2.0)
    assert (w.position[:, 1] > 0.98 * start.radius + 0.01).all()
