"""Libraries that only some formats need."""

import importlib
from types import ModuleType


def needed(name: str, path: str) -> ModuleType:
    """Import a module. Raises ImportError with the command that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as e:
        raise ImportError(f"replay: {path} needs {name}, which is not installed: pip install 'tiverlet[export]'.") from e
