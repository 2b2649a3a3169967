"""What a photograph is explained by: radiance models, volume rendering, the field that is learned."""

from dano.vision.radiance._learned import Doubt as Doubt, LearnedField as LearnedField
from dano.vision.radiance._models import (
    AbstractMedium as AbstractMedium,
    AbstractModel as AbstractModel,
    AbstractSurface as AbstractSurface,
    Appearance as Appearance,
    DensityModel as DensityModel,
    DRAWING as DRAWING,
    Network as Network,
    Sampling as Sampling,
    sections as sections,
    see as see,
    Seen as Seen,
    Share as Share,
    SurfaceModel as SurfaceModel,
    Vectors as Vectors,
)
from dano.vision.radiance._picture import (
    picture as picture,
    pixel_order as pixel_order,
    RenderedPicture as RenderedPicture,
)
from dano.vision.radiance._volume import (
    composite as composite,
    section_weights as section_weights,
    stratified_edges as stratified_edges,
    transmittance as transmittance,
)
