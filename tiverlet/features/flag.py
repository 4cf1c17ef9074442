"""Properties of features that decide the code of their kernels."""

from collections.abc import Callable
from typing import Any


class Flag:
    """A property of a feature: a test of its knobs. It stays True once kernels were compiled with it, see `compiled_so_far`."""

    def __init__(self, test: Callable[[Any], Any], doc: str):
        self.test, self.__doc__ = test, doc

    def __set_name__(self, owner: Any, name: str) -> None:
        self.name = name

    def __get__(self, feature: Any, owner: Any = None) -> Any:
        return self if feature is None else bool(self.test(feature)) or self.name in feature.compiled_so_far


SOFT = Flag(lambda f: (f.compliance > 0).any(), "Whether any constraint has compliance.")
BREAKS = Flag(lambda f: f.break_at is not None, "Whether a load can break constraints.")
