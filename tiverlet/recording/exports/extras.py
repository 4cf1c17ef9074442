"""Libraries that only some formats need."""

import importlib
from types import ModuleType


def needed(name: str, path: str, extra: str = "export") -> ModuleType:
    """Import a module, of an extra of this package. Raises ImportError with the command that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as e:
        raise ImportError(f"replay: {path} needs {name}, which is not installed: pip install 'tiverlet[{extra}]'.") from e
