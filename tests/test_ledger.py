"""The ledger: a part of its figures are what they were, all scenes are in it, and what is worse is told."""

import pytest

from .ledger import book
from .ledger.runs import figures_of, names

# Of each kind one that is done in seconds: links solved directly and relaxed, soft nets, what wind and late frames drive, discs.
QUICK = (
    "D08_massratio10", "R16_bounce_e0.5", "a rope swings from one end", "ropes with heavy ends swing", "soft nets sag at rest",
    "a wheel and an arm are driven", "a flag flies in the wind", "beads collide in free space", "S08_net_sag:n10_alpha0.01",
)  # fmt: skip


@pytest.mark.parametrize("name", QUICK)
def test_no_figure_of_a_scene_is_worse(taichi, name):
    kept = {key: row for key, row in book.read().items() if key[0] == name}
    changes = list(book.compare(kept, figures_of(name)[0]))
    assert kept and not [str(change) for change in changes if change.worse]


def test_every_case_and_scene_is_in_the_ledger():
    assert {key[0] for key in book.read()} == set(names())


def test_figures_are_read_as_they_were_written(tmp_path):
    figures = {
        ("a", "default f64", "error [m]"): {"4": "0.01", "80": "1e-06"},
        ("a", "default f64", "flags"): {"late": "softened+turned"},
        ("b", "Jacobi f64", "overlap"): {"20": "inf", "auto": "3"},
    }
    book.write(figures, tmp_path / "figures.txt")
    assert book.read(tmp_path / "figures.txt") == figures


@pytest.mark.parametrize(
    "old, new, worse",
    [
        ("0.01", "0.0105", None), ("0.01", "0.0106", True), ("0.01", "0.0094", False), (None, "1e-12", True),
        ("1e-12", None, False), ("2", "inf", True), ("2", "nan", True), ("nan", "2", False), ("inf", "inf", None),
        (None, "turned", True), ("turned", None, True), ("softened+turned", "turned", True), ("turned", "turned", None),
    ],
)  # fmt: skip
def test_what_is_worse_by_more_than_a_twentieth_is_told(old, new, worse):
    # So is each flag that comes or goes. None: a figure that rounding makes, which the file leaves out.
    key, other = ("scene", "default f32", "figure"), ("scene", "default f32", "fields")
    rows = [{other: {"4": "7"}} | ({key: {"20": cell}} if cell else {}) for cell in (old, new)]
    told = list(book.compare(*rows))
    assert [change.worse for change in told] == ([] if worse is None else [worse])
    assert all(change.key == key and change.column == "20" for change in told)


def test_scenes_that_one_of_two_books_lacks_are_not_compared():
    one, two = ({(name, "default f32", "fields"): {"4": "7"}} for name in "ab")
    assert not list(book.compare(one, two))
