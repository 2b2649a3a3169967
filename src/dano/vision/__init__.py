"""Cameras and pictures of fields. Knows nothing of physics."""

from dano.vision._camera import Camera as Camera
from dano.vision._item import Item as Item, level_surface as level_surface, PALETTE as PALETTE
from dano.vision._render import render as render
