"""Small numerical tools from the article. Each works on numbers, on NumPy arrays, and inside Taichi kernels and functions."""

import colorsys
import functools
from collections.abc import Callable

import numpy as np

from . import checks
from .device import ti
from .device.language import inline, inside_kernel

# x**(d + 1) = x + 1 has one positive root, the golden ratio of dimension d (Roberts 2018, the R_d sequence). Its
# inverse powers are the steps along each axis. As odd integers of as many bits as an f64 holds, i * step mod 2**53 visits
# every value once, which makes the sequence exact in f64 and gives it an inverse. After n points it is off by n 2**-53, and gaps
# are 1 / n: it is as even as the exact sequence up to some 2**26 points.
BITS = 53


@functools.cache
def golden_steps(dim: int, bits: int = BITS) -> tuple[int, ...]:
    """Return the step of the golden sequence along each of `dim` axes, as odd multiples of 2**-bits."""
    low, high = 0, 1 << 2 * BITS  # y**(d + 1) + y**d = 1 for the inverse y of the root, by halving, as an integer
    one = high
    while high - low > 1:
        y = (low + high) // 2
        low, high = (y, high) if y ** (dim + 1) + one * y**dim < one ** (dim + 1) else (low, y)
    return tuple(low ** (k + 1) // (one ** (k + 1) >> bits) | 1 for k in range(dim))


def _both(kernel: Callable) -> Callable[[Callable], Callable]:
    """Make a function that runs `kernel`, a ti.func, while a kernel is compiled, and the decorated function otherwise."""

    def decorate(python: Callable) -> Callable:
        """Combine one Python function with the kernel."""

        @functools.wraps(python)
        def chosen(*args, **kwargs):
            """Call the function for the present context."""
            return kernel(*args, **kwargs) if inside_kernel() else python(*args, **kwargs)

        return inline(chosen)

    return decorate


@ti.func
def _mix_kernel(a, b, amount):
    return a * (1 - amount) + b * amount


@_both(_mix_kernel)
def mix(a, b, amount):
    """Interpolate linearly from a (amount 0) to b (amount 1); exact at both ends. a, b: numbers, arrays or tuples.

    The article's formula is a (1 - amount) + b amount. The shorter a + (b - a) amount misses b by a rounding error.
    """
    a, b = (np.asarray(v) if isinstance(v, (tuple, list)) else v for v in (a, b))
    return a * (1 - amount) + b * amount


@ti.pyfunc
def clamp(value, lower, upper):
    """Limit `value` to at least `lower` and at most `upper`."""
    return ti.min(ti.max(value, lower), upper)


@ti.pyfunc
def smoothstep(lower, upper, value):
    """Return 0 up to `lower`, 1 from `upper` on, and t^2 (3 - 2 t) between, with zero slope at both ends."""
    t = ti.min(ti.max((value - lower) / (upper - lower), 0), 1)
    return t * t * (3 - 2 * t)


@ti.pyfunc
def approach(value, target, rate, dt):
    """Smooth exponentially: move `value` towards `target` with `rate` [1/s] for a time dt [s].

    value' = target + (value - target) exp(-rate dt), the solution of x' = rate (target - x). So the result does not depend on how
    the time is divided into frames.
    """
    return target + (value - target) * ti.exp(-rate * dt)


@ti.func
def _golden_axis(i, step: ti.template()):  # type: ignore[valid-type]
    turned = (ti.cast(i, ti.u64) * ti.u64(step)) & ti.u64(2**BITS - 1)
    return ti.cast(turned, ti.f64) * ti.static(2.0**-BITS)


@ti.func
def _golden_kernel(i, dim: ti.template() = 1):  # type: ignore[valid-type]
    if ti.static(dim == 1):
        return _golden_axis(i, ti.static(golden_steps(1)[0]))
    else:
        return ti.Vector([_golden_axis(i, step) for step in ti.static(golden_steps(dim))])


@_both(_golden_kernel)
def golden(i, dim: int = 1):
    """Return the i-th point of the golden-ratio sequence: evenly spread over [0, 1)^dim for any number of points.

    i: integer or integer array, 0 <= i < 2**53. Returns a number (dim 1) or dim numbers, added as the last axis.
    In 1 dimension the sequence is i / phi mod 1; in more dimensions the R_d sequence (Roberts 2018), to i 2**-53.
    """
    dim, index = checks.integer("golden", "dim", dim, least=1), np.asarray(i)
    if index.dtype.kind not in "iu":
        raise TypeError(f"golden: i has type {index.dtype}, but integers are needed.")
    if index.size and (index.min() < 0 or index.max() >= 2**BITS):
        raise ValueError("golden: i must be at least 0 and below 2**53.")
    steps = np.array(golden_steps(dim), dtype=np.uint64)
    out = ((index.astype(np.uint64)[..., None] * steps) & np.uint64(2**BITS - 1)) * 2.0**-BITS
    out = out if dim > 1 else out[..., 0]
    return float(out) if out.ndim == 0 else out


@functools.cache
def _golden_inverse(dim: int) -> int:
    """Return the inverse of the first step of the golden sequence, modulo 2**53."""
    return pow(golden_steps(dim)[0], -1, 2**BITS)


@ti.func
def _golden_index_axis(value, inverse: ti.template()):  # type: ignore[valid-type]
    turned = ti.round(ti.cast(value, ti.f64) * ti.static(2.0**BITS), ti.u64)
    return (turned * ti.u64(inverse)) & ti.u64(2**BITS - 1)


@ti.func
def _golden_index_kernel(value, dim: ti.template() = 1):  # type: ignore[valid-type]
    if ti.static(dim == 1):
        return _golden_index_axis(value, ti.static(_golden_inverse(1)))
    else:
        return _golden_index_axis(value[0], ti.static(_golden_inverse(dim)))


@_both(_golden_index_kernel)
def golden_index(value, dim: int = 1):
    """Invert golden: return the i whose point is `value` (dim 1) or has `value` as its first coordinate; a u64 in kernels.

    Exact for every value that golden returns; for other values, the index of the nearest multiple of 2**-53.
    """
    array = np.asarray(value, dtype=np.float64)
    if dim > 1:
        array = array[..., 0]
    if not ((array >= 0) & (array < 1)).all():
        raise ValueError("golden_index: values must be at least 0 and below 1.")
    turned = np.rint(array * 2.0**BITS).astype(np.uint64)
    with np.errstate(over="ignore"):  # modulo 2**64
        index = (turned * np.uint64(_golden_inverse(dim))) & np.uint64(2**BITS - 1)
    return int(index) if index.ndim == 0 else index.astype(np.int64)


def golden_colors(count, saturation: float = 0.62, value: float = 0.95) -> np.ndarray:
    """Return colours with hues at golden-ratio steps: uint8, red, green and blue.

    count: how many, for (count, 3); or the numbers of some, such as [7], for (k, 3): a colour depends on its number alone.
    """
    some = np.arange(checks.integer("golden_colors", "count", count, least=0)) if np.ndim(count) == 0 else np.asarray(count)
    rgb = [colorsys.hsv_to_rgb(hue, saturation, value) for hue in np.atleast_1d(golden(some.ravel()))] if some.size else []
    return np.array(np.rint(np.array(rgb).reshape(*some.shape, 3) * 255), dtype=np.uint8)
