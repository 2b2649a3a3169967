"""Pictures of fields: solids, media and learned models under lamps and a sky."""

from dano.vision.drawing._composed import (
    colours_under as colours_under,
    compose as compose,
    Part as Part,
    Places as Places,
    places_seen as places_seen,
    through as through,
)
from dano.vision.drawing._item import (
    checked_colour as checked_colour,
    Item as Item,
    level_surface as level_surface,
    PALETTE as PALETTE,
    placement as placement,
    usual_level as usual_level,
)
from dano.vision.drawing._render import prepare as prepare, render as render
from dano.vision.drawing._shade import GAMMA as GAMMA
