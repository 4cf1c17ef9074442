"""Reports and their flags: the flag that names the fault where the motion is not right. For where it is see test_scenes.py."""

import dataclasses
import pickle
import re

import numpy as np
import pytest

import tiverlet as tv

G = 9.81


def hanging(links, weight, mass=0.05):
    """Return a chain of 2 m of light links, straight out from its pin, with a weight [kg] at its end."""
    x, k = np.linspace((0, 0), (2, 0), links + 1), np.arange(links)
    return tv.Particles(x, mass=np.append(np.full(links, mass), weight), pinned=[0]), [
        tv.Gravity(G), tv.Distance(np.stack([k, k + 1], axis=1))
    ]  # fmt: skip


def linkage():
    """Return a crank that a motor turns at 40 rad/s, and that moves a rocker."""
    x = [(0, 0), (0.3, 0), (1.0, 0.6), (1.2, 0)]
    return tv.Particles(x, pinned=[0, 3]), [tv.Motor([(3, 0, 1)], 40.0), tv.Distance([(0, 1), (1, 2), (2, 3)])]


def linked(x, rest, **particles):
    """Return particles, each linked with the one before, without gravity."""
    k = np.arange(len(x) - 1)
    return tv.Particles(x, **particles), [tv.Gravity(0.0), tv.Distance(np.stack([k, k + 1], axis=1), rest)]


def unresolved():
    """Return a weight on a spring of 2e-4 s."""
    return tv.Particles([(0, 0), (0, -1.2)], pinned=[0]), [tv.Gravity(G), tv.Distance([(0, 1)], 1.0, compliance=1e-9)]


def heap(x, radius, high=99.0, **particles):
    """Return discs of unequal radii between a floor and a ceiling."""
    walls = [tv.HalfSpace((0, 1), friction=0.5), tv.HalfSpace((0, -1), -high, friction=0.5)]
    return tv.Particles(x, radius=radius, **particles), [tv.Gravity(G), tv.Contact(friction=0.5), *walls]


WRONG = {  # scene, substeps, solver, the flag
    "a linkage": (linkage, 8, tv.Jacobi(), "unconverged"),
    "relaxed links under a weight": (lambda: hanging(100, 100.0), 20, tv.Jacobi(), "unconverged"),
    "links that contradict each other": (
        lambda: linked([(0, 0), (0.5, 0.1), (1, 0)], 0.3, pinned=[0, 2]), 20, None, "unconverged"
    ),
    "a pendulum that turns by more than a right angle in a substep": (
        lambda: linked([(0, 0), (1, 0)], 1.0, velocity=[(0, 0), (0, 2500.0)], pinned=[0]), 20, None, "turned"
    ),
    "a spring": (unresolved, 20, None, "energy-loss"),
    "a disc that flies by 330 of its diameters in a substep": (
        lambda: heap([(0, 9), (2, 9)], [0.01, 0.011], velocity=[(400, 0), (0, 0)], mass=[1, 2]), 20, None, "tunnelling-risk"
    ),
    "a disc between walls that are too close": (
        lambda: heap([(0, 0.075), (5, 0.075)], [0.1, 0.05], 0.15, mass=[1, 2]), 20, None, "compressed"
    ),
    "discs of 1, 1000 and 1e5 kg on each other": (
        lambda: heap([(0, 0.1), (0, 0.3), (0, 0.51)], [0.1, 0.1, 0.11], mass=[1, 1000, 1e5]), 1, None, "compressed"
    ),
}  # fmt: skip
# With as many substeps as their worst frame is said to need, these have no flag.
MENDED = "a linkage", "a spring", "discs of 1, 1000 and 1e5 kg on each other"


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_a_scene_that_does_not_move_as_it_should_has_the_flag_that_says_why(world, name):
    make, substeps, solver, flag = WRONG[name]
    w = world(*make(), substeps=substeps, solver=solver)
    assert flag in set().union(*(w.step(1 / 60).flags for _ in range(60)))
    if name in MENDED:
        (note,) = world(*make(), substeps=substeps, solver=solver).run(1.0).notes
        need = re.search(r"(\d+) substeps", note)
        assert need and int(need[1]) > substeps
        assert world(*make(), substeps=int(need[1]), solver=solver).run(1.0).clean


@pytest.mark.slow
def test_what_is_damped_loses_its_note_with_as_many_substeps_as_that_says(world):
    # A chain that swings down. A few steps of conjugate gradients leave it violated, by order h or higher.
    def run(substeps):
        return world(*hanging(29, 0.01, 0.01), substeps=substeps, solver=tv.ConjugateGradient(4), precision="f64").run(1.0)

    report = run(10)
    assert report.clean and not run(int(re.search(r"they are damped.* (\d+) substeps", report.notes[0])[1])).notes


def test_a_link_that_is_off_by_a_twentieth_is_flagged(world):
    # UNCONVERGED is a twentieth: 4 % are right, 6 % are wrong. The links between pins have 2 (1 + e) in a place of 2.
    for off, flagged in ((0.04, False), (0.06, True)):
        report = world(*linked([(0, 0), (1, 0), (2, 0)], 1.0 - off, pinned=[0, 2])).step(1 / 60)
        assert report.residual == pytest.approx(off / (1 - off), rel=0.01)
        assert ("unconverged" in report.flags) == flagged


def test_a_run_has_one_note_of_each_kind(world):
    # A chain that falls from level: frame after frame it is off by another share, and told to use another number of substeps.
    w = world(*hanging(20, 10.0), substeps=6, solver=tv.Jacobi())
    each = {note for _ in range(60) for note in w.step(1 / 60).notes}
    report = w.run(0.5)
    assert len(each) > 5 and len(report.notes) == len({note[:12] for note in report.notes}) > 0
    assert str(report) == "\n    ".join([repr(report), *report.notes])


def test_a_report_is_stored_compared_and_shown(world):
    w = world(tv.Particles([[0.0, 1.0]]), [tv.Gravity(9.81)], substeps=3)
    report = w.step(0.1)
    made = tv.StepReport(**vars(report))
    assert list(vars(report)) == list(vars(made)) == [field.name for field in dataclasses.fields(made)]
    kinds = [float, int, int, float, float, int, float, float, frozenset, tuple, type(None), int, int, int, float, int, float]
    assert list(map(type, vars(report).values())) == kinds
    assert report == made == pickle.loads(pickle.dumps(report)) and hash(report) == hash(made)
    assert repr(report) == repr(made) and w.last is report
    assert report != dataclasses.replace(report, tries=2) and report == dataclasses.replace(report, seconds=9.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.energy = 0.0  # type: ignore[misc]
