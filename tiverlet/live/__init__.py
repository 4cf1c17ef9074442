"""Scenes that run while they are watched, and are taken by hand."""

from .session import play

__all__ = ["play"]
