"""The article's small tools, in Python and in kernels."""

from fractions import Fraction

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.colliders.cos_sin import cos_sin
from tiverlet.device import ti
from tiverlet.features.material import limit_length


def test_mix_clamp_smoothstep_and_approach():
    a, b = 0.1, 1e17 + 0.3
    assert tv.mix(a, b, 0) == a and tv.mix(a, b, 1) == b
    np.testing.assert_array_equal(tv.mix(np.array([1.0, 2.0]), np.array([3.0, 6.0]), 0.5), [2.0, 4.0])
    np.testing.assert_array_equal(tv.mix((255, 0, 0), (0, 0, 255), 0.25), [191.25, 0, 63.75])
    np.testing.assert_array_equal(tv.clamp(np.array([-2.0, 0.5, 7.0]), 0.0, 1.0), [0.0, 0.5, 1.0])
    # t^2 (3 - 2 t): 0, 1/2 and 1 at the ends and the middle, level at both ends.
    np.testing.assert_allclose(tv.smoothstep(1.0, 3.0, np.array([0.0, 1.0, 2.0, 3.0, 9.0])), [0, 0, 0.5, 1, 1])
    assert tv.smoothstep(0.0, 1.0, 1e-4) < 4e-8
    # x' = rate (target - x): x(t) = target + (x0 - target) exp(-rate t), however time is cut.
    exact, x = 5 + (1 - 5) * np.exp(-3 * 0.7), 1.0
    for dt in (0.1, 0.25, 0.05, 0.3):
        x = tv.approach(x, 5.0, 3.0, dt)
    assert x == pytest.approx(exact, rel=1e-14) and tv.approach(1.0, 5.0, 3.0, 0.7) == pytest.approx(exact, rel=1e-15)


