"""A report: stored, pickled, compared and shown."""

import dataclasses
import pickle

import pytest

import tiverlet as tv


def test_a_world_makes_what_the_constructor_makes(world):
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


def test_a_run_has_one_note_of_each_kind(world):
    # A cloth that falls from level: frame after frame it is off by another share, and told to use another number of substeps.
    s = tv.shapes.cloth((0, 2, 0), (2, 0, 0), (0, 0, 2), (12, 12))
    features = [tv.Gravity((0, -9.81, 0)), tv.Distance(s.links)]
    w = world(tv.Particles(s.position, pinned=[0, 11]), features, substeps=6)
    each = {note for _ in range(60) for note in w.step(1 / 60).notes}
    report = w.run(0.5)
    assert len(each) > 5 and len(report.notes) == len({note[:12] for note in report.notes}) > 0
    assert str(report) == "\n    ".join([repr(report), *report.notes])
