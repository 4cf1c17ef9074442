"""The article's small tools. Each works on numbers, on NumPy arrays and inside Taichi kernels and functions alike."""

import colorsys
import functools
from collections.abc import Callable

import numpy as np

from . import checks
from .device import ti
from .device.language import callable_in_kernels, inside_kernel

# x**(d + 1) = x + 1 has one positive root, the golden ratio of dimension d (Roberts 2018, the R_d sequence). Its
# inverse powers are the steps along each axis. As odd 32-bit integers, i * step mod 2**32 visits every value once,
# which makes the sequence exact in f64 and gives it an inverse.
_BITS = 1 << 32


@functools.cache
def golden_steps(dim: int) -> tuple[int, ...]:
    """The step of the golden sequence along each of `dim` axes, as odd multiples of 2**-32."""
    root = 2.0
    for _ in range(64):
        root = (1.0 + root) ** (1.0 / (dim + 1))
    return tuple(int(_BITS / root ** (k + 1)) | 1 for k in range(dim))


def _both(kernel: Callable) -> Callable[[Callable], Callable]:
    """Use `kernel`, a ti.func, when called while a kernel is compiled, and the decorated function otherwise."""

    def decorate(python: Callable) -> Callable:
        """Of one function."""

        @functools.wraps(python)
        def chosen(*args, **kwargs):
            """Call the one that fits where this is."""
            return kernel(*args, **kwargs) if inside_kernel() else python(*args, **kwargs)

        return callable_in_kernels(chosen)

    return decorate


@ti.pyfunc
def mix(a, b, amount):
    """From a (amount 0) to b (amount 1), in a straight line; exact at both ends.

    The article's form, a (1 - amount) + b amount: the shorter a + (b - a) amount misses b by a rounding error.
    """
    return a * (1 - amount) + b * amount


@ti.pyfunc
def clamp(value, lower, upper):
    """`value`, but no less than `lower` and no more than `upper`."""
    return ti.min(ti.max(value, lower), upper)


@ti.pyfunc
def smoothstep(lower, upper, value):
    """0 up to `lower`, 1 from `upper` on, and t^2 (3 - 2 t) between, with level ends."""
    t = ti.min(ti.max((value - lower) / (upper - lower), 0), 1)
    return t * t * (3 - 2 * t)


@ti.pyfunc
def approach(value, target, rate, dt):
    """Exponential smoothing: move `value` towards `target` with `rate` [1/s] for a time dt [s].

    value' = target + (value - target) exp(-rate dt), the solution of x' = rate (target - x), so the result does not
    depend on how the time is cut into frames.
    """
    return target + (value - target) * ti.exp(-rate * dt)


@ti.func
def _golden_axis(i, step: ti.template()):  # type: ignore[valid-type]
    turned = ti.cast(i, ti.u32) * ti.u32(step)
    return ti.cast(turned, ti.f64) / 4294967296.0


@ti.func
def _golden_kernel(i, dim: ti.template() = 1):  # type: ignore[valid-type]
    if ti.static(dim == 1):
        return _golden_axis(i, ti.static(golden_steps(1)[0]))
    else:
        return ti.Vector([_golden_axis(i, step) for step in ti.static(golden_steps(dim))])


@_both(_golden_kernel)
def golden(i, dim: int = 1):
    """The i-th point of the golden-ratio sequence: evenly spread over [0, 1)^dim however many are taken.

    i: integer or integer array, 0 <= i < 2**32. Returns a number (dim 1) or dim numbers, added as the last axis.
    In 1 dimension i / phi mod 1; in more the R_d sequence (Roberts 2018).
    """
    dim, index = checks.integer("golden", "dim", dim, least=1), np.asarray(i)
    if index.dtype.kind not in "iu":
        raise TypeError(f"golden: i has type {index.dtype}, but integers are needed.")
    if index.size and (index.min() < 0 or index.max() >= _BITS):
        raise ValueError("golden: i must be at least 0 and below 2**32.")
    steps = np.array(golden_steps(dim), dtype=np.uint64)
    out = ((index.astype(np.uint64)[..., None] * steps) & np.uint64(_BITS - 1)) / _BITS
    out = out if dim > 1 else out[..., 0]
    return float(out) if out.ndim == 0 else out


@functools.cache
def _golden_inverse(dim: int) -> int:
    """What the first step of the golden sequence times it is 1 mod 2**32."""
    return pow(golden_steps(dim)[0], -1, _BITS)


@ti.func
def _golden_index_axis(value, inverse: ti.template()):  # type: ignore[valid-type]
    turned = ti.floor(ti.cast(value, ti.f64) * 4294967296.0 + 0.5)
    return ti.cast(turned, ti.u32) * ti.u32(inverse)


@ti.func
def _golden_index_kernel(value, dim: ti.template() = 1):  # type: ignore[valid-type]
    if ti.static(dim == 1):
        return _golden_index_axis(value, ti.static(_golden_inverse(1)))
    else:
        return _golden_index_axis(value[0], ti.static(_golden_inverse(dim)))


@_both(_golden_index_kernel)
def golden_index(value, dim: int = 1):
    """The inverse of golden: the i whose point is `value` (dim 1) or has `value` as its first coordinate; in kernels a u32.

    Exact for every value that golden returns; for others, the index of the nearest multiple of 2**-32.
    """
    array = np.asarray(value, dtype=np.float64)
    if dim > 1:
        array = array[..., 0]
    if not ((array >= 0) & (array < 1)).all():
        raise ValueError("golden_index: values must be at least 0 and below 1.")
    index = (np.rint(array * _BITS).astype(np.uint64) * np.uint64(_golden_inverse(dim))) & np.uint64(_BITS - 1)
    return int(index) if index.ndim == 0 else index.astype(np.int64)


def golden_colors(count: int, saturation: float = 0.62, value: float = 0.95) -> np.ndarray:
    """`count` colours with hues at golden-ratio steps: (count, 3) uint8, red, green and blue."""
    hues = golden(np.arange(checks.integer("golden_colors", "count", count, least=0)))
    rgb = [colorsys.hsv_to_rgb(hue, saturation, value) for hue in np.atleast_1d(hues)]
    return np.array(np.rint(np.array(rgb).reshape(count, 3) * 255), dtype=np.uint8)
