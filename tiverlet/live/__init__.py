"""Scenes that run while they are watched, and that the user moves by mouse."""

from .session import play

__all__ = ["play"]