def test_golden_is_even_and_has_an_inverse():
    n, many = 4096, np.array([0, 1, 2, 3, 1000, 2**31, 2**32 - 1, 2**53 - 1])
    for dim in (1, 2, 3):
        u = tv.golden(np.arange(n), dim=dim).reshape(n, dim)
        assert ((u >= 0) & (u < 1)).all()
        for k in range(dim):
            # Each of n/16 equal cells of an axis holds 16 points, give or take the discrepancy; random points scatter by 4.
            counts = np.histogram(u[:, k], bins=n // 16, range=(0, 1))[0]
            assert counts.std() < 2 and np.abs(counts - 16).max() <= (3 if dim == 1 else 6)
        np.testing.assert_array_equal(tv.golden_index(tv.golden(many, dim=dim), dim=dim), many)
    # d = 1: 1 / phi; d = 2: inverse powers of the plastic number, x^3 = x + 1 (Roberts 2018).
    plastic = 1.32471795724474602596
    assert tv.golden(1) == pytest.approx(2 / (1 + 5**0.5), abs=2**-52)
    np.testing.assert_allclose(tv.golden(1, dim=2), [1 / plastic, 1 / plastic**2], atol=2**-52)
    with pytest.raises(ValueError, match="at least 0"):
        tv.golden(-1)
    colors = tv.golden_colors(12)
    assert colors.shape == (12, 3) and colors.dtype == np.uint8 and len(np.unique(colors, axis=0)) == 12
    assert tv.golden_colors(0).shape == (0, 3)
    np.testing.assert_array_equal(tv.golden_colors([7, 2]), colors[[7, 2]])


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
def test_golden_is_the_exact_sequence_for_millions_of_points(dim):
    # i y^k mod 1 with y^(d + 1) + y^d = 1, in fractions, to i 2^-53: a step of 53 bits.
    y = Fraction(1, 2)
    for k in range(2, 130):
        y += Fraction(1, 2**k) * (1 if y ** (dim + 1) + y**dim < 1 else -1)
    for i in (1, 30_001, 999_999, 10**9):
        for k, u in enumerate(np.atleast_1d(tv.golden(i, dim=dim))):
            off = (Fraction(float(u)) - i * y ** (k + 1)) % 1
            assert min(off, 1 - off) <= Fraction(i, 2**53)


def test_gaps_of_golden_have_two_lengths_or_three():
    # Of n points the gaps have lengths whose ratios are powers of phi (Sos 1958): the largest is phi^2 times the smallest.
    for n in (30_000, 1_000_000):
        x = np.sort(tv.golden(np.arange(n)))
        gaps = np.diff(x, append=x[0] + 1)
        assert gaps.max() / gaps.min() <= (1 + 5**0.5) ** 2 / 4 + 2 * n * 2.0**-53 / gaps.min()


def test_cosines_of_f64_are_right_to_the_last_digit():
    @ti.kernel
    def run(x: ti.types.ndarray(ti.f64, 1), out: ti.types.ndarray(ti.f64, 2)):
        for i in range(x.shape[0]):
            out[i, 0], out[i, 1] = cos_sin(x[i])

    rng = np.random.default_rng(0)
    quarters = np.arange(-9, 10) * np.pi / 4
    x = np.r_[0.0, quarters, quarters * (1 + 2.0**-50), rng.uniform(-7, 7, 1000), rng.uniform(-6e6, 6e6, 1000), 1e-300]
    out = np.zeros((len(x), 2))
    run(x, out)
    np.testing.assert_allclose(out, np.stack([np.cos(x), np.sin(x)], axis=1), rtol=0, atol=2.0**-52)
    assert out[0].tolist() == [1.0, 0.0] and out[-1].tolist() == [1.0, 1e-300]


def test_tools_work_inside_kernels():
    out, back = ti.field(ti.f64, 10), ti.field(ti.u64, (3, 4))

    @ti.kernel
    def run(third: ti.f64, some: ti.types.ndarray(ti.u64, 1)):
        out[0] = tv.mix(third, ti.f64(2.0), ti.f64(0.25))
        out[1] = tv.clamp(third, 0, 1)
        out[2] = tv.smoothstep(ti.f64(0.0), ti.f64(1.0), third)
        out[3] = tv.approach(third, ti.f64(2.0), ti.f64(3.0), ti.f64(0.5))
        out[4] = tv.golden(12345)
        uv = tv.golden(12345, 2)
        out[5], out[6] = uv[0], uv[1]
        v = tv.mix(ti.Vector([third, third]), ti.Vector([third, 2 * third]), ti.f64(0.5))
        out[7] = v[1]
        out[8], out[9] = tv.mix(third, ti.f64(1e17), 0), tv.mix(ti.f64(1e17), third, 1)
        for k in range(4):
            back[0, k] = tv.golden_index(tv.golden(some[k]))
            back[1, k] = tv.golden_index(tv.golden(some[k], 2), 2)
            back[2, k] = tv.golden_index(tv.golden(some[k], 3), 3)

    third, some = 1 / 3, np.array([0, 7, 2**31, 2**53 - 1], dtype=np.uint64)
    run(third, some)
    want = [
        tv.mix(third, 2.0, 0.25), third, tv.smoothstep(0.0, 1.0, third), tv.approach(third, 2.0, 3.0, 0.5), tv.golden(12345),
        *tv.golden(12345, dim=2), 1.5 * third, third, third,
    ]  # fmt: skip
    np.testing.assert_allclose(out.to_numpy(), want, rtol=1e-15)
    np.testing.assert_array_equal(out.to_numpy()[-2:], third)  # exact at both ends
    np.testing.assert_array_equal(back.to_numpy(), [some] * 3)


def test_what_friction_takes_of_no_slip_is_finite(taichi):
    # Up to `most` all of a slip v, beyond it the length given. A load that is taken back is negative, and a slip may be 0.
    out = ti.Vector.field(2, ti.f32, 4)

    @ti.kernel
    def run(length: ti.f32):
        for k in range(4):
            v = ti.Vector([3.0, 4.0]) * (k % 2)
            out[k] = limit_length(v, 6.0 - 7.0 * (k // 2), length)

    run(1.0)
    np.testing.assert_allclose(out.to_numpy(), [[0, 0], [3, 4], [0, 0], [0.6, 0.8]], rtol=1e-6)
