"""Rows of the stiff and extreme matrix, by number, of which no other test has the scene."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.report.stress.certificate import certify

from .conftest import ARCH


@pytest.mark.slow
@pytest.mark.parametrize(
    "number", (4, 6, 7, 11, 12, 18, 25, *range(28, 34), 36, 38, 43, 44, 50, 51, 52, *range(57, 63), 65, 84, 90, 91)
)
def test_rows_pass(number, briefly):
    # All rows take minutes: python -m tiverlet stress.
    result = certify(number)
    if ARCH not in tv.runtime.LLVM and any(ARCH in why for why in result.failing):  # the architecture does not support it
        pytest.skip(str(result.failing))
    assert result.verdict == "passed", result
    whip = "Jacobi(relaxation=1): turned, unconverged; Direct(): softened, unconverged"
    said = {18: whip, 62: ("5 substeps advised", "6 substeps advised")}
    assert result.figure.startswith(said.get(number, ""))


@pytest.mark.slow
def test_thousands_in_one_cell_are_warned_of_and_all_pairs_are_there(world):
    # O(n^2), with a warning and without overflow. Launched phase by phase, where the list has a kernel of its own.
    n = 2048
    x = np.random.default_rng(0).uniform(0, 0.01, (n, 2))
    w = world(tv.Particles(x, radius=0.5), [tv.Contact()], path="launched")
    with pytest.warns(UserWarning, match="near pairs per particle"):
        w._runner.list_neighbours()
    np.testing.assert_array_equal(w._runner.memory.read(w._runner.search.list.number), n - 1)
