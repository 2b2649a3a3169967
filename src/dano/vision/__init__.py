"""Cameras and pictures of fields. Knows nothing of physics."""

from dano.vision._camera import Camera as Camera
from dano.vision._item import (
    checked_colour as checked_colour,
    Item as Item,
    level_surface as level_surface,
    PALETTE as PALETTE,
    placement as placement,
)
from dano.vision._render import render as render
