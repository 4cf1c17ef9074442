"""Grains that spin, against the laws of heaps and silos: what the report prints, small."""

import numpy as np
import pytest

from tiverlet.report.accuracy import grains, rolling
from tiverlet.report.accuracy.grains import SIZE, Silo

from .conftest import order


def test_impacts_and_rolling_obey_their_laws():
    # Velocities after impacts to rounding; the way of a sphere that rolls off another to second order.
    for case in (rolling.collision(1.0, beta=0.5), rolling.super_ball()):
        for velocity, _place in rolling.here(case, "f64", (5, 20)):
            assert velocity <= 1e-12
    places = [place for _velocity, place in rolling.here(rolling.from_another(), "f64", (5, 10, 20))]
    assert 1.9 <= order(places) <= 2.1


def test_other_engines_are_asked():
    # pymunk solves for the friction that keeps a sphere rolling to rounding; its places are of first order.
    given = [rolling.downhill(0.3, 0.3), rolling.super_ball()]
    assert rolling.there("pymunk", ["no-such-python"], given, (5,))[0][0].startswith("FileNotFoundError")
    assert rolling.there("pymunk", [], given, (5, 10)) == [["not installed"] * 2] * 2
    pytest.importorskip("pymunk")
    import sys  # noqa: PLC0415

    rolls, bounces = rolling.there("pymunk", [sys.executable], given, (5, 10))
    assert bounces == ["no tangential restitution"] * 2
    assert max(velocity for velocity, _place in rolls) <= 1e-12
    assert rolls[0][1] / rolls[1][1] == pytest.approx(2, rel=0.05)


def test_heaps_of_what_resists_rolling_are_steeper():
    # Discs that roll freely lie at 10 to 20 degrees whatever their friction; resistance to rolling, or no spin, holds them up.
    free, held = grains.repose(200, 12.0, 2, [0], [(0.5, 0.0), (0.5, 0.3)])[:, 0]
    skaters = grains.repose(200, 12.0, 2, [0], [(0.5, 0.0)], spins=False)[0, 0]
    assert 5 < free < 22 and held > free + 6 and skaters > free + 6


def test_a_silo_bears_its_grains():
    # Janssen 1895: without friction at the walls the floor bears the weight, to the vibration of the load; with it the load comes
    # to a limit, so twice as many grains do not press twice as much: for lambda = w / (2 mu K) with K between 1/2 and 3/2 it grows
    # by less than (1 - exp(-2 H / lambda)) / (1 - exp(-H / lambda)) = 1 + exp(-H / lambda) <= 1.3 at H = 2.5 w.
    width = 6 * SIZE
    _height, weight, load = grains.janssen(Silo(60, width, wall_friction=0.0), substeps=16)
    assert load == pytest.approx(weight, rel=2e-3)
    found = [grains.janssen(Silo(n, width), settle=1.0) for n in (90, 180)]
    loads, heights = [load for _h, _w, load in found], [h / width for h, _w, _l in found]
    assert heights[0] >= 2.4 and loads[1] <= 1.3 * loads[0]
    assert loads[1] / found[1][1] < 0.4


def test_flow_out_of_a_silo_obeys_beverloo():
    # W = C rho sqrt(g) (D - k d)^1.5 with k between 1 and 2 in 2D, so W(8.5) / W(5.5) is between 2.15 and 2.53; 20 % for so few.
    rates = []
    for opening in (5.0, 8.0):
        found = grains.flow(Silo(500, 20 * SIZE, rolling=0.0, floor_friction=0.5), opening, 4.0, settle=1.0)
        assert found["opening"] == pytest.approx(opening + 0.5)
        rates.append(found["rate"])
    assert 2.15 / 1.2 <= rates[1] / rates[0] <= 2.53 * 1.2


def test_fits_find_what_they_are_given():
    # The laws themselves, with lambda, C and k of our own.
    heights = np.array([0.5, 1.0, 3.0, 6.0])
    length, off = grains.saturation(heights, 0.8 / heights * (1 - np.exp(-heights / 0.8)))
    assert length == pytest.approx(0.8, rel=2e-3) and off <= 1e-3
    openings = np.array([5.0, 8.0, 12.0])
    assert grains.beverloo(openings, 0.9 * (openings - 1.4) ** 1.5) == pytest.approx((0.9, 1.4, 1.0))
