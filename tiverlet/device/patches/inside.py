"""What tiverlet asks of Taichi's inside. Nothing here changes what Taichi does."""

import contextlib
import functools
from collections.abc import Callable
from typing import Any

import taichi as ti
from taichi.lang import impl
from taichi.lang.expr import Expr

inside_kernel: Callable[[], bool] = impl.inside_kernel
Expression: Any = Expr  # a number or a vector while a kernel is translated


def current() -> Any:
    """The running Taichi: another object after each ti.init and ti.reset."""
    return impl.get_runtime()


def has(arch: str) -> bool:
    """Whether this machine and this Taichi have an architecture, by its name in Taichi."""
    with contextlib.suppress(Exception):
        library: Any = ti._lib
        return bool(getattr(library.core, f"with_{arch}")())
    return False


def before_fields(check: Callable[[], None]) -> None:
    """Have `check` called before a field is made, by whoever makes it."""
    create: Any = impl.create_field_member

    @functools.wraps(create)
    def created(*args, **kwargs):
        check()
        return create(*args, **kwargs)

    impl.create_field_member = created
