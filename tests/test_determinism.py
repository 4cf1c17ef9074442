"""The same bits on any number of threads and on all paths; and features that are absent cost nothing."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.step import step

from .launches import launches


@pytest.mark.slow
def test_launches_are_counted_and_the_host_asks_once_in_a_frame(world):
    # Launched phase by phase, the host does not wait for launches. It reads the result of the frame. Where the neighbour list is
    # stale, it also reads whether the new list fits, and the result of the frame that continues from there.
    x = 1.8 * (tv.golden(np.arange(200), dim=2) - 0.5)
    features = [tv.Contact(friction=0.5, restitution=0.5)]
    w = world(tv.Particles(x, velocity=-2 * x, radius=0.04), features, path="launched", substeps=2, iterations=2)
    w.run(0.2)
    built, frames = w._runner.list_neighbours, 4
    lists: list[None] = []
    w._runner.list_neighbours = lambda: (lists.append(None), built())
    with launches() as count:
        for _ in range(frames):
            w.step(1 / 60)
    assert count["measure"] == frames + len(lists) and count["build_list"] == len(lists) > 0
    assert count.answers == count["measure"] + count["build_list"]
    w = world(tv.Particles([[0.0, 0], [1, 0]]), [tv.Gravity(1.0), tv.Distance([[0, 1]])], path="fused", substeps=5)
    w.run(0.02, dt=0.01)
    with launches() as count:
        w.step(0.01)
    assert count.total() == 1 and "1 launch per frame" in w.explain()


@pytest.mark.slow
def test_a_large_pile_has_the_same_bits_on_all_paths_and_where_a_team_breaks_up(world, briefly):
    # From 1000 particles on, blocks of particles are tested for any contact. If every wait of a team is a long one, the first
    # thread continues alone after a few waits, and the others come back 32 frames later.
    k = np.arange(1200)
    x = np.stack([k % 30 * 1.02, k // 30 * 1.02], axis=1) + 0.5 + 0.01 * tv.golden(k, dim=2)
    made = []
    for path, patience in (("fused", 0), ("parallel", 0), ("parallel", -1)):
        features = [tv.Gravity(9.81), tv.Box((0, 0), (31, 60)), tv.Contact()]
        w = world(tv.Particles(x, radius=0.5), features, path=path, substeps=3)
        if patience:
            w._runner.step.team.patience_number.set(patience)
        alone = [w.step(1 / 60) and w._runner.sheet[step.ACTIVE_THREADS] == 1 for _ in range(40)]
        assert not patience or w._runner.step.team.size == 1 or all(alone)
        assert w.last.contacts > 1000
        made.append(w.hash())
    assert len(set(made)) == 1


def test_what_is_no_number_is_hashed_alike(world):
    # The sign of inf - inf depends on the order in which a compiler takes the operands, which may differ between paths.
    w = world(tv.Particles(np.zeros((2, 2))), [])
    w.step(1 / 60)
    memory, d, told = w._runner.memory, w._runner.scene.state.d, []
    for values in ([[np.nan, 1], [0, 0]], [[-np.nan, 1], [0, 0]], [[np.nan, 2], [0, 0]]):
        memory.write(d, np.array(values))
        told.append(w.hash())
    assert told[0] == told[1] != told[2]


@pytest.mark.filterwarnings("ignore:Contact. all radii are 0")
def test_what_is_absent_has_no_field_and_no_kernel(world):
    # A point in free flight has position, displacement, mass and counts. Each feature adds its own fields and nothing else.
    plain = world(tv.Particles(np.zeros((10, 2))), [])
    names = {name.split(".")[0] for name in plain.fields}
    assert names == {"position", "displacement", "inv_mass", "numbers"}
    adds = {
        "Gravity": ([tv.Gravity(1.0)], {"Gravity"}),
        "Drag": ([tv.Drag(1.0)], {"decay"}),
        "Wind": ([tv.Wind((1, 0), 1.0)], {"Wind", "decay"}),
        "Box": ([tv.Box((-1, -1), (1, 1))], {"Box", "radius", "thrust"}),
        "HalfSpace": ([tv.HalfSpace((0, 1), -1)], {"HalfSpace", "radius", "thrust"}),
        "Polygon": ([tv.Polygon([[1, 1], [2, 1], [1, 2]])], {"Polygon", "radius", "thrust", "position_at_start"}),
        "Pin": ([tv.Pin([0])], {"Pin"}),
        "Distance": ([tv.Distance([[0, 1]], 0.1)], {"Distance", "slots", "position_low", "displacement_low"}),
        "empty Distance": ([tv.Distance(np.zeros((0, 2), int))], set()),
        "Contact of points": ([tv.Contact()], set()),
    }
    for name, (features, fields) in adds.items():
        w = world(tv.Particles(np.zeros((10, 2))), features)
        assert {field.split(".")[0] for field in w.fields} - names == fields, name
    rigid = world(tv.Particles(np.zeros((10, 2))), [tv.Distance([[0, 1]], 0.1)])
    soft = world(tv.Particles(np.zeros((10, 2))), [tv.Distance([[0, 1]], 0.1, compliance=1.0)])
    only = set(soft.fields) - set(rigid.fields)
    assert only == {"Distance.compliance", "Distance.last", "Distance.history", "Distance.offset"}


def test_explain_names_what_is_in_and_what_is_out(world):
    w = world(
        tv.Particles([[0.0, 0], [1, 0], [2, 0]], pinned=[0, 1]),
        [tv.Gravity(), tv.Distance([[0, 1], [1, 2]])],
        iterations=3,
    )
    text = w.explain()
    for part in (
        "3 particles in 2D, 2 static; f32 on cpu", "20 substeps x 3 iterations (by default, for constraints, or",
        "path fused: 1 launch per frame",
        "Distance: 2 constraints, 1 of them between particles that cannot move", "grid, neighbour list, contacts: no Contact",
        "every constraint is rigid", "breaks counted: no constraint has break_at", "Constraint corners that can move: 1 of 4",
    ):  # fmt: skip
        assert part in text
    stated = int(text.split(" fields, ")[1].split(" bytes")[0])
    assert stated == sum(w.fields.values())


def test_explain_tells_of_a_numbering_that_costs_time(world):
    lattice = np.stack(np.divmod(np.arange(10_000), 100), axis=1) * 1.0
    mixed = np.random.default_rng(1).permutation(lattice)
    for x, told in ((lattice, False), (mixed, True), (tv.shapes.Shape(mixed).in_order().position, False), (mixed[:9999], False)):
        assert ("Numbered at random" in world(tv.Particles(x), []).explain()) == told
