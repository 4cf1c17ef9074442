"""One formula from soft to rigid, for every constraint that has a spring. See Scalar for what the letters mean."""

from ...device import ti


@ti.func
def stiff(alpha, h, w):
    """theta = s^4 / (1 + s^4), s^2 = w h^2 / alpha: 0 where the step resolves the spring, 1 where it is rigid."""
    ratio = alpha / (h * h * w)  # 1 / s^2; s^4 would overflow in f32
    return 1 / (1 + ratio * ratio)


@ti.func
def law(alpha, damping, h, w, fresh):
    """The coefficients of C_(n+1), C_n and C_(n-1) in C* + alpha c dC/dt: central where resolved, backward where stiff."""
    rigid, gamma = stiff(alpha, h, w), damping * alpha / h
    A = (1 + 3 * rigid) / 4 + gamma * (1 + rigid) / 2
    now, last = (1 - rigid) / 2 - gamma * rigid, (1 - rigid) / 4 - gamma * (1 - rigid) / 2
    if fresh != 0:
        A, now, last = rigid + gamma, 1 - rigid - gamma, 0 * rigid
    return A, now, last
