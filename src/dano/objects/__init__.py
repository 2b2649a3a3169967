"""Neural objects: mass properties, contact samples, and the object that carries both."""

from dano.objects._flats import flat_faces as flat_faces, FlatFace as FlatFace
from dano.objects._interior import (
    fill_hollows as fill_hollows,
    Interior as Interior,
    node_values as node_values,
)
from dano.objects._mass import checked_inertia as checked_inertia, MassProperties as MassProperties
from dano.objects._object import (
    field_size as field_size,
    MassModel as MassModel,
    NeuralObject as NeuralObject,
)
from dano.objects._quadrature import Quadrature as Quadrature, surface_quadrature as surface_quadrature
from dano.objects._samples import (
    ContactSamples as ContactSamples,
    draw_contact_samples as draw_contact_samples,
)
from dano.objects._surface import (
    draw_surface as draw_surface,
    SurfaceSamples as SurfaceSamples,
)
