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
