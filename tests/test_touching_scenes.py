"""What must hold in every scene, asserted of those with contacts."""

from .properties import *  # noqa: F403

TOUCH = True
