"""Every scene of the matrix in every condition that applies to it; and every option in a scene that shows what it does."""

import inspect
from collections.abc import Iterator

import pytest

import tiverlet as tv
from tiverlet.features.feature import Feature

from ..fuzz.trials import Find
from .conditions import CONDITIONS, Bench, applicable
from .crowd import Crowd
from .faults import KNOWN
from .scenes import SCENES

# Options that change no motion: skins are for speed, loads has no effect any more.
UNSEEN = {("Contact", "skin"), ("Contact", "loads"), ("Polygons", "skin"), ("Polygons", "loads")}
TOGETHER = ("links", "ropes", "spacers", "angle limits", "motors", "winches")  # in one world, which compiles once
CELLS = [(name, condition) for name, scene in SCENES.items() for condition in applicable(scene)]


def marked(name: str, condition: str, *args: str):
    """Return the parameters of a cell of the matrix; a known fault has to fail, so that it is struck out once it is mended."""
    cell = (name, condition)
    marks = [pytest.mark.xfail(strict=True, raises=Find, reason=KNOWN[cell])] if cell in KNOWN else []
    return pytest.param(*args, marks=marks, id=f"{name}: {condition}")


@pytest.fixture(scope="module")
def benches(taichi) -> Iterator[dict[str, Bench]]:
    """Return benches by scene: the one in use."""
    kept: dict[str, Bench] = {}
    yield kept
    for bench in kept.values():
        bench.close()


@pytest.mark.slow
@pytest.mark.parametrize("name, condition", [marked(*cell, *cell) for cell in CELLS])
def test_a_scene_keeps_its_equality(benches, name, condition):
    if name not in benches:
        for bench in benches.values():
            bench.close()
        benches.clear()
        benches[name] = Bench(SCENES[name])
    CONDITIONS[condition](benches[name])


@pytest.fixture(scope="module")
def crowd(taichi) -> Crowd:
    return Crowd({name: SCENES[name] for name in TOGETHER})


@pytest.mark.parametrize("name", [marked(name, "together", name) for name in TOGETHER])
def test_promises_are_kept_beside_a_contact_that_touches_nothing(crowd, name):
    # The quick part: what holds between particles, all in one world.
    for promise in SCENES[name].promises:
        promise.check(crowd.of(name, SCENES[name].frames))


def options() -> set[tuple[str, str]]:
    """Return all options of all features."""
    kinds = [getattr(tv, name) for name in tv.__all__]
    features = [kind for kind in kinds if inspect.isclass(kind) and issubclass(kind, Feature)]
    return {(kind.__name__, name) for kind in features for name in inspect.signature(kind).parameters}


def test_every_option_of_every_feature_is_shown_by_a_scene():
    # Given in a scene with another value than by default, and named by a promise.
    given = set()
    for scene in SCENES.values():
        for call in scene.structure.features:
            made = inspect.signature(getattr(tv, call.name)).parameters
            given |= {
                (call.name, k) for k, v in call.args.items() if made[k].default is made[k].empty or v is not made[k].default
            }
    shown = {option for scene in SCENES.values() for promise in scene.promises for option in promise.options}
    assert options() - given == set()
    assert options() - shown == UNSEEN
    assert shown <= given


def test_known_faults_are_cells_of_the_matrix():
    assert {*KNOWN} <= {*CELLS, *((name, "together") for name in TOGETHER)}
