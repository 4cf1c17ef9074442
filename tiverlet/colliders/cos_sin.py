"""Cosine and sine in f64, by arithmetic only: SPIR-V, which Taichi compiles to on Vulkan and Metal, has them for f32 only.

The polynomials are those of fdlibm (Sun Microsystems 1993, k_sin.c and k_cos.c), for angles of up to pi/4.
"""

from ..device import ti

QUARTERS = 0.6366197723675814  # 2 / pi
QUARTER = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)  # pi / 2, in parts of 33 bits
SINE = (
    1.58969099521155010221e-10, -2.50507602534068634195e-08, 2.75573137070700676789e-06, -1.98412698298579493134e-04,
    8.33333333332248946124e-03, -1.66666666666666324348e-01,
)  # fmt: skip
COSINE = (
    -1.13596475577881948265e-11, 2.08757232129817482790e-09, -2.75573143513906633035e-07, 2.48015872894767294178e-05,
    -1.38888888888741095749e-03, 4.16666666666666019037e-02,
)  # fmt: skip


@ti.func
def cos_sin(x):
    """Return cosine and sine of an f64; within 2e-16 for up to a million turns."""
    k = ti.floor(x * ti.f64(QUARTERS) + ti.f64(0.5))
    for part in ti.static(QUARTER):
        x -= k * ti.f64(part)
    z = x * x
    s, c = 0 * x, 0 * x
    for a in ti.static(SINE):
        s = s * z + ti.f64(a)
    for a in ti.static(COSINE):
        c = c * z + ti.f64(a)
    s, c = x + x * z * s, 1 - (z / 2 - z * z * c)
    turns = ti.cast(k - 4 * ti.floor(k / 4), ti.i32)
    if turns % 2 == 1:
        s, c = c, -s
    if turns >= 2:
        s, c = -s, -c
    return c, s
