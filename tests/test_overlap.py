"""What is placed into each other parts gently."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import BEYOND, SLOP

from .conftest import compiled


@pytest.mark.slow
@pytest.mark.parametrize("what", ["another radius", "contacts"])
def test_a_rebuilt_world_is_compiled_once_for_what_overlaps_in_it(what, world):
    row, link = np.stack([np.arange(5) * 0.2, np.zeros(5)], axis=1), tv.Distance([[5, 6]])
    row = np.vstack([row, [[50.0, 0.0], [51.0, 0.0]]])
    if what == "contacts":
        w = world(tv.Particles(row * 0.4, radius=0.05), [link])
        w.add(features=[tv.Contact()])
    else:
        w = world(tv.Particles(row, radius=0.05), [tv.Contact(), link])
        w.step(1e-3)
        w.add(tv.Particles([[0.03, 0.0]], radius=0.04))
    step = w._runner.step
    w.step(1e-3)
    assert w._runner.step is step  # not compiled for another structure
    w.run(1.0)
    assert w.step(1e-3).overlap < 1.1 * SLOP * BEYOND  # what places leave, to rounding


@pytest.mark.slow
@pytest.mark.parametrize("pinned", [(), (0, 1)], ids=["linked", "pinned"])
def test_what_starts_between_others_is_not_shot_out(world, pinned):
    # A disc y away from the middle between two others, d away from each: d^2 = y^2 + (L / 2)^2, so y' = d' d / y, which has no
    # limit where d grows at push_out. Places move it, and give no velocity. A link that is moved far turns, and what one tangent
    # leaves of it is pulled back.
    for y, substeps, precision in ((-0.01, 20, "f32"), (-0.01, 200, "f64"), (-0.001, 200, "f32")):
        x = np.array([[0.0, 0.0], [0.3, 0.0], [0.15, y]])
        features = [tv.Distance([(0, 1)]), tv.Contact(push_out=1.0)]
        w = world(tv.Particles(x, radius=0.1, pinned=pinned), features, substeps=substeps, precision=precision)
        fastest = max(np.linalg.norm(w.velocity, axis=1).max() for _ in range(30) if w.step(1 / 60))
        assert fastest < (1e-6 if pinned else 4.0)
        r = w.position[2] - w.position[:2]
        assert np.linalg.norm(r, axis=1).min() > 0.2 - 0.1 * SLOP * BEYOND - 1e-6  # it is out, but for what places leave


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["discs", "spheres", "boxes"])
def test_what_overlaps_in_a_row_parts_at_push_out(kind, world):
    # Ten in a row, each in the next one by a fifth. What overlaps parts by moves, without velocity, each pair at push_out: the
    # ends part at 9 push_out at most.
    push_out, row = 0.5, np.arange(10) * 0.16
    if kind == "boxes":
        x = np.concatenate([np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.2], [0.0, 0.2]]) + [0, y] for y in row])
        loops = np.arange(40).reshape(10, 4)
        sides = np.concatenate([loops[:, pair] for pair in ([0, 1], [1, 2], [2, 3], [3, 0], [0, 2])])
        features = [tv.Polygons(loops.tolist(), push_out=push_out), tv.Distance(sides)]
    else:
        x = np.stack([np.zeros(10), row] + [np.zeros(10)] * (kind == "spheres"), axis=1)
        features = [tv.Contact(push_out=push_out)]
    w = world(tv.Particles(x, radius=0.0 if kind == "boxes" else 0.1), features, precision="f64", substeps=8)
    middle, fastest = x.mean(axis=0), 0.0
    for _ in range(90):
        before, report = w.position[:, 1], w.step(1 / 60)
        fastest = max(fastest, np.ptp(60 * (w.position[:, 1] - before)))
    assert push_out / 2 < fastest < 9 * push_out
    assert report.overlap < 3 * SLOP and abs(w.position.mean(axis=0) - middle).max() < 1e-9


@pytest.mark.slow
def test_what_goes_to_another_place_compiles_nothing(world):
    # Six discs rest on each other. One is carried off, twice before it is seen. The first disc of a group that is named, but had
    # no particles, is not another structure either, nor is a disc that is put into another one. They part.
    x = np.vstack([np.stack([np.zeros(6), 0.1 + 0.201 * np.arange(6)], axis=1), [[50.0, 0.1], [51.0, 0.1]]])
    contact, link = tv.Contact(groups=[(0, 0), (0, 1)], friction={(0, 1): 0.5}), tv.Distance([[6, 7]])
    w = world(tv.Particles(x, radius=0.1), [tv.Gravity(), contact, link, tv.HalfSpace((0, 1), 0.0)], substeps=8)
    w.run(1.0)
    w.position, w.velocity = w.position, w.velocity  # the kernels of a start
    w.step(1 / 60)
    with compiled() as names:
        for place in ((1.0, 2.0), (2.0, 2.0)):
            x = w.position.copy()
            x[5] = place
            w.position = x
        with w.clone() as twin:
            w.run(0.3)
            twin.run(0.3)
            assert twin.hash() == w.hash()
        w.add(tv.Particles([[1.0, 3.0]], radius=0.1, group=1))
        w.run(0.5)
        x = w.position.copy()
        x[5] = x[8] + [0.05, 0.05]
        w.position = x
        w.run(0.5)
    assert names == [] and np.linalg.norm(w.position[5] - w.position[8]) > 0.2 - 0.1 * SLOP * BEYOND - 1e-6


def test_a_lasting_overlap_is_flagged_and_the_advice_ends_it(world):
    # Masses of 1, 1000 and 1e5 kg on each other: at 4 substeps they would rest a third of a radius in each other, without a word.
    x, radius, mass = [(0, 0.1), (0, 0.45), (0.05, 0.8)], [0.1, 0.25, 0.1], [1.0, 1e3, 1e5]
    features = [tv.Gravity(), tv.Contact(), tv.Box((-0.3, 0), (0.3, 9))]
    w = world(tv.Particles(x, radius=radius, mass=mass), features, substeps=4)
    for _ in range(6):
        w.run(1.0)
        report = w.step(1 / 60)
        if report.clean:
            break
        assert report.flags == {"compressed"} and report.overlap > 0.05
        w.substeps = int(report.notes[0].partition("Use up to ")[2].partition(" substeps")[0])
    assert w.substeps > 20 and report.overlap < 0.05


@pytest.mark.parametrize(("part", "flags"), [(0.045, set()), (0.055, {"compressed"})])
def test_the_border_of_what_counts_as_compressed_is_a_twentieth_of_a_radius(world, part, flags):
    x = [(0.0, 0.0), (0.2 - 0.1 * part, 0.0)]
    w = world(tv.Particles(x, radius=0.1), [tv.Contact(push_out=1e-3)], substeps=4)
    assert w.step(1 / 60).flags == flags
