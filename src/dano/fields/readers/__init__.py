"""Fields from files of many kinds, and files of fields."""

from dano.fields.readers._companions import companion_files as companion_files
from dano.fields.readers._gaussians import Splats as Splats
from dano.fields.readers._io import (
    FIELD_FORMATS as FIELD_FORMATS,
    FIELD_SUFFIXES as FIELD_SUFFIXES,
    load_field as load_field,
    offer_models as offer_models,
    save_field as save_field,
)
from dano.fields.readers._splat_files import is_splats as is_splats, read_splats as read_splats
