"""Statistics of many contacts: no collision is missed, and energy is kept."""

import pytest

from .laboratory import granular


@pytest.mark.slow
def test_gas_of_discs():
    # R23: Z = PV / NkT = (1 + phi^2 / 8) / (1 - phi)^2 within 3 %; R24: <v^4> / <v^2>^2 = 2 within 2 %.
    figures = granular.gas(980, 2, 0.5, 0.01, 60.0)
    assert figures["pressure"] == pytest.approx(1, abs=0.03)
    assert figures["moment"] == pytest.approx(1, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("dim, fraction, collisions", [(2, 0.5, 1000), (3, 0.3, 100)])
def test_energy_of_a_gas(dim, fraction, collisions):
    # R23: 1000 collisions per particle at 12 substeps between two, to the rounding of f32: 1e4 substeps, each of which may
    # change an energy by 1e-7. At 3 to 1 substeps no energy is created either. But a wall pushes out a particle that was thrown
    # into it in the same substep, at push_out at most, which is no bounce: within 1 % in 100 collisions.
    exact, *rough = granular.energies_gained(512, dim, fraction, {0.08: collisions, 0.34: 100, 1.0: 100})
    assert exact == pytest.approx(0, abs=1e-8 * collisions) and rough == pytest.approx([0, 0], abs=0.01)


@pytest.mark.slow
def test_discs_jam_where_they_should():
    # R22: frictionless discs, half of them 1.4 times as large, jam at 0.842; the target is 0.835 to 0.850.
    assert 0.835 <= granular.packing(600, 2, 0.1)["fraction"] <= 0.850


@pytest.mark.slow
def test_a_fallen_pile_hardly_overlaps():
    # 120 frames at 20 substeps: 0.2 % of the diameter on average.
    assert granular.pile(900, 3, 20)["overlap"] <= 2e-3
